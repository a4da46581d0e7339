"""Every reader of users' files: how a small good file is made, how it is read, and which results are faulty."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from safetensors.torch import save_file

from brainbench.cli.leaderboard.scoring import parse_seeds, read_batch
from brainbench.core.files import read_json, read_mapping, write_json
from brainbench.core.labels import read_match
from brainbench.core.records import ResultRecord
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.trials.selection import Selection
from brainbench.datasets.whisking.dataset import WhiskingDataset
from brainbench.geometry.mesh import load_mesh, save_mesh
from brainbench.models.features import read_features, write_features
from brainbench.models.graph.tnn_import import read_graph
from brainbench.models.training.checkpoints import load_weights, read_config
from brainbench.models.training.config import TrainingConfig
from brainbench.stimuli import load_stimuli
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.recorded import load_initial_angles, load_trajectory
from brainbench.stimuli.objects.primitives import sphere
from brainbench.stimuli.scenes.scene_files import load_scene
from brainbench.stimuli.stimulus_set import hash_stimulus_set, write_stimulus_set
from brainbench.stimuli.sweeps.generation import generate
from brainbench.stimuli.whiskit_runs import read_runs
from tests.factories.published_sweeps import write_run
from tests.factories.reading_trials import Surface, not_finite, numbers
from tests.factories.recording_files import write_nwb
from tests.factories.recordings import make_simple_session, make_stimuli
from tests.factories.records import make_record
from tests.factories.sweep_batches import small_plan

SCENE = """
description = "a pole"
[array]
species = "mouse"
whiskers = "C1,C2"
[array.replace.C2]
young_modulus = 3.3e9
[head]
position_mm = [1, 2, 3]
rotation_deg = [0, 90, 0]
[whisking]
frequency_hz = 8
protraction_deg = 30
onset_ms = 50
[frames]
first_ms = 1
interval_ms = 9
count = 10
average = 2
lowpass_hz = 40
[[scene]]
label = "near"
[[scene.object]]
shape = "cylinder"
radius_mm = 0.5
height_mm = 20
position_mm = [14, 5, 0]
friction = 0.3
velocity_mm_s = [0, -30, 0]
"""
BATCH = """
[options]
recordings = "demo"
metric = "rsa"
time = "mean"
bin = 0.05
seed = 3
units_reliability = 0.5
[[entries]]
models = ["zhuang-small", "resnet18-small"]
seeds = [0, 1]
"""
CONFIG = """
epochs = 4
batch_size = 8
learning_rate = 0.01
clip = 1.0
masking = 0.1
probe_epochs = 2
seed = 1
checkpoint_seconds = 60.0
optimizer = "sgd"
augmentation = "none"
"""


def _node(name: str, source: str | None) -> dict[str, Any]:
    return {
        "name": name, "shape_from": source, "harbor_policy": {"name": "ResizeConcat"},
        "pre_memory": {"name": "Conv2dCell", "out_channels": 4, "ksize": [3, 3], "padding": "same", "bias": 0.0},
        "recurrent_cell": {"name": "LSTMCell", "out_channels": 4, "ksize": 2, "layernorm": True, "forget_bias": 1.0},
        "post_memory": {"name": "MaxPool", "ksize": 2, "stride": 2, "padding": 0, "ceil_mode": True},
        "out_channels": 4,
    }  # fmt: skip


GRAPH = {
    "nodes": [_node("a", None), _node("b", "a")], "edges": [{"from": "a", "to": "b"}], "input_nodes": ["a"],
    "output_node": "b", "input_shape": [3, 5, 7], "num_timesteps": 22,
}  # fmt: skip


def _text(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_text(text, encoding="utf-8")
        return path

    return make


def _json(name: str, value: Any) -> Callable[[Path], Path]:
    return lambda folder: write_json(folder / name, value)


def _word(read: Callable[[str], Any]) -> Callable[[Path], Any]:
    """Read an option that a user types: any text, from a file whose damage may be no text at all."""

    def of(path: Path) -> Any:
        return read(path.read_bytes().decode(errors="replace")[:100_000] if path.is_file() else "")

    return of


def _nwb(folder: Path) -> Path:
    return write_nwb(folder / "sub-m1_ses-s1.nwb")


def _spikes(folder: Path) -> Path:
    return write_recordings(folder / "spikes.h5", make_simple_session())


def _counts(folder: Path) -> Path:
    return write_recordings(
        folder / "counts.h5", open_recordings(_spikes(folder), conditions="trials:stimulus", bin=0.25)
    )


def _bad_counts(dataset: Any) -> bool:
    """Counts are 0 or more, or missing; a bin has a length of 0 or more; times are finite."""
    counts, duration = dataset["counts"].values, dataset["duration"].values
    real = counts[~np.isnan(counts)]
    return bool(
        np.isinf(real).any()
        or (real < 0).any()
        or not (np.isfinite(duration) & (duration >= 0)).all()
        or not np.isfinite(dataset["time"].values).all()
    )


def _stimulus_set(folder: Path) -> Path:
    dataset = make_stimuli(whiskers=5)
    return write_stimulus_set(dataset.assign_attrs(content_hash=hash_stimulus_set(dataset)), folder / "set.h5")


def _arrays(folder: Path) -> Path:
    with h5py.File(folder / "arrays.h5", "w") as file:
        file["stimuli"] = np.arange(24.0).reshape(4, 3, 2)
        file.create_dataset("labels", data=list("abcd"), dtype=h5py.string_dtype())
    return folder / "arrays.h5"


def _activations(folder: Path) -> Path:
    layers = {"one": np.arange(8.0).reshape(4, 2), "two": np.ones((4, 3, 2), np.float32)}
    return write_features(folder / "features.h5", list("abcd"), layers)


def _mesh(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        solid = sphere(0.01).surface or _tetrahedron()
        return save_mesh(folder / f"mesh{suffix}", solid, unit="mm")

    return make


def _tetrahedron() -> Any:
    from brainbench.geometry.mesh import convex_hull

    return convex_hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.01)


def _run(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        run = write_run(folder / "run", np.random.default_rng(0).normal(size=(110, 2, 6)))
        found = run / name
        # The damaged file lies directly in the folder that is copied.
        return found if found.parent == run else _lifted(run, found)

    return make


def _lifted(run: Path, found: Path) -> Path:
    link = run / found.name
    found.replace(link)
    (run / "moved").write_text(found.relative_to(run).as_posix())
    return link


def _read_run(path: Path) -> Any:
    moved = path.parent / "moved"
    if moved.exists():
        path.replace(path.parent / moved.read_text())
        moved.unlink()
    return read_runs([path.parent])


def _bad_run(dataset: Any) -> bool:
    good = np.isfinite(dataset["wrench"].values).all(axis=-1) | (dataset["frame_status"].values != 0)
    return not good.all()


def _trajectory(folder: Path) -> Path:
    values = np.random.default_rng(0).normal(size=(62, 12))
    np.savetxt(folder / "whisking.csv", values, delimiter=",", fmt="%.4g")
    return folder / "whisking.csv"


def _angles(folder: Path) -> Path:
    np.savetxt(folder / "angles.csv", np.zeros((62, 3)), delimiter=",", fmt="%.4g")
    return folder / "angles.csv"


def _model() -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))


def _weights(folder: Path) -> Path:
    save_file(_model().state_dict(), folder / "model.safetensors")
    return folder / "model.safetensors"


def _load(path: Path) -> Any:
    model = _model()
    load_weights(model, path, what="test")
    return dict(model.state_dict())


@functools.cache
def _plan() -> Any:
    return small_plan(("brick:5", "cone:5"), whiskers="C2,C3", shard_size=1000)


def _sweeps(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        generate(_plan(), folder, workers=1)
        return folder / name

    return make


def _read_sweeps(path: Path) -> Any:
    data = WhiskingDataset(path.parent, split="train", batch_size=4, shuffle=False)
    data.verify()
    return next(iter(data))


def _bad_graph(spec: Any) -> bool:
    sizes = [getattr(node.operation, name, 1) for node in spec.nodes for name in ("channels", "features")]
    sizes += [n for node in spec.nodes for n in (*getattr(node.operation, "kernel_size", ()), *spec.input_shape)]
    sizes += [n for node in spec.nodes if node.pool for n in (*node.pool.size, *(node.pool.stride or ()))]
    return not_finite(spec) or any(type(size) is not int or not 1 <= size <= 10**6 for size in sizes)


def _bad_scene(recipe: Any) -> bool:
    scenes = list(recipe.scenes)
    return not_finite(scenes) or any((item.friction or 0) < 0 for scene in scenes for item in scene.objects)


def _bad_record(record: Any) -> bool:
    scores = [record.score, *record.baselines.values()]
    return any(math.isinf(n) for n in numbers(record)) or any(
        not (0 <= n <= 1) for score in scores for n in (score.p, score.p_smallest) if not math.isnan(n)
    )


def _bad_config(config: TrainingConfig) -> bool:
    positive = (config.epochs, config.batch_size, config.learning_rate, config.checkpoint_seconds)
    return not_finite(config) or min(positive) <= 0 or not 0 <= config.masking < 1 or config.seed < 0


def _bad_batch(jobs: Any) -> bool:
    return not_finite([vars(job.options) for job in jobs]) or any(
        job.options.model_seed < 0 or (job.options.bin is not None and job.options.bin <= 0) for job in jobs
    )


SURFACES = (
    Surface("recordings, NWB", _nwb, lambda path: open_recordings(path, conditions="trials:texture"), _bad_counts),
    Surface("recordings, HDF5", _spikes, lambda path: open_recordings(path, conditions="trials:stimulus"), _bad_counts),
    Surface("recordings, counts", _counts, open_recordings, _bad_counts),
    Surface("stimulus set", _stimulus_set, lambda path: load_stimuli(path).input, not_finite),
    Surface("stimulus arrays", _arrays, lambda path: load_stimuli(path).input, not_finite),
    # NaN in activations is a missing value, and the score of such a layer has a status.
    Surface("activations", _activations, read_features, lambda found: False),
    Surface("scene", _text("scene.toml", SCENE), load_scene, _bad_scene),
    *(
        Surface(f"mesh, {suffix[1:].upper()}", _mesh(suffix), lambda path: load_mesh(path, unit="mm"), not_finite)
        for suffix in (".obj", ".stl", ".ply", ".off", ".glb")
    ),
    Surface("WHISKiT names", _run("whisker_ID.csv"), _read_run, _bad_run),
    Surface("WHISKiT table", _run("dynamics/Fx.csv"), _read_run, _bad_run),
    Surface("trajectory", _trajectory, load_trajectory, not_finite),
    Surface("starting angles", _angles, load_initial_angles, not_finite),
    Surface("network, JSON", _json("graph.json", GRAPH), read_graph, _bad_graph),
    Surface("weights", _weights, _load, not_finite),
    Surface(
        "model configuration",
        _json("config.json", {"brainbench_model": 1, "architecture": "zhuang", "options": {"seed": 1}, "version": 1}),
        lambda path: read_config(path.parent),
        not_finite,
    ),
    Surface(
        "training options",
        _text("train.toml", CONFIG),
        lambda path: TrainingConfig.published("zhuang-small", **read_mapping(path)),
        _bad_config,
    ),
    Surface("batch file", _text("batch.toml", BATCH), read_batch, _bad_batch),
    Surface("match, JSON", _json("match.json", {"a": "b", "c": None}), read_match, not_finite),
    Surface("match, CSV", _text("match.csv", "a,b\nc,\n"), read_match, not_finite),
    Surface("manifest", _sweeps("manifest.json"), _read_sweeps, not_finite),
    Surface("shard", _sweeps("train-00000.h5"), _read_sweeps, not_finite),
    Surface(
        "result record",
        _json("record.json", json.loads(make_record().to_json())),
        lambda path: ResultRecord.from_json(read_json(path)),
        _bad_record,
    ),
    Surface(
        "fidelity text",
        _text("fidelity.txt", "fast,links=12,links_per_mm=0.3,time_step=1e-4,solver=quasistatic"),
        _word(Fidelity.parse),
        not_finite,
    ),
    Surface(
        "selection text",
        _text("selection.txt", "outcome=correct|error; units.layer=4; depth=1.5..20; min_spikes=50"),
        _word(Selection.parse),
        lambda value: value.min_spikes < 0,
    ),
    Surface("seeds text", _text("seeds.txt", "0-4,7,9"), _word(parse_seeds), lambda seeds: min(seeds) < 0),
)
