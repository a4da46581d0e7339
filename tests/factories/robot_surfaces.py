"""Readers of files and texts about hands and policies."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from robotics_bridge import hands, tasks
from robotics_bridge.deploy.links.simulated_hand import Faults
from robotics_bridge.deploy.links.udp import KEY, read_key
from robotics_bridge.hands.layouts import read_probes, write_probes
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.training.distill import load_student
from robotics_bridge.policies.training.distill_config import StudentSweep, read_sweep
from robotics_bridge.sensors.calibration.calibrate import read_log
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.tasks.registry import apply_overrides
from tests.factories.hand_gallery import GALLERY
from tests.factories.policies import contract_of, student_folder
from tests.factories.reading_trials import Surface, not_finite, numbers, typed, written, written_json

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
_MODEL = (
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


def _bad_noise(noise: Noise) -> bool:
    return not_finite(noise) or not 0 <= noise.dead_probability <= 1 or min(noise.white, noise.walk, noise.quantum) < 0


def _read_hand(path: Path) -> Any:
    hand = hands.load(path)
    return {name: getattr(hand.model, name) for name in _MODEL} | {"probes": hand.layout("low")}


def _bad_hand(values: Any) -> bool:
    return not_finite(values) or (values["body_mass"] < 0).any() or (values["geom_friction"] < 0).any()


def _change(text: str) -> Any:
    return apply_overrides(tasks.load("in_palm_rotate"), text.split())


def _bad_task(task: Any) -> bool:
    counts = (task.teacher.num_envs, task.teacher.epochs, task.teacher.minibatches, *task.teacher.hidden, task.copies)
    return (
        not_finite(task)
        or min(counts) < 1
        or min(task.friction, task.noise.position, task.teacher.entropy, *task.object_changes.friction) < 0
        or min(task.density, task.episode, task.solver.timestep) <= 0
    )


def _student(name: str) -> Any:
    return lambda folder: student_folder(folder) / name


def _load_student(path: Path) -> Any:
    student, described = load_student(path.parent)
    return dict(student.state_dict()), described


def _bad_sweep(sweep: StudentSweep) -> bool:
    students = sweep.students()
    return not_finite([vars(one) for one in students]) or any(
        one.seed < 0 or one.iterations < 1 or one.num_envs < 1 for one in students
    )


def _key(folder: Path) -> Path:
    path = folder / "hand.key"
    path.write_text("0f" * KEY)
    path.chmod(0o600)
    return path


def _bad_contract(contract: PolicyContract) -> bool:
    return any(not math.isfinite(n) for n in numbers(contract)) or contract.rate <= 0


ROBOTS = (
    Surface("change text", written("change.txt", CHANGES), typed(_change), _bad_task),
    Surface(
        "fault text",
        written("fault.txt", "drop=0.2 jitter=0.03 silent-after=2 seed=3"),
        typed(lambda text: Faults.parse(text.split())),
    ),
    Surface("hand, URDF", written("hand.urdf", GALLERY["urdf-mimic"].text), _read_hand, _bad_hand),
    Surface("hand, MJCF", written("hand.xml", GALLERY["coupled-jaws"].text), _read_hand, _bad_hand),
    Surface("probe layout", _probes, read_probes, _bad_layout),
    Surface("calibration log", _log, read_log),
    Surface("noise preset", _noise, Noise.load, _bad_noise),
    Surface("contract", written_json("policy.onnx.json", contract_of()), PolicyContract.read, _bad_contract),
    Surface("student, configuration", _student("config.json"), _load_student),
    Surface("student, weights", _student("model.safetensors"), _load_student),
    Surface("sweep of students", written("students.toml", STUDENTS), read_sweep, _bad_sweep),
    Surface("key of a hand", _key, read_key, lambda key: len(key) != KEY),
)
