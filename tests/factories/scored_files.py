"""Recordings, features, stimuli and models in files, for the command line to score."""

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from brainbench.datasets import write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.models.features import write_features
from brainbench.scoring.options import ScoreOptions

LABELS = ("a", "b", "c", "d")
EIGHT = tuple("abcdefgh")


def _record(rng: np.random.Generator, folder: Path, animals: str, labels: Sequence[str], repeats: int, until: float):
    """Write a recording of twelve units for each animal, observed until a time (s)."""
    for animal in animals:
        order = np.repeat(np.arange(len(labels)), repeats)
        starts = 1.0 + np.arange(len(order))
        rates = rng.gamma(2.0, 8.0, size=(len(labels), 12))
        spikes = [
            np.sort(
                np.concatenate(
                    [s + rng.uniform(0, 0.5, rng.poisson(rates[k, u])) for s, k in zip(starts, order, strict=True)]
                )
            )
            for u in range(12)
        ]
        table = {"start_time": starts, "stop_time": starts + 0.5, "texture": [labels[k] for k in order]}
        seen = [np.array([[0.0, until]])] * 12
        session = make_session(animal, "1", spikes, {"trials": table}, observed=seen)
        write_recordings(folder / f"{animal}.h5", session)


def write_arrays(path: Path, labels: Sequence[str]) -> Path:
    """Write random arrays as stimuli."""
    with h5py.File(path, "w") as file:
        file["stimuli"] = np.random.default_rng(1).normal(size=(len(labels), 3, 2, 2, 2)).astype(np.float32)
        file["labels"] = np.array(list(labels), dtype=h5py.string_dtype())
    return path


def write_scored_files(tmp_path: Path) -> dict[str, str]:
    """Write a recording of two animals, features and arrays for its four conditions."""
    rng = np.random.default_rng(0)
    _record(rng, tmp_path / "data", "xy", LABELS, 10, 60.0)
    features = write_features(tmp_path / "features.h5", LABELS, {"fc": rng.normal(size=(4, 6))})
    write_arrays(tmp_path / "arrays.h5", LABELS)
    (tmp_path / "mine.py").write_text(
        "from torch import nn\n\n\nclass Mine(nn.Module):\n"
        "    def __init__(self):\n        super().__init__()\n        self.gru = nn.GRU(8, 6, batch_first=True)\n\n"
        "    def forward(self, x):\n        return self.gru(x.flatten(2))[0][:, -1]\n"
    )
    return {
        "recordings": str(tmp_path / "data"),
        "features": str(features),
        "arrays": str(tmp_path / "arrays.h5"),
        "model": f"{tmp_path / 'mine.py'}:Mine",
        "out": str(tmp_path / "out"),
    }


def write_study(tmp_path: Path) -> dict[str, str]:
    """Write four animals and eight stimuli; features and a module for them."""
    rng = np.random.default_rng(0)
    _record(rng, tmp_path / "data", "wxyz", EIGHT, 8, 90.0)
    write_arrays(tmp_path / "eight.h5", EIGHT)
    features = write_features(tmp_path / "features.h5", EIGHT, {"fc": rng.normal(size=(len(EIGHT), 6))})
    paths = {"data": "data", "arrays": "eight.h5", "board": "board", "secret": "secret", "out": "out"}
    return {name: str(tmp_path / path) for name, path in paths.items()} | {"features": str(features)}


def write_laboratory(folder: Path) -> Path:
    """Write the same with the benchmark ``lab.toml`` that is made of them."""
    from brainbench.benchmarks.opening import make  # an optional folder

    write_study(folder)
    options = ScoreOptions(
        recordings=str(folder / "data"), conditions="trials:texture", stimuli=str(folder / "eight.h5"), seed=1
    )
    words = {"name": "lab", "citation": "Doe J., A Journal 1:2 (2026), doi:10.1000/xyz", "doi": "10.1/2"}
    (folder / "lab.toml").write_text(make(options, folder / "lab.toml", **words).to_toml())
    return folder / "lab.toml"
