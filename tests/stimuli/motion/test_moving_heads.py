"""Heads that travel and turn, and several animals in one scene."""

import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation, euler_matrix
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.trajectories import Path, Still, Translation, Whisking
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from brainbench.stimuli.scenes.scene import Animal, Frames, Head, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.sources import load_stimuli
from brainbench.stimuli.stimulus_set import to_grid
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engines import FakeEngine

PAIR = WhiskerArray.mouse(whiskers="C1,C2")
FRAMES = Frames(0.0, 0.01, 10)
TURN = Path((0.0, 0.05, 0.12), ((0, 0, 0), (1e-3, 0, 0), (1e-3, 2e-3, 0)), ((0, 0, 0), (0.1, 0, 0.3), (0.2, -0.1, 0.5)))
PLACE = Head((0.01, -0.02, 0.03), (0.3, -0.5, 1.2), TURN)
NEAR = PlacedObject(sphere(2e-3), position=(0.015, 0.002, 0.003))


def _world(scene, times):
    """Base points [n, whisker, 3] and base frames [n, whisker, 3, 3] in the world."""
    poses = [job.follicle.pose(times) for job in scene.jobs()]
    points = np.stack([position for position, _ in poses], axis=1)
    frames = base_rotation(np.stack([euler for _, euler in poses], axis=1))
    return points @ scene.head.matrix.T + scene.head.position, scene.axes @ frames


def test_a_path_passes_through_its_keyframes():
    np.testing.assert_allclose(TURN.displacement(np.array(TURN.times)), TURN.displacements, atol=1e-15)
    expected = np.stack([euler_matrix(angles) for angles in TURN.rotations])
    np.testing.assert_allclose(TURN.turn(np.array(TURN.times)), expected, atol=1e-12)


def test_a_path_has_continuous_velocity_and_acceleration():
    step = 1e-5
    times = np.arange(0.049, 0.051, step)
    for values, scale in ((TURN.displacement(times), 1e-3 / 0.05**2), (TURN.turn(times).reshape(-1, 9), 0.3 / 0.05**2)):
        acceleration = np.diff(values, n=2, axis=0) / step**2
        assert np.abs(np.diff(acceleration, axis=0)).max() < 0.02 * scale


def test_a_moving_head_carries_base_points_and_directions_rigidly():
    times = np.linspace(0, 0.11, 23)
    still = Scene("still", PAIR, whisking=Whisking(), head=Head(PLACE.position, PLACE.rotation), frames=FRAMES)
    moving = Scene("moving", PAIR, whisking=Whisking(), head=PLACE, frames=FRAMES)
    (points, frames), (rest, axes) = _world(moving, times), _world(still, times)
    turn, travel = TURN.turn(times), TURN.displacement(times)
    origin = np.array(PLACE.position)
    expected = np.einsum("nij,nwj->nwi", turn, rest - origin) + origin + travel[:, None]
    np.testing.assert_allclose(points, expected, atol=1e-12)
    np.testing.assert_allclose(frames, np.einsum("nij,nwjk->nwik", turn, axes), atol=1e-9)
    np.testing.assert_allclose(moving.orientations(), _world(moving, FRAMES.times)[1], atol=1e-12)


def test_a_path_without_rotation_is_a_translation():
    times = np.linspace(0, 0.1, 11)
    straight = Path((0.0, 0.2), ((0, 0, 0), (0.004, 0, -0.002)), ((0, 0, 0), (0, 0, 0)))
    same = Translation((0.02, 0.0, -0.01), 0.0)
    first, second = (
        _world(Scene("x", PAIR, head=Head(PLACE.position, PLACE.rotation, m)), times) for m in (straight, same)
    )
    np.testing.assert_allclose(first[0], second[0], atol=1e-15)
    np.testing.assert_allclose(first[1], second[1], atol=1e-9)


def test_an_animal_that_turns_with_its_object_feels_no_contact_change_but_its_own_inertia():
    """Slowly turning a head in free space leaves forces that vanish with the square of the speed."""
    peaks = []
    for duration in (0.2, 0.4):
        keys = (0.0, duration / 2, duration, 2 * duration)
        slow = Path(keys, ((0, 0, 0),) * 4, ((0, 0, 0), (0, 0, 0.1), (0, 0, 0.4), (0, 0, 0.4)))
        scene = Scene("slow", PAIR, (), Still(), Head(motion=slow), Frames(0.05 * duration, duration / 40, 30))
        dataset = simulate(scene, fidelity=Fidelity.preset("fast"), cache=False)
        assert (dataset["status"] == "ok").all()
        peaks.append(float(np.abs(dataset["wrench"].values).max()))
    assert 0 < peaks[1] < 0.4 * peaks[0]


def test_circling_at_constant_speed_pulls_the_base_outwards_with_the_centripetal_force():
    """A rigidly circling whisker needs m ω² r_c inwards, so it pulls its base outwards with that force."""
    array = WhiskerArray.mouse(whiskers="C2").replace(
        position=(0.0, 0.0, 0.0), angles=(math.pi / 2, 0.0, -math.pi / 2), curvature=0.0
    )
    whisker, rate = array["C2"].whisker, 10.0
    times = tuple(np.linspace(0, 0.6, 61))
    spin = Path(times, ((0, 0, 0),) * 61, tuple((0, 0, rate * t) for t in times))
    frames = Frames(0.3, 0.01, 20)
    dataset = simulate(Scene("spin", array, (), Still(), Head(motion=spin), frames), fidelity="balanced", cache=False)
    s = np.linspace(0, whisker.arc_length, 2001)
    moment = np.trapezoid(whisker.linear_density(s) * s, s)
    force = dataset["wrench"].values[0, :, 0, :3].astype(float)
    angle = rate * frames.times
    outwards = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(20)])
    np.testing.assert_allclose(np.sum(force * outwards, axis=1), moment * rate**2, rtol=0.01)
    assert np.abs(force - outwards * moment * rate**2).max() < 0.05 * moment * rate**2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0.0,), ((0, 0, 0),), ((0, 0, 0),)), r"times .*received \(0\.0,\)"),
        (((0.0, 0.0), ((0, 0, 0),) * 2, ((0, 0, 0),) * 2), "ascend from 0"),
        (((0.1, 0.2), ((0, 0, 0),) * 2, ((0, 0, 0),) * 2), "ascend from 0"),
        (((0.0, 0.2), ((0, 0, 0),) * 3, ((0, 0, 0),) * 2), r"displacements .*2 times"),
        (((0.0, 0.2), ((0, 0, 0),) * 2, ((0, 0), (0, 0))), r"rotations .*2 times"),
        (((0.0, 0.2), ((1, 0, 0),) * 2, ((0, 0, 0),) * 2), r"received \(1\.0, 0\.0, 0\.0\)"),
    ],
)
def test_impossible_paths_are_refused(arguments, message):
    with pytest.raises(UsageError, match=message):
        Path(*arguments)


def test_a_scene_longer_than_the_path_is_refused():
    scene = Scene("long", PAIR, head=PLACE, frames=Frames(0.0, 0.01, 40))
    with pytest.raises(UsageError, match=r"0\.12 s; .*0\.39 s"):
        simulate(scene, backend=FakeEngine())


def test_a_head_that_turns_a_whisker_upright_is_refused_in_words():
    over = Path((0.0, 0.1, 0.2), ((0, 0, 0),) * 3, ((0, 0, 0), (0, -math.pi / 2, 0), (0, -math.pi / 2, 0)))
    # C3 lies across the head, so that a pitch by 90 degrees carries it past the vertical within 2 degrees.
    array = WhiskerArray.mouse(whiskers="C3")
    scene = Scene("over", array, head=Head(motion=over), whisking=Still(), frames=Frames(0, 0.01, 15))
    with pytest.raises(UsageError, match=r"C3 .*gimbal lock"):
        simulate(scene, backend=FakeEngine())


def _crowd(**changes):
    other = Animal("b", WhiskerArray.rat(whiskers="C1,D2"), Still(), PLACE)
    return Scene("crowd", **{"array": PAIR, "objects": (NEAR,), "frames": FRAMES, "others": (other,), **changes})


def test_several_animals_feel_what_each_would_feel_alone():
    scene = _crowd()
    together = simulate(scene, backend=FakeEngine())
    assert list(together["whisker"].values) == ["a:C1", "a:C2", "b:C1", "b:D2"] == list(scene.names)
    alone = [simulate(part, backend=FakeEngine()) for part in scene.split()]
    expected = np.concatenate([dataset["wrench"].values for dataset in alone], axis=2)
    np.testing.assert_array_equal(together["wrench"].values, expected)
    assert list(together["row"].values) == [2, 2, 2, 3]


def test_equal_animals_share_their_work_only_where_they_feel_the_same():
    backend = FakeEngine()
    far = Animal("b", PAIR, Whisking(), Head((0.5, 0.0, 0.0)))
    simulate(Scene("x", PAIR, (NEAR,), frames=FRAMES, others=(far,)), backend=backend)
    assert len(backend.jobs) == 4
    backend = FakeEngine()
    simulate(Scene("x", PAIR, (), frames=FRAMES, others=(far,)), backend=backend)
    assert len(backend.jobs) == 2


def test_whiskers_of_animals_are_chosen_by_name():
    scene = _crowd()
    assert scene.select("C1").names == ("a:C1", "b:C1")
    assert scene.select("b:*").names == ("C1", "D2")
    assert scene.select("b:*").head == PLACE
    assert scene.select("a:C2,b:D2").names == ("a:C2", "b:D2")
    with pytest.raises(UsageError, match="'c:C1'; did you mean 'b:C1'"):
        scene.select("c:C1")


def test_the_grid_refuses_several_animals_even_in_different_cells_and_takes_one():
    dataset = simulate(_crowd(), backend=FakeEngine())
    with pytest.raises(UsageError, match=r"2 animals .*'a:\*' or 'b:\*'"):
        to_grid(dataset)
    apart = dataset.isel(whisker=[0, 3])
    with pytest.raises(UsageError, match="2 animals"):
        to_grid(apart)
    assert load_stimuli(dataset, whiskers="b:*").input.shape[-2:] == (5, 7)
    assert list(load_stimuli(dataset, whiskers="b:*").dataset["whisker"].values) == ["b:C1", "b:D2"]


def test_animals_count_in_the_configuration_and_single_ones_change_nothing():
    assert _crowd().config() != _crowd(others=()).config()
    assert "others" not in _crowd(others=()).config()
    moved = Animal("b", WhiskerArray.rat(whiskers="C1,D2"), Still(), Head())
    assert _crowd().config() != _crowd(others=(moved,)).config()


def test_animals_need_different_names():
    for name in ("a", "", "x:y"):
        with pytest.raises(UsageError, match=rf"received \['a', '{name}'\]"):
            _crowd(others=(Animal(name, PAIR),))
