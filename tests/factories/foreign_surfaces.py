"""Readers of what others send beside recordings: contracts, students, layouts, logs, tracks, episodes, models."""

from __future__ import annotations

import json
import os
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas

from brainbench.cli.policy.options import read_task_file
from brainbench.core.errors import DataError, visible
from brainbench.core.files import read_mapping
from brainbench.models.registry import add_user_model, read_user_models
from brainbench.models.training.checkpoints import find_folder
from brainbench.published.checkpoint_import import read_settings
from brainbench.stimuli import Whisker
from brainbench.stimuli.fitting.trials import Trial, read_wrenches
from brainbench.stimuli.motion.recorded import PlayOptions, load_angles
from brainbench.stimuli.tracks.readers import TrackOptions, read_shapes
from robotics_bridge import hands, tasks
from robotics_bridge.deploy.links.episodes import PARTS, SessionFacts, TactilePoints, write_lerobot
from robotics_bridge.sensors.calibration.calibrate import calibrate
from robotics_bridge.sensors.calibration.log import read_log
from tests.factories.reading_surfaces import SURFACES
from tests.factories.reading_trials import Surface, not_finite, numbers, typed, written, written_json
from tests.factories.whisker_tracks import (
    bent_shapes,
    write_deeplabcut_csv,
    write_deeplabcut_table,
    write_measurements,
    write_points,
    write_whiskerman,
    write_whiskers,
    write_whiskiwrap,
)

PIXEL = 5e-5
WHISKER = Whisker(0.02, 5e-5, 5e-6, 3e9, 1200.0, 0.1)
LARGEST_FORCE = 1e3
"""N and N·m that no whisker's base feels; mice weigh 0.2 N."""
FARTHEST = 1e3
"""m and rad beyond which no traced point, probe or angle of one is."""
MODEL = """import torch


class Mine(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.read = torch.nn.Linear(6, 3)

    def forward(self, x):
        return self.read(x.flatten(3).mean(dim=(1, 3)))
"""
TASK = """from dataclasses import replace

from robotics_bridge import tasks

TASK = replace(tasks.load("in_palm_rotate"), name="foreign")


@tasks.register("foreign")
def foreign():
    return TASK
"""


def _tracked(folder: Path, write: Callable[..., Any], name: str, *values: Any) -> Path:
    write(folder / name, *values)
    return folder / name


def _pixels() -> np.ndarray:
    shapes = bent_shapes() / PIXEL
    shapes[..., 1] *= -1
    return shapes


def _traces() -> dict[tuple[int, int], np.ndarray]:
    return {(frame, 0): shape for frame, shape in enumerate(_pixels())}


def _labelled(folder: Path) -> Path:
    traces = _traces()
    write_whiskers(folder / "track.whiskers", traces)
    return write_measurements(folder / "labels.csv", dict.fromkeys(traces, 0), dict.fromkeys(traces, (0.0, 0.0)))


def _control(folder: Path) -> Path:
    control = np.zeros((12, 3, 3))
    control[:, :2] = _pixels()[:, [0, 4, 9]].transpose(0, 2, 1)
    return write_whiskerman(folder / "track.tr4", control, control[:, :, 0], np.ones(12, bool))


def _shapes(path: Path, **options: Any) -> Any:
    shapes = read_shapes(path, TrackOptions(metres_per_pixel=PIXEL, frame_rate=500.0, **options))
    # A shape that is far from what a whisker can be is refused by whoever fits it.
    Trial.ringdown(WHISKER, shapes.isel(time=slice(1, None)), 1e-3)
    return shapes


def _bad_shapes(shapes: Any) -> bool:
    values, times = shapes["shape"].values, shapes["time"].values
    return bool(np.nanmax(np.abs(values)) > FARTHEST or np.isinf(values).any() or (np.diff(times) <= 0).any())


def _wrenches(folder: Path) -> Path:
    times = 0.002 * np.arange(60)
    table = np.column_stack([times, 1e-5 * np.sin(200 * times), 1e-5 * np.cos(200 * times), 1e-7 * np.sin(200 * times)])
    np.savetxt(folder / "wrench.csv", table, delimiter=",", header="time,Fx,Fy_mN,Mz", comments="", fmt="%.6g")
    return folder / "wrench.csv"


def _bad_wrenches(wrenches: Any) -> bool:
    values, times = wrenches["wrench"].values, wrenches["time"].values
    return bool(np.nanmax(np.abs(values)) > LARGEST_FORCE or np.isinf(values).any() or (np.diff(times) <= 0).any())


def _angles(folder: Path) -> Path:
    times = 0.002 * np.arange(60)
    table = np.column_stack([times, 90 + 20 * np.sin(50 * times), 5 * np.cos(50 * times)])
    np.savetxt(
        folder / "angles.csv", table, delimiter=",", header="time_s,RC2.theta_deg,RC2.phi_deg", comments="", fmt="%.6g"
    )
    return folder / "angles.csv"


def _bad_angles(tracked: Any) -> bool:
    return any(abs(number) > 1e6 for number in numbers(tracked))


def _log(folder: Path) -> Path:
    draw, times = np.random.default_rng(0), 0.01 * np.arange(60)
    signal = np.where(np.sin(5 * times) > 0, np.sin(5 * times), 0.0)
    table = np.column_stack([times, signal, signal[:, None] + 0.01 * draw.normal(size=(60, 3))])
    np.savetxt(folder / "log.csv", table, delimiter=",", header="time,reference,p1,p2,p3", comments="", fmt="%.5f")
    return folder / "log.csv"


def _calibrated(path: Path) -> Any:
    return calibrate(read_log(path)).noise


def _layout(path: Path) -> Any:
    return hands.load("xhand1").layout(str(path))


def _bad_layout(layout: Any) -> bool:
    return not layout or any(abs(number) > FARTHEST for number in numbers({**layout})) or not_finite(layout)


def _probes(folder: Path) -> Path:
    (surface,) = (surface for surface in SURFACES if surface.name == "probe layout")
    return surface.make(folder)


EPISODE: dict[str, Any] = {
    "frames": {
        name: np.full(shape, 0.5).tolist()
        for name, shape in zip(PARTS, ((3, 2), (3, 2), (3, 2), (3, 2, 6), (3, 6)), strict=True)
    },
    "facts": {"task": "turn", "fps": 40, "joints": ["a", "b"], "robot": "claw", "unit": "N"},
    "points": {"links": ["tip", "tip"], "position": [[0.0, 0, 0]] * 2, "normal": [[0.0, 0, 1]] * 2},
}


def _written_episode(folder: Path, frames: Any, facts: Any, places: Any) -> Path:
    return write_lerobot(folder, frames, SessionFacts(points=TactilePoints(**places), **facts))


def _episode(path: Path) -> Any:
    told = read_mapping(path)
    frames, facts, places = (told.get(name) for name in ("frames", "facts", "points"))
    kinds = ((frames, PARTS), (facts, EPISODE["facts"]), (places, EPISODE["points"]))
    if not all(isinstance(given, dict) and set(given) == set(names) for given, names in kinds):
        raise DataError("Other names than those of Python's arguments.")
    folder = _written_episode(path.parent / "set", frames, facts, places)
    table = pandas.read_parquet(folder / "data" / "chunk-000" / "file-000.parquet")
    info, tactile = (json.loads((folder / "meta" / f"{name}.json").read_text()) for name in ("info", "tactile"))
    assert set(table.columns) == set(info["features"])
    assert len(table) == info["total_frames"]
    assert all(len(tactile[name]) == len(tactile["links"]) for name in ("position", "normal"))
    return np.stack(list(table["action"])).astype(float)


def _settings(folder: Path) -> Path:
    return written_json("models.json", {"mine": {"target": str(folder / "mine.py") + ":Mine", "hash": "0" * 16}})(
        folder
    )


def _kept_models(path: Path) -> Any:
    with _SettingsIn(path.parent):
        return {name: model.target for name, model in read_user_models().items()}


class _SettingsIn:
    def __init__(self, folder: Path) -> None:
        self.folder, self.before = folder, os.environ.get("BRAINBENCH_CONFIG")

    def __enter__(self) -> None:
        os.environ["BRAINBENCH_CONFIG"] = str(self.folder)

    def __exit__(self, *error: object) -> None:
        del os.environ["BRAINBENCH_CONFIG"]
        if self.before is not None:
            os.environ["BRAINBENCH_CONFIG"] = self.before


def _added(path: Path) -> Any:
    with _SettingsIn(path.parent):
        add_user_model(f"{path}:Mine", "mine", names=())
        return read_user_models()["mine"].hash


def _task(path: Path) -> Any:
    try:
        read_task_file(path)
        return tasks.load("foreign") if "foreign" in tasks.list_tasks() else None
    finally:
        tasks.forget("foreign")


def _hub(text: str) -> Any:
    """Return what a name is taken for by a hub that has everything: repository, revision and folder."""
    orders: list[str] = []

    def download(repository: str, *, revision: str | None, allow_patterns: list[str]) -> str:
        orders.extend((repository, revision or "", *allow_patterns))
        return "/srv/hub"

    before = sys.modules.get("huggingface_hub")
    sys.modules["huggingface_hub"] = types.SimpleNamespace(snapshot_download=download)  # type: ignore[assignment]
    try:
        return orders, find_folder(text)
    finally:
        del sys.modules["huggingface_hub"]
        if before is not None:
            sys.modules["huggingface_hub"] = before


def _leads_away(found: tuple[list[str], Path]) -> bool:
    orders, folder = found
    odd = any(".." in order.split("/") or visible(order) != order or not order.isascii() for order in orders)
    return odd or (bool(orders) and ".." in folder.parts)


def _run_settings(folder: Path) -> Path:
    return written_json(
        "config.json",
        {
            "model": {"encoder": {"model_config_file": "configs/rnn_fdb_converted_modern_ugrnn_ln.json"}},
            "train": {"ssl": "SimCLRLoss", "epochs": 100},
        },
    )(folder)


def _again(name: str, faults: Callable[[Any], bool] | None = None) -> Surface:
    (surface,) = (surface for surface in SURFACES if surface.name == name)
    return surface if faults is None else Surface(name, surface.make, surface.read, faults)


FOREIGN = (
    _again("contract"),
    _again("student, configuration"),
    _again("student, weights"),
    Surface("probe layout", _probes, _layout, _bad_layout),
    Surface("calibration log", _log, _calibrated, not_finite),
    Surface("fit table", _wrenches, read_wrenches, _bad_wrenches),
    Surface(
        "track, points", lambda folder: _tracked(folder, write_points, "track.csv", bent_shapes()), _shapes, _bad_shapes
    ),
    Surface(
        "track, DeepLabCut",
        lambda folder: _tracked(folder, write_deeplabcut_csv, "track.csv", _pixels(), np.ones((12, 10))),
        _shapes,
        _bad_shapes,
    ),
    Surface(
        "track, DeepLabCut HDF5",
        lambda folder: _tracked(folder, write_deeplabcut_table, "track.h5", _pixels(), np.ones((12, 10))),
        _shapes,
        _bad_shapes,
    ),
    Surface(
        "track, whisk",
        lambda folder: _tracked(folder, write_whiskers, "track.whiskers", _traces()),
        _shapes,
        _bad_shapes,
    ),
    Surface(
        "track, whisk's measurements",
        _labelled,
        lambda path: _shapes(path.with_name("track.whiskers"), identities=str(path), track="0"),
        _bad_shapes,
    ),
    Surface(
        "track, WhiskiWrap",
        lambda folder: _tracked(folder, write_whiskiwrap, "track.h5", _traces(), dict.fromkeys(_traces(), (0.0, 0.0))),
        _shapes,
        _bad_shapes,
    ),
    Surface("track, WhiskerMan", _control, lambda path: _shapes(path, track="1"), _bad_shapes),
    Surface("track, angles", _angles, lambda path: load_angles(path, PlayOptions()), _bad_angles),
    Surface("episode", written_json("episode.json", EPISODE), _episode, not_finite),
    Surface("models add, settings", _settings, _kept_models, not_finite),
    Surface("models add, file", written("mine.py", MODEL), _added, lambda told: len(told) != 16),
    _again("published weights, imported"),
    Surface("models import, settings", _run_settings, read_settings, not_finite),
    _again("network, JSON"),
    Surface("task file", written("task.py", TASK), _task, not_finite),
    Surface("hub name", written("name.txt", "hf-hub:owner/model/inner@main"), typed(_hub), _leads_away),
    _again("manifest"),
    _again("batch file"),
    _again("sweep of students"),
)
