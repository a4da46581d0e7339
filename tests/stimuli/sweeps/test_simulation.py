import dataclasses

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli import Fidelity, simulate
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE
from brainbench.stimuli.engines.protocol import SweepBatch, join_batches
from brainbench.stimuli.explain import Explanation
from brainbench.stimuli.sweeps.simulation import simulate_sweeps
from tests.factories.engines import FakeEngine
from tests.factories.sweep_batches import GRID, small_plan, small_scenes

FAST = Fidelity.preset("fast")


def test_a_batch_holds_what_simulating_its_scenes_gives():
    scenes = small_scenes(whiskers="C2,C3", grid=small_plan().grid)
    indices = [9, 2, 3]
    batch = simulate_sweeps(scenes, indices, fidelity=FAST, backend="mujoco")
    dataset = simulate([scenes[index] for index in indices], fidelity=FAST, backend="mujoco", cache=False)
    np.testing.assert_array_equal(batch.wrench, dataset["wrench"].values)
    np.testing.assert_array_equal(batch.contact, dataset["contact"].values.mean(axis=1).astype(np.float32))
    assert batch.contact.max() > 0
    assert not batch.unstable.any()
    assert batch.reasons == ("", "", "")
    assert batch.steps == batch.steps_in_full


def test_neither_batch_nor_order_nor_threads_change_a_number():
    scenes, indices = small_scenes(), [2, 3, 9]
    together = simulate_sweeps(scenes, indices, fidelity=FAST, workers=2)
    backwards = simulate_sweeps(scenes, indices[::-1], fidelity=FAST, workers=1)
    np.testing.assert_array_equal(together.wrench, backwards.wrench[::-1])
    alone = join_batches([simulate_sweeps(scenes, [index], fidelity=FAST) for index in indices])
    np.testing.assert_array_equal(together.wrench, alone.wrench)
    np.testing.assert_array_equal(together.contact, alone.contact)


def test_sweeps_that_move_the_head_go_through_the_default_engine_scene_by_scene():
    scenes = small_scenes(grid=dataclasses.replace(GRID, mover="head"))
    batch = simulate_sweeps(scenes, [1, 2], fidelity=FAST)
    dataset = simulate([scenes[index] for index in (1, 2)], fidelity=FAST, cache=False)
    assert dataset.attrs["backend"] == DEFAULT_ENGINE
    np.testing.assert_array_equal(batch.wrench, dataset["wrench"].values)


def test_steps_whose_contact_forces_are_not_solved_are_counted_as_in_scenes():
    scenes, indices = small_scenes(whiskers="C*"), range(16)
    batch = simulate_sweeps(scenes, indices, fidelity=FAST)
    parts = [simulate_sweeps(scenes, [index], fidelity=FAST).unsolved for index in indices]
    assert 0 < batch.unsolved == sum(parts) < batch.steps
    shown = simulate([scenes[index] for index in indices], fidelity=FAST, cache=False)
    assert batch.unsolved == pytest.approx(Explanation.of(shown).unsolved, rel=0.2)


def test_an_unstable_whisker_is_marked_with_its_reason(monkeypatch):
    engine = FakeEngine(unstable={1: "joint 3 bent too far"})
    monkeypatch.setattr("brainbench.stimuli.sweeps.simulation.get_engine", lambda name, **options: engine)
    batch = simulate_sweeps(small_scenes(whiskers="C2,C3"), [0, 1], fidelity=FAST, backend="fake")
    assert batch.unstable.tolist() == [[False, True], [False, False]]
    assert "C3: joint 3 bent too far" in batch.reasons[0].replace("RC3", "C3")
    assert batch.reasons[1] == ""
    assert np.isnan(batch.wrench[0, -1, 1]).all()
    assert np.isfinite(batch.wrench[1]).all()


def test_a_device_that_the_engine_does_not_have_is_refused():
    with pytest.raises(UsageError, match=r"'mujoco' .*'cuda'; .*'cpu'"):
        simulate_sweeps(small_scenes(), [0], fidelity=FAST, backend="mujoco", device="cuda")


def test_a_batch_that_hides_instability_cannot_be_made():
    wrench, contact = np.zeros((2, 5, 3, 6), np.float32), np.zeros((2, 3), np.float32)
    unstable = np.zeros((2, 3), bool)
    unstable[1, 2] = True
    with pytest.raises(UsageError, match="reason"):
        SweepBatch(wrench, contact, unstable, ("", ""), 1, 1)
    with pytest.raises(UsageError, match=r"received \(2, 5, 3, 6\), \(1, 3\)"):
        SweepBatch(wrench, contact[:1], unstable, ("", "bent"), 1, 1)
