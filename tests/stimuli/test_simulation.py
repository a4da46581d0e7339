import dataclasses
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import brainbench
from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation, euler_matrix
from brainbench.stimuli import simulation
from brainbench.stimuli.engines import PHYSICS_VERSION
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.trajectories import ArrayFollicle, Still, Translation, Whisking
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.scenes.scene import Frames, Head, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engines import FakeEngine

ARRAY = WhiskerArray.mouse(whiskers="C1,C2,D6")
FRAMES = Frames(0.0, 0.01, 10)
NEAR = PlacedObject(sphere(2e-3), position=(0.015, 0.002, 0.003))
_WEIGHTS = shutil.ignore_patterns("*.safetensors", "__pycache__")
FAR = PlacedObject(sphere(2e-3), position=(1.0, 0.0, 0.0))


def _scene(label="one", **changes):
    return Scene(label, **{"array": ARRAY, "objects": (NEAR,), "frames": FRAMES, **changes})


def _simulate(scenes, backend=None, **options):
    return simulate(scenes, fidelity=Fidelity(), backend=backend or FakeEngine(), **options)


@pytest.fixture
def engine(monkeypatch, tmp_path):
    """The double, found by name so that results are cached, in a cache of its own."""
    backend = FakeEngine()
    monkeypatch.setattr(simulation, "get_engine", lambda name, **options: backend)
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    return backend


def test_the_result_is_a_stimulus_set_with_contacts_and_status():
    dataset = check_stimulus_set(_simulate([_scene("a"), _scene("b", objects=())]))
    assert dataset["wrench"].shape == (2, 10, 3, 6)
    assert dataset["wrench"].dtype == np.float32
    assert dataset["contact"].dtype == bool
    assert dataset["contact"].dims == dataset["contact_arc"].dims == ("stimulus", "time", "whisker")
    assert (dataset["status"] == "ok").all()
    assert dataset["penetration"].dims == dataset["status"].dims == ("stimulus", "whisker")
    assert dataset["error"].dims == dataset["damping"].dims == dataset["remark"].dims == ("stimulus", "whisker")
    assert list(dataset["whisker"].values) == ["C1", "C2", "D6"]
    assert list(dataset["row"].values) == [2, 2, 3]
    assert list(dataset["col"].values) == [1, 2, 6]
    np.testing.assert_allclose(dataset["time"], FRAMES.times)


def test_wrenches_are_turned_from_the_array_to_the_world():
    turn = (0.2, -0.4, 0.7)
    straight = _simulate(_scene(objects=()))["wrench"].values
    turned = _simulate(_scene(objects=(), head=Head((1.0, 2.0, 3.0), turn)))["wrench"].values
    matrix = euler_matrix(turn)
    np.testing.assert_allclose(turned[..., :3], straight[..., :3] @ matrix.T, atol=1e-8)
    np.testing.assert_allclose(turned[..., 3:], straight[..., 3:] @ matrix.T, atol=1e-6)


def test_a_frame_is_the_mean_of_its_readings_and_touches_when_one_of_them_does():
    # C1 points here half-way through its first protraction.
    (position,), (euler,) = ArrayFollicle(ARRAY["C1"], Whisking()).pose(np.array([0.02]))
    tip = position + base_rotation(euler)[:, :2] @ ARRAY["C1"].whisker.centre_line(ARRAY["C1"].whisker.arc_length)
    met = (PlacedObject(sphere(0.5e-3), position=tuple(tip)),)
    dense = _simulate(_scene(objects=met, frames=Frames(0.0, 0.001, 40)))
    averaged = _simulate(_scene(objects=met, frames=Frames(0.0, 0.01, 4, average=10)))
    expected = dense["wrench"].values.reshape(1, 4, 10, 3, 6).mean(axis=2)
    np.testing.assert_allclose(averaged["wrench"], expected, atol=1e-7)
    contact = dense["contact"].values.reshape(1, 4, 10, 3)
    assert contact.any()
    assert (contact.any(axis=2) != contact.all(axis=2)).any()
    np.testing.assert_array_equal(averaged["contact"], contact.any(axis=2))
    np.testing.assert_array_equal(np.isfinite(averaged["contact_arc"]), contact.any(axis=2))
    arc = averaged["contact_arc"].sel(whisker="C1").values
    np.testing.assert_allclose(arc[np.isfinite(arc)], ARRAY["C1"].whisker.arc_length, rtol=1e-6)


def test_a_whisker_that_reaches_nothing_is_simulated_once_for_all_scenes():
    backend = FakeEngine()
    dataset = _simulate([_scene("a"), _scene("b", objects=(FAR,)), _scene("c", objects=())], backend)
    # C1 and C2 reach the near ball in one scene; D6 is too short everywhere.
    assert len(backend.jobs) == 3 + 2
    np.testing.assert_array_equal(dataset["wrench"][1], dataset["wrench"][2])


def test_a_whisker_that_moves_otherwise_is_simulated_again():
    backend = FakeEngine()
    _simulate([_scene("a", objects=()), _scene("b", objects=(), whisking=Still())], backend)
    assert len(backend.jobs) == 6
    backend = FakeEngine()
    moving = Head(motion=Translation((0.01, 0.0, 0.0)))
    _simulate([_scene("a", objects=()), _scene("b", objects=(), head=moving)], backend)
    assert len(backend.jobs) == 6


def test_an_unstable_whisker_is_flagged_and_said_aloud(caplog):
    with caplog.at_level(logging.WARNING):
        dataset = _simulate(_scene(), FakeEngine(unstable={1: "energy grew"}))
    assert list(dataset["status"].values[0]) == ["ok", "unstable", "ok"]
    assert dataset["reason"].values[0, 1] == "energy grew"
    assert np.isnan(dataset["wrench"].sel(whisker="C2")).any()
    assert re.search("C2 .* one: energy grew", caplog.text)


def test_progress_counts_the_whiskers_simulated():
    calls = []
    _simulate(_scene(), progress=lambda *call: calls.append(call))
    assert calls == [(1, 3, "simulating whiskers"), (2, 3, "simulating whiskers"), (3, 3, "simulating whiskers")]


class Preparing(FakeEngine):
    """An engine with something to do before it runs."""

    def __init__(self):
        super().__init__()
        self.ready = []

    def prepare(self, lengths, fidelity, *, progress=None):
        self.ready.append((sorted(lengths), fidelity, len(self.jobs)))
        raise UsageError("what is wrong is said by run")


def test_an_engine_gets_ready_before_it_runs_and_not_for_what_is_in_the_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    engine, fidelity = Preparing(), Fidelity.preset("fast")
    monkeypatch.setattr(simulation, "get_engine", lambda name, **options: engine)
    scene = _scene()
    simulation.prepare([scene], fidelity="fast", backend="fake")
    for thread in threading.enumerate():
        if thread.name == "brainbench-prepare":
            thread.join()
    simulate(scene, fidelity=fidelity, backend="fake")
    lengths = sorted({mount.whisker.arc_length for mount in scene.mounts})
    assert engine.ready == [(lengths, fidelity.resolved(engine.twists), 0)] * 2
    simulation.prepare([scene], fidelity=fidelity, backend="fake")
    simulate(scene, fidelity=fidelity, backend="fake")
    assert len(engine.ready) == 2


def test_a_second_request_comes_from_the_cache(engine):
    first = _simulate(_scene(), "fake")
    ran = len(engine.jobs)
    second = _simulate(_scene(), "fake")
    assert len(engine.jobs) == ran
    xr.testing.assert_identical(first, second)
    _simulate(_scene(), "fake", cache=False)
    assert len(engine.jobs) == 2 * ran


@pytest.mark.parametrize(
    "changed",
    [
        {"whisking": Whisking(frequency=19.0)},
        {"objects": (dataclasses.replace(NEAR, friction=0.1),)},
        {"array": ARRAY.replace("C2", young_modulus=4e9)},
        {"array": ARRAY.replace("C2", position=(0.0, 0.0, 0.0))},
        {"head": Head((0.0, 0.0, 1e-4))},
        {"frames": Frames(0.0, 0.01, 11)},
        {"label": "other"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_whatever_changes_the_result_changes_the_place_in_the_cache(engine, changed):
    first = _simulate(_scene(), "fake")
    ran = len(engine.jobs)
    second = _simulate(_scene(**changed), "fake")
    assert len(engine.jobs) > ran
    assert first.attrs["content_hash"] != second.attrs["content_hash"]


def test_another_version_of_the_physics_never_takes_these_results_for_its_own(engine, monkeypatch):
    before = _simulate(_scene(), "fake")
    monkeypatch.setattr(simulation, "PHYSICS_VERSION", PHYSICS_VERSION + 1)
    after = _simulate(_scene(), "fake")
    assert len(engine.jobs) == 6
    # Scores and the demo's animals know their stimuli by it.
    assert before.attrs["config_hash"] != after.attrs["config_hash"]


def test_an_edited_drawing_module_leaves_simulations_in_their_place_in_the_cache(tmp_path):
    """Keys of two copies of the package, of which one draws otherwise."""
    code = (
        "from brainbench.stimuli import Fidelity, get_recipe\n"
        "from brainbench.stimuli.engines import get_engine\n"
        "from brainbench.stimuli.simulation import cache_path\n"
        "print(cache_path(get_recipe('rodgers').scenes[:1], Fidelity(), get_engine('mujoco')).name)"
    )
    names = []
    for copy in ("before", "after"):
        shutil.copytree(Path(brainbench.__file__).parent, tmp_path / copy / "brainbench", ignore=_WEIGHTS)
        with (tmp_path / copy / "brainbench/stimuli/figures/surfaces.py").open("a") as module:
            module.write(f"# {copy}\n")
        ended = subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": str(tmp_path / copy)}, cwd=tmp_path,
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        names.append(ended.stdout)
    assert names[0].endswith(".h5\n")
    assert names[0] == names[1]


def test_the_configuration_hash_names_the_request_and_not_the_numbers():
    class Blurred(FakeEngine):
        def _trace(self, job, reason):
            trace = super()._trace(job, reason)
            return dataclasses.replace(trace, wrench=trace.wrench * (1 + 1e-6))

    exact, blurred = _simulate(_scene()), _simulate(_scene(), Blurred())
    assert exact.attrs["content_hash"] != blurred.attrs["content_hash"]
    assert exact.attrs["config_hash"] == blurred.attrs["config_hash"]
    assert exact.attrs["config_hash"] != _simulate(_scene(head=Head((0.0, 0.0, 1e-6)))).attrs["config_hash"]


def test_fidelity_changes_the_place_in_the_cache(engine):
    simulate(_scene(), fidelity=Fidelity(links=10), backend="fake")
    ran = len(engine.jobs)
    simulate(_scene(), fidelity=Fidelity(links=11), backend="fake")
    assert len(engine.jobs) == 2 * ran


@pytest.mark.parametrize("damage", [b"", b"not HDF5 at all", None])
def test_a_damaged_cache_file_is_made_again(engine, tmp_path, caplog, damage):
    first = _simulate(_scene(), "fake")
    (path,) = (tmp_path / "stimuli").glob("*.h5")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    with caplog.at_level(logging.WARNING):
        again = _simulate(_scene(), "fake")
    assert "damaged" in caplog.text
    xr.testing.assert_identical(first, again)
    assert len(engine.jobs) == 6


def test_a_full_disk_costs_the_cache_and_not_the_result(engine, monkeypatch, caplog):
    def full(dataset, path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(simulation, "write_stimulus_set", full)
    with caplog.at_level(logging.WARNING):
        assert _simulate(_scene(), "fake")["wrench"].shape == (1, 10, 3, 6)
    assert "cache" in caplog.text
    assert "No space left" in caplog.text


def test_a_changed_number_in_the_cache_is_noticed(engine, tmp_path, caplog):
    import h5py

    _simulate(_scene(), "fake")
    (path,) = (tmp_path / "stimuli").glob("*.h5")
    with h5py.File(path, "r+") as file:
        file["wrench"][0, 0, 0, 0] = 7.0
    with caplog.at_level(logging.WARNING):
        assert _simulate(_scene(), "fake")["wrench"].values[0, 0, 0, 0] != 7.0
    assert "seal does not fit" in caplog.text


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ([], "no scene to simulate"),
        ([_scene("a"), _scene("a")], r"labels .*received \['a', 'a'\]"),
        ([_scene("a"), _scene("b", array=ARRAY.select("C1"))], r"'a' and 'b' .*whiskers"),
        ([_scene("a"), _scene("b", array=ARRAY.on_side("left"))], r"'a' and 'b' .*whiskers"),
        ([_scene("a"), _scene("b", frames=Frames())], r"'a' and 'b' .*times"),
    ],
)
def test_scenes_that_do_not_fit_together_are_refused(scenes, message):
    with pytest.raises(UsageError, match=message):
        _simulate(scenes)


@pytest.mark.slow
def test_new_scenes_twist_and_shipped_recipes_state_that_they_do_not():
    new = simulate([_scene("new")], fidelity="fast", cache=False)
    assert json.loads(new.attrs["fidelity"])["twist"] is True
    pinned = [scene.select("C1") for scene in get_recipe("rodgers").scenes[:1]]
    kept = simulate(pinned, fidelity="fast", cache=False)
    assert "twist" not in json.loads(kept.attrs["fidelity"])
    asked = simulate(pinned, fidelity="fast,twist=true", cache=False)
    assert asked.attrs["config_hash"] != kept.attrs["config_hash"]
    assert not np.array_equal(asked["wrench"].values, kept["wrench"].values)


def test_what_a_caller_does_to_a_stimulus_set_does_not_reach_the_next_one(engine):
    first = _simulate(_scene(), "fake")
    kept = _simulate(_scene(), "fake")
    kept["wrench"].values[:] += 1
    xr.testing.assert_identical(_simulate(_scene(), "fake"), first)
