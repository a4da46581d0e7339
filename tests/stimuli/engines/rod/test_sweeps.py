"""Many sweeps in one launch: what they give is what their scenes give, whatever comes together."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.engines.error_estimates import HALF_STEP, MORE_LINKS, changes, lateness
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.sweeps import SweepLauncher
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepGrid, SweepScenes

pytest.importorskip("warp")

COARSE = Fidelity(links=10, time_step=1e-3)
DOUBTFUL = Fidelity(links=12, time_step=5e-4, contact_line="links")
"""On straight links some whiskers past ``brick-0`` need steps over 5, and some over 10."""


def test_sweeps_through_the_fast_path_equal_their_scenes():
    from brainbench.stimuli import simulate
    from brainbench.stimuli.sweeps.plan import simulate_sweeps

    objects = resolve_objects(["ellipsoid-1"], surfaces=True)
    grid = SweepGrid(speed=(0.05,), rotation=(0.0, 0.7), distance=(0.005,), size=(0.03,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,C2,D2")
    fidelity = Fidelity(links=10, time_step=5e-4, contact_line="links")
    fast = simulate_sweeps(scenes, [0, 1], fidelity=fidelity)
    slow = simulate([scenes[0], scenes[1]], fidelity=fidelity, backend="rod", cache=False)
    assert not fast.unstable.any()
    assert (fast.contact > 0).any()
    assert fast.steps < 0.6 * fast.steps_in_full
    peak = np.abs(slow["wrench"].values[..., :3]).max()
    # The same contacts, rounded differently: friction makes a few readings differ by more.
    assert np.median(np.abs(fast.wrench - slow["wrench"].values)[..., :3]) < 1e-4 * peak
    assert np.abs(fast.wrench - slow["wrench"].values)[..., :3].mean() < 2e-3 * peak


def test_sweeps_do_not_depend_on_which_share_a_launch():
    from brainbench.stimuli.sweeps.plan import simulate_sweeps

    objects = resolve_objects(["ellipsoid-1", "brick-2"], surfaces=True)
    grid = SweepGrid(speed=(0.05,), rotation=(0.0, 0.7), distance=(0.005,), size=(0.03,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,D2")
    together = simulate_sweeps(scenes, [0, 1, 2, 3], fidelity=COARSE, workers=2)
    single = [simulate_sweeps(scenes, [index], fidelity=COARSE) for index in range(4)]
    assert np.concatenate([batch.wrench for batch in single]).tobytes() == together.wrench.tobytes()


@pytest.mark.slow
def test_whiskers_that_cannot_be_trusted_are_simulated_again_and_no_other_changes():
    from brainbench.stimuli.sweeps.plan import simulate_sweeps

    objects = resolve_objects(["chair-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    # Straight links leave more whiskers in doubt.
    fidelity, chosen = Fidelity(links=10, time_step=5e-4, contact_line="links"), [0, 140]
    once = simulate_sweeps(scenes, chosen, fidelity=fidelity)
    again = simulate_sweeps(scenes, chosen, fidelity=fidelity, retry=5)
    bad, left = once.unstable, again.unstable
    assert left.sum() <= bad.sum() / 2
    assert (again.retried, once.retried) == (2, 0)
    assert [bool(words) for words in again.reasons] == left.any(axis=1).tolist()
    # What was simulated again is what a finer simulation of everything gives; nothing else changes.
    runs = [once, *(simulate_sweeps(scenes, chosen, fidelity=replace(fidelity, time_step=h)) for h in (1e-4, 5e-5))]
    same = np.array([(run.wrench == again.wrench).all(axis=(1, 3)) for run in runs])
    assert (same[0] | same[1:].any(axis=0) | left).all()
    assert (same[1:].any(axis=0) & ~left)[bad].sum() >= bad.sum() / 2
    assert same[0][~bad].mean() > 0.9


def test_whiskers_that_finer_steps_do_not_mend_take_steps_twice_as_fine(monkeypatch):
    # Without steps that only compare.
    monkeypatch.setattr("brainbench.stimuli.engines.trust.SUSPICIOUS_PEAK", 1e9)
    objects = resolve_objects(["brick-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    launcher = SweepLauncher(scenes, DOUBTFUL)
    chosen = [("brick-0", [scenes.grid.sweeps("brick-0")[74]])]
    once = launcher.launch(chosen)
    bad = once.verdict.unstable
    five = launcher.launch(chosen, [(bad, 5)])
    left = bad.copy()
    left[bad] = five.verdict.unstable[:, 0]
    assert left.any()
    result = launcher.trusted(chosen, 5)
    assert (result.unstable.any(), result.reasons, result.retried) == (False, ("",), 1)
    ten = launcher.launch(chosen, [(left, 10)])
    np.testing.assert_array_equal(np.moveaxis(result.wrench[0], 1, 0)[left[0]], ten.wrench[:, :, 0])
    # All that was computed is counted.
    assert result.steps == once.steps.sum() + five.steps.sum() + ten.steps.sum()


def test_the_error_of_a_whisker_in_finer_steps_is_told_by_half_of_these():
    objects = resolve_objects(["brick-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()}, whiskers="A1,A2,C1")
    launcher = SweepLauncher(scenes, DOUBTFUL)
    chosen = [("brick-0", [scenes.grid.sweeps("brick-0")[74]])]
    batch = launcher.trusted(chosen, 5, np.ones(1, dtype=bool))
    lengths = np.array([whisker.arc_length for whisker in launcher.whiskers])
    # What the whiskers count with: steps over 5, 1 and 10.
    for column, divisor in enumerate((5, 1, 10)):
        which = np.arange(3)[None] == column
        run, *finer = (launcher.launch(chosen, [(which, divisor)], solver) for solver in (None, *_finer(launcher)))
        assert run.wrench[0, :, 0].tobytes() == batch.wrench[0, :, column].tobytes()
        touching = [each.contact[:, :, 0] >= 0 for each in (run, *finer)]
        shift = lateness(launcher.fidelity, launcher.whiskers[column], launcher.spacing)
        wrenches = [each.wrench[:, :, 0] for each in (run, *finer)]
        shares = [
            factor * changes(wrenches[0], each, touching[0] | there, lengths[[column]], moved)[0]
            for factor, each, there, moved in zip(
                (HALF_STEP, MORE_LINKS), wrenches[1:], touching[1:], (shift, 0.0), strict=True
            )
        ]
        assert batch.error[0, column] == pytest.approx(np.hypot(*shares), rel=1e-5)


def _finer(launcher):
    return [solver for _, solver in launcher.finer]


def test_a_whisker_that_cannot_be_trusted_says_why():
    objects = resolve_objects(["brick-0", "chair-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    launcher = SweepLauncher(scenes, DOUBTFUL)
    found = set()
    for name, index in (("brick-0", 74), ("chair-0", 168)):
        result = launcher.launch([(name, [scenes.grid.sweeps(name)[index]])])
        status, unstable, reasons = result.counts["status"][0], result.verdict.unstable[0], result.verdict.reasons[0]
        first = int(np.argmax(unstable))
        told = f"{scenes.array.names[first]}: {reasons[first]}"
        assert launcher.batch(result).reasons[0].startswith(told)
        assert [bool(reason) for reason in reasons] == unstable.tolist()
        assert ["a joint bent by" in reason for reason in reasons] == (status == 1).tolist()
        found |= {reason.split(" ")[0] for reason in reasons[unstable]}
    assert len(found) > 1


DEEP = ("pyramid-0", 0, "C3"), ("chair-0", 1, "D1"), ("bottle-0", 0, "C2")
"""Whiskers that lay .25 to .5 mm deep: across edges between two faces, and where one contact becomes two."""


def test_whiskers_beside_edges_and_where_contacts_part_do_not_sink_into_an_object():
    objects = resolve_objects(["procedural-24:1"], surfaces=True)
    loaders = {name: item.load for name, item in objects.items() if name in {owner for owner, *_ in DEEP}}
    scenes = SweepScenes(GRIDS["thesis-high"], loaders, whiskers="C2,C3,D1")
    launcher, names = SweepLauncher(scenes, Fidelity.preset("fast")), scenes.array.names
    for owner, place, whisker in DEEP:
        result = launcher.launch([(owner, scenes.grid.sweeps(owner)[place : place + 1])])
        depth = result.depth[0, names.index(whisker)]
        assert result.counts["touching"][0, names.index(whisker)] > 0
        assert depth < 1.2e-4, (owner, whisker, depth)


@pytest.mark.slow
def test_what_jumps_between_joints_makes_no_blow_that_grows_as_steps_shrink():
    objects = resolve_objects(["house-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()}, whiskers="C2")
    launcher = SweepLauncher(scenes, Fidelity.preset("fast"))
    tries = [(np.ones((1, 1), dtype=bool), divisor) for divisor in (1, 5)]
    result = launcher.launch([("house-0", scenes.grid.sweeps("house-0")[3:4])], tries)
    usual, finer = np.linalg.norm(result.wrench[:, :, 0, :3], axis=-1).max(axis=1)
    assert usual > 0
    # It was four times the force.
    assert finer < 1.2 * usual


def test_sweeps_touch_the_bent_rod_unless_links_are_asked_for():
    scenes = _few_sweeps()
    lines = [SweepLauncher(scenes, replace(COARSE, contact_line=line)).solver.smooth for line in (None, "rod", "links")]
    assert lines == [True, True, False]


def _few_sweeps(**grid):
    objects = resolve_objects(["ellipsoid-1"], surfaces=True)
    grid = SweepGrid(**{"speed": (0.05,), "rotation": (0.0,), "distance": (0.005,), "size": (0.03,), **grid})
    return SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,C2,D2")


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "step", "way"), [(3.0, 5e-3, "0.938 mm"), (4.0, 1e-4, "0.4 mm")])
@pytest.mark.parametrize("path", ["sweeps", "scenes"])
def test_an_object_too_fast_to_be_followed_is_told_of_in_sweeps_as_in_scenes(path, speed, step, way):
    from brainbench.stimuli import simulate
    from brainbench.stimuli.sweeps.plan import simulate_sweeps

    # Straight links bear the slow object, which meets D2 head-on.
    scenes, fidelity = _few_sweeps(speed=(0.05, speed)), Fidelity(links=10, time_step=step, contact_line="links")
    if path == "sweeps":
        batch = simulate_sweeps(scenes, [0, 1], fidelity=fidelity, retry=5)
        unstable, reasons = batch.unstable.any(axis=1), batch.reasons
    else:
        dataset = simulate([scenes[0], scenes[1]], fidelity=fidelity, cache=False)
        unstable = (dataset["status"].values != "ok").any(axis=1)
        reasons = ["".join(words) for words in dataset["reason"].values]
    assert unstable.tolist() == [False, True]
    assert f"moves by {way}" in reasons[1]
    assert not reasons[0]


def test_a_force_that_no_whisker_bears_is_flagged_in_sweeps_and_not_tried_again():
    scenes = _few_sweeps()
    # Straight links bear the object, which meets D2 head-on.
    launcher = SweepLauncher(scenes, replace(COARSE, contact_line="links"))
    (name,) = scenes.objects
    sound = launcher.trusted([(name, scenes.grid.sweeps(name))], 5)
    assert not sound.unstable.any()
    peaks = np.linalg.norm(sound.wrench[0, ..., :3], axis=-1).max(axis=0)
    launcher.solver.strongest[:] = 0.5 * peaks.max()
    found = launcher.trusted([(name, scenes.grid.sweeps(name))], 5)
    assert found.unstable.tolist() == [(peaks > 0.5 * peaks.max()).tolist()]
    assert "stretch the whisker" in found.reasons[0]
    assert found.retried == 0


@pytest.mark.slow
@pytest.mark.parametrize("line", ["links", "rod"])
def test_whiskers_that_pause_for_every_look_at_a_mesh_feel_the_same(line):
    objects = resolve_objects(["torus-1", "gear-0"], surfaces=True)
    grid = SweepGrid(speed=(0.06,), rotation=(0.0, 0.4), distance=(0.005,), size=(0.04,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()})
    results = []
    for sliced in (False, True):
        launcher = SweepLauncher(scenes, replace(COARSE, contact_line=line), sliced=sliced)
        results.append(launcher.launch([(name, grid.sweeps(name)) for name in scenes.objects]))
        assert (launcher.solver.slices > 1) == sliced
    whole, parts = results
    assert whole.counts["touching"].sum() > 100
    for name in ("wrench", "contact", "depth", "residual"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    for name, values in whole.counts.items():
        np.testing.assert_array_equal(values, parts.counts[name])


def test_sweeps_through_the_fast_path_may_leave_inertia_out():
    from brainbench.stimuli.sweeps.plan import simulate_sweeps

    objects = resolve_objects(["ellipsoid-1"], surfaces=True)
    grid = SweepGrid(speed=(0.03,), rotation=(0.0,), distance=(0.005,), size=(0.03,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,C2")
    moving, still = (
        simulate_sweeps(scenes, [0], fidelity=Fidelity(links=10, time_step=5e-4, solver=solver))
        for solver in ("dynamic", "quasistatic")
    )
    peak = np.abs(moving.wrench[..., 3:]).max()
    assert 0 < np.median(np.abs(moving.wrench - still.wrench)[..., 3:][moving.wrench[..., 3:] != 0]) < 0.02 * peak


def test_a_grid_whose_head_moves_has_no_fast_path():
    with pytest.raises(UsageError, match="whose object moves"):
        SweepLauncher(_few_sweeps(mover="head"), COARSE)
