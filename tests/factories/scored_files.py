"""Recordings, features and stimuli in files, for the command line to score."""

from pathlib import Path

import h5py
import numpy as np

from brainbench.datasets import write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.models.features import write_features
from brainbench.scoring.options import ScoreOptions


def write_arrays(path: Path, labels: str) -> Path:
    """Write random arrays as stimuli."""
    with h5py.File(path, "w") as file:
        file["stimuli"] = np.random.default_rng(1).normal(size=(len(labels), 3, 2, 2, 2)).astype(np.float32)
        file["labels"] = np.array(list(labels), dtype=h5py.string_dtype())
    return path


def write_study(
    folder: Path,
    animals: str = "wxyz",
    labels: str = "abcdefgh",
    *,
    repeats: int = 8,
    until: float = 90.0,
    arrays: str = "eight.h5",
) -> dict[str, str]:
    """Write a recording of twelve units for each animal, observed until a time (s); arrays and features of its stimuli.

    Animals and labels are letters.
    """
    rng = np.random.default_rng(0)
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
        write_recordings(folder / "data" / f"{animal}.h5", session)
    write_arrays(folder / arrays, labels)
    features = write_features(folder / "features.h5", labels, {"fc": rng.normal(size=(len(labels), 6))})
    paths = {"recordings": "data", "arrays": arrays, "board": "board", "secret": "secret", "out": "out"}
    return {name: str(folder / path) for name, path in paths.items()} | {"features": str(features)}


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
