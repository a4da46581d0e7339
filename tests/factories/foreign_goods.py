"""Good inputs of the entrances in :mod:`tests.factories.foreign_commands`, each written into a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from brainbench.benchmarks.opening import make, pack
from brainbench.core.files import write_json
from brainbench.core.identity import content_hash
from brainbench.scoring.options import ScoreOptions
from robotics_bridge import hands
from robotics_bridge.deploy.links.replay import PARTS, SessionFacts, TactilePoints, taxel_names, write_lerobot
from tests.factories import policies, reading_surfaces
from tests.factories.fitted_ringdown import write_ringdown
from tests.factories.hand_gallery import GALLERY
from tests.factories.scored_files import write_study
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
"""m"""
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
SCENE = """[array]
whiskers = "C2"
[whisking]
kind = "track"
path = "angles.csv"
layout = "angles"
whiskers = { C2 = "RC2" }
[frames]
first_ms = 10
interval_ms = 10
count = 5
[[scene]]
label = "played"
"""

checkpoint, log = reading_surfaces._checkpoint, reading_surfaces._log


def _pixels() -> np.ndarray:
    shapes = bent_shapes() / PIXEL
    shapes[..., 1] *= -1
    return shapes


def _traces() -> dict[tuple[int, int], np.ndarray]:
    return {(frame, 0): shape for frame, shape in enumerate(_pixels())}


def whiskerman(folder: Path) -> Path:
    control = np.zeros((12, 3, 3))
    control[:, :2] = _pixels()[:, [0, 4, 9]].transpose(0, 2, 1)
    return write_whiskerman(folder / "track.tr4", control, control[:, :, 0], np.ones(12, bool))


def contract(folder: Path) -> Path:
    return policies.export_small(folder).with_name("policy.onnx.json")


def wrenches(folder: Path) -> Path:
    return write_ringdown(folder / "ringdown.csv")


def points(folder: Path) -> Path:
    return write_points(folder / "track.csv", bent_shapes())


def deeplabcut(folder: Path) -> Path:
    return write_deeplabcut_csv(folder / "track.csv", _pixels(), np.ones((12, 10)))


def deeplabcut_hdf5(folder: Path) -> Path:
    write_deeplabcut_table(folder / "track.h5", _pixels(), np.ones((12, 10)))
    return folder / "track.h5"


def whisk(folder: Path) -> Path:
    write_whiskers(folder / "track.whiskers", _traces())
    return folder / "track.whiskers"


def whisk_labels(folder: Path) -> Path:
    whisk(folder)
    labels = dict.fromkeys(_traces(), 0)
    return write_measurements(folder / "labels.csv", labels, dict.fromkeys(labels, (0.0, 0.0)))


def whiskiwrap(folder: Path) -> Path:
    write_whiskiwrap(folder / "track.h5", _traces(), dict.fromkeys(_traces(), (0.0, 0.0)))
    return folder / "track.h5"


def angles(folder: Path) -> Path:
    (folder / "scene.toml").write_text(SCENE)
    times = 0.002 * np.arange(60)
    table = np.column_stack([times, 90 + 20 * np.sin(50 * times), 5 * np.cos(50 * times)])
    np.savetxt(
        folder / "angles.csv", table, delimiter=",", header="time_s,RC2.theta_deg,RC2.phi_deg", comments="", fmt="%.6g"
    )
    return folder / "angles.csv"


def _recorded(folder: Path) -> tuple[Any, Any, np.ndarray, Any]:
    hand = hands.load(GALLERY["urdf-mimic"].write(folder, "jaws"))
    probes = hand.layout("low", "tips")
    place, normal = ([getattr(each, name)[each.active] for each in probes.values()] for name in ("position", "normal"))
    links = np.repeat(list(probes), [len(each) for each in place])
    places = TactilePoints(tuple(links.tolist()), np.concatenate(place), np.concatenate(normal))
    closing = np.linspace(0.03, 0.0, 10)[:, None].repeat(len(hand.joints), axis=1)
    return hand, probes, closing, places


def replayed(folder: Path) -> Path:
    hand, _, closing, places = _recorded(folder)
    names = ["time", *hand.joints, *taxel_names(places.links)]
    table = np.c_[np.arange(10) / 50, closing, np.ones((10, len(places.links)))]
    np.savetxt(folder / "log.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.6g")
    return folder / "log.csv"


def lerobot(folder: Path) -> Path:
    hand, _, closing, places = _recorded(folder)
    touch = np.zeros((10, len(places.links), 6))
    frames = dict(zip(PARTS, (closing, 0 * closing, closing, touch, np.zeros((10, 6))), strict=True))
    facts = SessionFacts(task="close", fps=50, joints=hand.joints, points=places, robot="jaws", unit="N")
    return write_lerobot(folder / "set", frames, facts) / "meta" / "info.json"


def lerobot_places(folder: Path) -> Path:
    return lerobot(folder).with_name("tactile.json")


def lerobot_frames(folder: Path) -> Path:
    return lerobot(folder).parents[1] / "data" / "chunk-000" / "file-000.parquet"


def model(folder: Path) -> Path:
    (folder / "mine.py").write_text(MODEL)
    return folder / "mine.py"


def settings(folder: Path) -> Path:
    return write_json(folder / "models.json", {"mine": {"target": "mine.py:Mine", "hash": content_hash(model(folder))}})


def graph(folder: Path) -> Path:
    checkpoint(folder)
    return write_json(folder / "graph.json", reading_surfaces.GRAPH)


def run_settings(folder: Path) -> Path:
    graph(folder)
    encoder = {"model_config_file": "configs/rnn_fdb_converted_modern_gru.json"}
    return write_json(folder / "config.json", {"model": {"encoder": encoder}, "train": {"ssl": "SimCLRLoss"}})


def task(folder: Path) -> Path:
    (folder / "task.py").write_text(TASK)
    return folder / "task.py"


def benchmark(folder: Path) -> Path:
    write_study(folder)
    options = ScoreOptions(
        recordings=str(folder / "data"), conditions="trials:texture", stimuli=str(folder / "eight.h5"), seed=1
    )
    words = {"name": "lab", "citation": "Doe J., A Journal 1:2 (2026)", "doi": "10.1/2"}
    (folder / "lab.toml").write_text(make(options, folder / "lab.toml", **words).to_toml())
    return folder / "lab.toml"


def packed(folder: Path) -> Path:
    pack(benchmark(folder), folder / "lab.zip")
    return folder / "lab.zip"
