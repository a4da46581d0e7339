"""Whiskers in slices as a GPU takes them, recorded and by several threads, played on a processor."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from brainbench.core.devices import warp
from brainbench.core.files import content_hash, portable
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod import launch, slices, sweeps
from brainbench.stimuli.engines.rod.sweeps import SweepLauncher
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepGrid, SweepScenes

GRID = SweepGrid(speed=(0.06,), rotation=(0.0, 0.4), distance=(0.005,), size=(0.04,))
COARSE = Fidelity(links=10, time_step=1e-3)


class _Event:
    """An event that has come when it was asked for once."""

    def __init__(self, device):
        self.device, self.asked = device, 0

    @property
    def is_complete(self):
        self.asked += 1
        return self.asked % 2 == 0


class _Stream:
    def __init__(self, device):
        self.device = device

    def wait_stream(self, other):
        assert other is None or isinstance(other, _Stream)

    def record_event(self, event=None):
        return event or _Event(self.device)


@pytest.fixture
def as_a_gpu(monkeypatch):
    """Streams, turns and late counts as on a GPU; graphs are those that Warp records for processors."""
    lock = threading.RLock()
    for module in (slices, launch, slices):
        monkeypatch.setattr(module, "lock_of", lambda device: lock)
    own = threading.local()

    def streams_of(device, side, priority):
        if not hasattr(own, "made"):
            counts = [warp().zeros(3, dtype=int, device="cpu") for _ in range(slices.AHEAD + 1)]
            side_streams = [_Stream(device) for _ in range(side)]
            own.made = _Stream(device), side_streams, [(_Event(device), each) for each in counts]
        return own.made

    monkeypatch.setattr(slices, "streams_of", streams_of)
    monkeypatch.setattr(type(warp().get_device("cpu")), "stream", None)
    monkeypatch.setattr(slices, "SMALL", 8)


def _launch(scenes, name, **tuning):
    launcher = SweepLauncher(scenes, COARSE, sliced=True)
    launcher.solver.tuning = tuning
    return launcher.launch([(name, GRID.sweeps(name))])


@pytest.mark.slow
def test_threads_that_take_turns_on_a_gpu_get_what_one_alone_gets(as_a_gpu):
    objects = resolve_objects(["torus-1", "gear-0", "brick-0"], surfaces=True)
    scenes = SweepScenes(GRID, {name: item.load for name, item in objects.items()})
    alone = {name: _launch(scenes, name) for name in scenes.objects}
    with ThreadPoolExecutor(3) as pool:
        together = dict(
            zip(
                scenes.objects,
                pool.map(lambda name: _launch(scenes, name, recorded=True), scenes.objects),
                strict=True,
            )
        )
    for name, expected in alone.items():
        assert expected.counts["touching"].sum() > 50
        for field in ("wrench", "contact", "depth", "residual"):
            np.testing.assert_array_equal(getattr(together[name], field), getattr(expected, field))
        for field, values in expected.counts.items():
            np.testing.assert_array_equal(together[name].counts[field], values)


def test_sweeps_are_placed_as_ever(monkeypatch):
    objects = resolve_objects(["brick-0", "torus-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()}, whiskers="C1,C2")
    launcher = SweepLauncher(scenes, COARSE)
    placed = []

    def record(self, given):
        moving, count = given.motions.arrays(), len(given.shapes.first) - 1
        for row in range(count):
            knot = [moving[name][row - count] for name in ("coarse", "place", "velocity", "quaternion")]
            placed.append(np.concatenate([*knot, [given.shapes.arrays()["scale"][row]]]).tolist())
        return SimpleNamespace(seconds=0.0)

    monkeypatch.setattr(launch.WhiskerSolver, "launch", record)
    monkeypatch.setattr(sweeps, "join_batches", list)
    monkeypatch.setattr(launcher, "trusted", lambda groups, retry, _: launcher.launch(groups))
    launcher.run([*range(0, 208, 16), *range(208, 416, 16)], 1, 1)
    # Made by commit a79787b0.
    assert (len(placed), content_hash(portable(placed))) == (26, "1de2c1bec32592d6")


def test_whiskers_that_are_simulated_again_do_not_depend_on_what_comes_with_them():
    objects = resolve_objects(["brick-0", "chair-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()}, whiskers="C1,C2,D2")
    launcher = SweepLauncher(scenes, Fidelity(links=12, time_step=1e-3))
    chosen = [
        (name, scenes.grid.sweeps(name)[first : first + 2]) for name, first in (("brick-0", 74), ("chair-0", 168))
    ]
    together = launcher.trusted(chosen, 5)
    alone = [launcher.trusted([(name, [sweep])], 5) for name, some in chosen for sweep in some]
    assert 0 < together.retried < 4
    assert together.retried == sum(one.retried for one in alone)
    np.testing.assert_array_equal(together.wrench, np.concatenate([one.wrench for one in alone]))
    assert together.reasons == tuple(reason for one in alone for reason in one.reasons)
    assert together.steps == sum(one.steps for one in alone)
