"""Every reader of users' files: how a small good file is made, how it is read, and which results are faulty."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import shutil
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import torch
from safetensors.torch import save_file

from brainbench.cli.options import numbers as option_numbers
from brainbench.core import identity
from brainbench.core.contracts import read_match
from brainbench.core.errors import DataError
from brainbench.core.files import read_mapping
from brainbench.core.identity import SealedPlan
from brainbench.core.reading.tensors import read_tensors
from brainbench.core.records import ResultRecord, record_identity
from brainbench.core.runs.folder import STATE
from brainbench.datasets import export, open_recordings, write_recordings
from brainbench.datasets.trials.selection import Selection, Window
from brainbench.datasets.whisking.dataset import WhiskingDataset
from brainbench.geometry.mesh import convex_hull, load_mesh, save_mesh
from brainbench.models.features import read_features, write_features
from brainbench.models.graph.tnn_import import read_graph
from brainbench.models.registry import load_model
from brainbench.models.training.batches import Processes
from brainbench.models.training.checkpoints import WEIGHTS, find_folder, load_weights, read_config
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.trainer import _Run
from brainbench.published import conversion
from brainbench.published.checkpoint_import import (
    build_published,
    import_checkpoint,
    read_settings,
    read_weights,
    recognise,
)
from brainbench.published.estimator import explain_file
from brainbench.published.whiskit import read_runs
from brainbench.scoring.jobs import parse_seeds, read_batch
from brainbench.scoring.recovery.boards import parse_trials
from brainbench.stimuli import WhiskerArray, load_stimuli
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.recorded import load_initial_angles, load_trajectory
from brainbench.stimuli.objects.collections import read_categories, read_ids, resolve_objects
from brainbench.stimuli.scenes.scene_files import load_scene
from brainbench.stimuli.stimulus_set import hash_stimulus_set, write_stimulus_set
from leaderboards import build_leaderboard, read_records
from leaderboards.held_out import Commitment
from leaderboards.site.build import MANIFEST, check_site
from robotics_bridge import hands, tasks
from robotics_bridge.deploy.links.simulated_hand import Faults
from robotics_bridge.deploy.links.udp import KEY, read_key
from robotics_bridge.hands.layouts import read_probes, write_probes
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.training.distill import load_student
from robotics_bridge.policies.training.distill_config import read_sweep
from robotics_bridge.sensors.calibration.calibrate import read_log
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.tasks.registry import apply_overrides
from tests.factories.hand_gallery import GALLERY
from tests.factories.policies import contract_of, student_folder
from tests.factories.published_files import lightning_state, make_zero_filled, write_published, write_run, write_sweep
from tests.factories.reading_trials import Surface, bad_counts, not_finite, numbers, written, written_json
from tests.factories.recordings import make_simple_session, write_nwb
from tests.factories.records import make_record
from tests.factories.scene_files import POLE
from tests.factories.scored_files import write_arrays
from tests.factories.sweep_batches import small_set
from tests.factories.training_sweeps import tiny

SCENE = POLE.replace("interval_ms = 1", "interval_ms = 1\naverage = 2\nlowpass_hz = 40")
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
MODEL = {"brainbench_model": 1, "architecture": "zhuang", "options": {"seed": 1}, "version": 1}
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
CLASSES = "name,label\n02691156,plane\n03001627/bb,seat\n"


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


def _spikes(folder: Path) -> Path:
    return write_recordings(folder / "spikes.h5", make_simple_session())


def _counts(folder: Path) -> Path:
    return write_recordings(
        folder / "counts.h5", open_recordings(_spikes(folder), conditions="trials:stimulus", bin=0.25)
    )


def _stimulus_set(folder: Path) -> Path:
    dataset = load_stimuli("rodgers", whiskers="C*").dataset
    return write_stimulus_set(dataset.assign_attrs(content_hash=hash_stimulus_set(dataset)), folder / "set.h5")


def _activations(folder: Path) -> Path:
    layers = {"one": np.arange(8.0).reshape(4, 2), "two": np.ones((4, 3, 2), np.float32)}
    return write_features(folder / "features.h5", list("abcd"), layers)


def _mesh(suffix: str, folder: Path) -> Path:
    tetrahedron = convex_hull(np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]]))
    return save_mesh(folder / f"mesh{suffix}", tetrahedron, unit="mm")


def _run(folder: Path) -> Path:
    return write_run(folder / "run", np.random.default_rng(0).normal(size=(110, 2, 6)))


def _bad_run(dataset: Any) -> bool:
    good = np.isfinite(dataset["wrench"].values).all(axis=-1) | (dataset["frame_status"].values != 0)
    return not good.all()


def _table(columns: int, folder: Path) -> Path:
    np.savetxt(folder / "table.csv", np.random.default_rng(0).normal(size=(62, columns)), delimiter=",", fmt="%.4g")
    return folder / "table.csv"


def _model() -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4))


def _weights(folder: Path) -> Path:
    save_file(_model().state_dict(), folder / "model.safetensors")
    return folder / "model.safetensors"


def _load(path: Path) -> Any:
    model = _model()
    load_weights(model, path, what="test")
    return dict(model.state_dict())


def _training_run(folder: Path) -> _Run:
    options: dict[str, Any] = {"epochs": 1, "batch_size": 12, "precision": "float32", "optimizer": "adamw"}
    where = Processes(0, 1, torch.device("cpu"))
    with torch.random.fork_rng():
        run = _Run(
            TrainingConfig.published("zhuang-small", "supervised", **options), tiny(), folder, where, None, folder
        )
    run.log.close()
    return run


def _training(folder: Path) -> Path:
    run = _training_run(folder)
    for weight in run.learner.parameters():
        weight.grad = torch.zeros_like(weight)
    run.optimizer.step()
    run._save()
    return folder / STATE


def _go_on(path: Path) -> Any:
    run = _training_run(path.parent)
    run.optimizer.step()
    return run


def _bad_training(run: _Run) -> bool:
    return not_finite([run.learner.state_dict(), run.optimizer.state_dict()]) or min(run.at.step, run.at.epoch) < 0


def _sweeps(name: str, folder: Path) -> Path:
    return shutil.copytree(small_set(), folder, dirs_exist_ok=True) / name


def _read_sweeps(path: Path) -> Any:
    data = WhiskingDataset(path.parent, split="train", batch_size=4, shuffle=False)
    data.verify()
    return next(iter(data))


def _bad_graph(spec: Any) -> bool:
    sizes = [getattr(node.operation, name, 1) for node in spec.nodes for name in ("channels", "features")]
    sizes += [n for node in spec.nodes for n in (*getattr(node.operation, "kernel_size", ()), *spec.input_shape)]
    sizes += [n for node in spec.nodes if node.pool for n in (*node.pool.size, *(node.pool.stride or ()))]
    return not_finite(spec) or any(type(size) is not int or not 1 <= size <= 10**6 for size in sizes)


def _read_record(path: Path) -> ResultRecord:
    """Read a record under the name that its content gives it: whoever damages one can rename it too."""
    with contextlib.suppress(ValueError, LookupError, TypeError, AttributeError, RecursionError, OSError):
        fitting = f"x--{record_identity(json.loads(path.read_text()))}.json" if path.is_file() else path.name
        path = path.rename(path.with_name(fitting))
    (stored,) = read_records(path)
    if stored.record is None:
        raise DataError(stored.problem)
    return stored.record


def _bad_record(record: Any) -> bool:
    return any(math.isinf(n) for n in numbers(record))


def _plan_file(folder: Path) -> Path:
    plan = SealedPlan(
        "power", 4, 3, layer="area", names=("a", "b", "c", "d"), models=("zhuang-small",), units=5, trials=8,
        expected={"0.2": 0.8}, command="brainbench power --plan p.json",
    )  # fmt: skip
    return plan.write(folder / "plan.json")


def _read_plan(path: Path) -> SealedPlan:
    """Read a plan under the hash that its content has: whoever edits one can seal it again."""
    with contextlib.suppress(ValueError, TypeError, AttributeError, RecursionError, OSError):
        if path.is_file():
            data = json.loads(path.read_text())
            data.pop("hash", None)
            path.write_text(json.dumps({**data, "hash": identity._hash(data)}))
    return SealedPlan.read(path)


def _ask_hub(name: str) -> tuple[Path, list[str]]:
    """Return the folder that a name is taken for by a hub that has everything, and what was ordered there."""
    orders: list[str] = []

    def download(repository: str, *, revision: str | None = None, allow_patterns: Any = ()) -> str:
        orders.extend((repository, revision or "", *allow_patterns))
        return "hub"

    with mock.patch.dict(sys.modules, huggingface_hub=SimpleNamespace(snapshot_download=download)):
        return find_folder(name), orders


def _bad_order(answer: tuple[Path, list[str]]) -> bool:
    folder, orders = answer
    odd = any(".." in order.split("/") or not order.isascii() or not order.isprintable() for order in orders)
    return odd or ".." in folder.parts


SETTINGS = """
model:
  encoder:
    model_config_file: configs/rnn_fdb_converted_modern_ugrnn_ln.json
train:
  ssl: SimCLRLoss
  epochs: 100
  learning_rate: 0.01
"""


def _recordings(folder: Path) -> Path:
    return write_published(folder / "rodgers6_data.npz", m1=make_zero_filled([14, 12], units=3)[0])


def _tree(folder: Path) -> Path:
    for name in ("train", "test"):
        write_sweep(folder / name / "00000000.npz")
    (folder / "categories.json").write_text('{"03211117/screen": 0, "04530566/boat": 2}')
    return folder / "categories.json"


def _halves(folder: Path) -> Path:
    draw = np.random.default_rng(0)
    np.savez(folder / "splits.npz", r_xy=draw.uniform(0, 1, 20), r_yy=draw.uniform(0, 1, 20))
    return folder / "splits.npz"


@functools.cache
def _state() -> dict[str, torch.Tensor]:
    with torch.random.fork_rng():
        return lightning_state(load_model("zhuang-gru-small", classes=3))


def _checkpoint(folder: Path) -> Path:
    torch.save({"state_dict": dict(_state()), "epoch": 6, "global_step": 50}, folder / "best.ckpt")
    return folder / "best.ckpt"


def _import(path: Path) -> Any:
    weights = read_weights(path)
    return weights, build_published(weights.state, recognise(weights.state, architecture="zhuang-gru-small"))[
        0
    ].state_dict()


def _import_to_folder(path: Path) -> dict[str, torch.Tensor]:
    made = import_checkpoint(path, architecture="zhuang-gru-small", out=path.parent / "imported")
    return read_tensors(made.folder / WEIGHTS)


def _bad_published_sweep(sweep: conversion.SweepFile) -> bool:
    """Forces are finite or missing, and stay within what is trusted; conditions and label are numbers."""
    label = 0 if sweep.label is None else sweep.label
    return not_finite(sweep.conditions) or np.isinf(sweep.wrench()).any() or not 0 <= label < 2**31


CHANGES = (
    "is_dropped=-300 rotation_progress.clip=2 episode=15 entropy=0 learning_rate_range=1e-4,1e-3 friction=0.8 "
    "object_changes.friction=0.8,1 density=300 noise.position=0.01 hidden=64,32 copies=1 solver.timestep=0.004"
)
STUDENTS = """
types = ["agg_force", "bool"]
resolutions = ["low", "med"]
noisy = [false, true]
seeds = [0, 1]
teacher = "teachers/{task}-{hand}"
pinned = { resolution = "med", noisy = true }
settings = { iterations = 300, num_envs = 16 }
[encoders]
types = ["agg_force"]
arms = [{ encoder = "mlp" }]
[[entries]]
task = "in_palm_rotate"
hand = "xhand1"
placements = ["tips", "hand"]
"""
_OF_HAND = (
    "body_pos", "body_quat", "body_mass", "body_inertia", "geom_size", "geom_pos", "geom_friction", "jnt_range",
    "jnt_axis", "dof_damping", "dof_armature", "actuator_gainprm", "actuator_ctrlrange",
)  # fmt: skip


def _probes(folder: Path) -> Path:
    write_probes(folder / "probes.json", hands.load("xhand1").layout("low", "tips"))
    return folder / "probes.json"


def _bad_layout(layout: Any) -> bool:
    return not_finite(layout) or any((probes.radius < 0).any() for probes in layout.values())


def _log(folder: Path) -> Path:
    draw, times = np.random.default_rng(0), 0.01 * np.arange(60)
    signal = np.where(np.sin(5 * times) > 0, np.sin(5 * times), 0.0)
    table = np.column_stack([times, signal, signal[:, None] + 0.01 * draw.normal(size=(60, 3))])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="time,reference,p1,p2,p3", comments="", fmt="%.5f")
    return folder / "log.csv"


def _noise(folder: Path) -> Path:
    Noise.preset("published-elastomer").save(folder / "noise.json", sensor="x")
    return folder / "noise.json"


def _read_hand(path: Path) -> Any:
    hand = hands.load(path)
    return {name: getattr(hand.model, name) for name in _OF_HAND} | {"probes": hand.layout("low")}


def _bad_hand(values: Any) -> bool:
    return not_finite(values) or (values["body_mass"] < 0).any() or (values["geom_friction"] < 0).any()


def _student(name: str) -> Any:
    return lambda folder: student_folder(folder) / name


def _load_student(path: Path) -> Any:
    student, described = load_student(path.parent)
    return dict(student.state_dict()), described


def _key(folder: Path) -> Path:
    path = folder / "hand.key"
    path.write_text("0f" * KEY)
    path.chmod(0o600)
    return path


def _bad_contract(contract: PolicyContract) -> bool:
    return any(not math.isfinite(n) for n in numbers(contract)) or contract.rate <= 0


def _typed(name: str, text: str, read: Any, faults: Any = not_finite) -> Surface:
    """Return the surface of a text that a user types: any text, from a file whose damage may be no text at all."""

    def read_file(path: Path) -> Any:
        return read(path.read_bytes().decode(errors="replace")[:100_000] if path.is_file() else "")

    return Surface(name, written(f"{name.partition(' ')[0]}.txt", text), read_file, faults)


SURFACES = (
    Surface(
        "recordings, NWB", lambda folder: write_nwb(folder / "sub-m1_ses-s1.nwb"),
        lambda path: open_recordings(path, conditions="trials:texture"), bad_counts,
    ),
    Surface("recordings, HDF5", _spikes, lambda path: open_recordings(path, conditions="trials:stimulus"), bad_counts),
    Surface("recordings, counts", _counts, open_recordings, bad_counts),
    Surface(
        "recordings, copied", _spikes, lambda path: export([path], path.with_name("copy.h5")),
        lambda copies: not copies[0].is_file(),
    ),
    Surface("stimulus set", _stimulus_set, lambda path: load_stimuli(path).input),
    Surface(
        "stimulus arrays", lambda folder: write_arrays(folder / "arrays.h5", "abcd"),
        lambda path: load_stimuli(path).input,
    ),
    # NaN in activations is a missing value, and the score of such a layer has a status.
    Surface(
        "activations", _activations, read_features,
        lambda features: any(np.isinf(layer).any() for layer in features.activations.values()),
    ),
    Surface("scene", written("scene.toml", SCENE), lambda path: list(load_scene(path).scenes)),
    *(
        Surface(f"mesh, {suffix[1:].upper()}", partial(_mesh, suffix), lambda path: load_mesh(path, unit="mm"))
        for suffix in (".obj", ".stl", ".ply", ".off", ".glb")
    ),
    Surface(
        "WHISKiT names", lambda folder: _run(folder) / "whisker_ID.csv",
        lambda path: read_runs([path.parent]), _bad_run,
    ),
    Surface(
        "WHISKiT table", lambda folder: _run(folder) / "dynamics" / "Fx.csv",
        lambda path: read_runs([path.parents[1]]), _bad_run, inside=1,
    ),
    Surface("trajectory", partial(_table, 12), load_trajectory),
    Surface("starting angles", partial(_table, 3), load_initial_angles),
    Surface("network, JSON", written_json("graph.json", GRAPH), read_graph, _bad_graph),
    Surface("weights", _weights, _load),
    Surface("model configuration", written_json("config.json", MODEL), lambda path: read_config(path.parent)),
    Surface(
        "training options", written("train.toml", CONFIG),
        lambda path: TrainingConfig.published("zhuang-small", **read_mapping(path)),
    ),
    Surface("training state", _training, _go_on, _bad_training),
    Surface("batch file", written("batch.toml", BATCH), read_batch),
    Surface("plan", _plan_file, _read_plan),
    _typed("hub name", "hf-hub:owner/model/inner@main", _ask_hub, _bad_order),
    Surface("match, JSON", written_json("match.json", {"a": "b", "c": None}), read_match),
    Surface("match, CSV", written("match.csv", "a,b\nc,\n"), read_match),
    Surface(
        "ShapeNet names", written("ids.txt", "02691156/1a04e3\n03001627/bb # a chair\n"), read_ids, lambda found: False
    ),
    Surface("ShapeNet classes, CSV", written("classes.csv", CLASSES), read_categories, lambda found: False),
    Surface("ShapeNet classes, JSON", written_json("classes.json", {"02691156": "a"}), read_categories),
    Surface("manifest", partial(_sweeps, "manifest.json"), _read_sweeps),
    Surface("shard", partial(_sweeps, "train-00000.h5"), _read_sweeps),
    Surface(
        "result record", written_json("record.json", json.loads(make_record().to_json())), _read_record, _bad_record
    ),
    Surface(
        "site manifest", lambda folder: build_leaderboard([make_record()], folder / "site").with_name(MANIFEST),
        lambda path: check_site(path.parent), lambda checked: not checked[1],
    ),
    Surface(
        "commitment", written_json("held-out.json", Commitment("animals", 3, 8, "9f3c2a7be1d04455", "0f" * 32).plain),
        Commitment.read,
    ),
    _typed("fidelity text", "fast,links=12,links_per_mm=0.3,time_step=1e-4,solver=quasistatic", Fidelity.parse),
    _typed("selection text", "outcome=correct|error; units.layer=4; depth=1.5..20; min_spikes=50", Selection.parse),
    _typed("seeds text", "0-4,7,9", parse_seeds, lambda seeds: min(seeds) < 0),
    _typed("window text", "first-contact-0.1..choice+0.25", Window.parse),
    _typed("trials text", "16-20", parse_trials, lambda rows: min(numbers(rows)) < 1),
    _typed(
        "whiskers text", "C1-C3,D*,*2", lambda text: WhiskerArray.mouse(whiskers=text), lambda array: not len(array)
    ),
    _typed("objects text", "torus:20", lambda text: resolve_objects([text]), lambda objects: not objects),
    _typed("numbers text", "0.5,1e-3,20", lambda text: option_numbers(text, "--steps", float)),
    Surface("published recordings, npz", _recordings, open_recordings, bad_counts),
    Surface(
        "published sweep, npz", lambda folder: write_sweep(folder / "0.npz"), conversion.read_sweep,
        _bad_published_sweep,
    ),
    Surface(
        "published sweeps, categories", _tree, lambda path: conversion.open_sweep_tree(path.parent).classes,
        lambda names: len(names) > 1000,
    ),
    Surface("split halves, npz", _halves, explain_file, lambda steps: np.isinf([*numbers(steps)]).any()),
    Surface("published weights, ckpt", _checkpoint, _import),
    Surface("published weights, imported", _checkpoint, _import_to_folder),
    Surface("published settings, YAML", written("config.yaml", SETTINGS), read_settings),
    _typed("change text", CHANGES, lambda text: apply_overrides(tasks.load("in_palm_rotate"), text.split())),
    _typed(
        "fault text", "drop=0.2 jitter=0.03 silent-after=2 seed=3", lambda text: Faults.parse(text.split())
    ),
    Surface("hand, URDF", written("hand.urdf", GALLERY["urdf-mimic"].text), _read_hand, _bad_hand),
    Surface("hand, MJCF", written("hand.xml", GALLERY["coupled-jaws"].text), _read_hand, _bad_hand),
    Surface("probe layout", _probes, read_probes, _bad_layout),
    Surface("calibration log", _log, read_log),
    Surface("noise preset", _noise, Noise.load),
    Surface("contract", written_json("policy.onnx.json", contract_of()), PolicyContract.read, _bad_contract),
    Surface("student, configuration", _student("config.json"), _load_student),
    Surface("student, weights", _student("model.safetensors"), _load_student),
    Surface("sweep of students", written("students.toml", STUDENTS), lambda path: read_sweep(path).students()),
    Surface("key of a hand", _key, read_key, lambda key: len(key) != KEY),
)  # fmt: skip
