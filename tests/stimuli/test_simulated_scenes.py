"""Scenes run through the real engine, where the answer is known beforehand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brainbench.core.rotations import euler_matrix
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.trajectories import Path, Still, Whisking, smooth_step
from brainbench.stimuli.objects.obstacle import Capsule
from brainbench.stimuli.objects.solid import PlacedObject, Solid, sphere
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.scenes.scene import Frames, Head, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engine_scenes import AT, DEFLECTION, STRAIGHT, pushed_bar


def _wrench(scene):
    dataset = simulate(scene, fidelity=Fidelity.preset("balanced"), cache=False)
    assert dataset["contact"].values.all()
    return dataset["wrench"].values[0, 0, 0].astype(float)


def test_a_bar_that_pushes_the_whisker_towards_minus_y_makes_it_push_its_base_towards_minus_y():
    # The whisker hands the contact force on to its base: force −y at x = +a has the moment −z.
    force_x, force_y, force_z, *moment = _wrench(pushed_bar())
    whisker = STRAIGHT["C2"].whisker
    stiffness = 3 * float(whisker.bending_stiffness(0.0)) / AT**3 * float(whisker.radius(AT)) / whisker.base_radius
    assert force_y == pytest.approx(-stiffness * DEFLECTION, rel=0.05)
    assert moment[2] == pytest.approx(-stiffness * DEFLECTION * AT, rel=0.05)
    assert max(abs(force_x), abs(force_z)) < 0.05 * abs(force_y)
    assert max(abs(moment[0]), abs(moment[1])) < 0.01 * abs(moment[2])


@pytest.mark.parametrize("head", [Head(), Head((0.01, -0.02, 0.03), (0.3, -0.5, 1.2))], ids=["plain", "turned"])
def test_a_bar_that_turns_against_the_whisker_does_what_turning_the_base_the_other_way_does(head):
    # Smoothly by .2 rad and then at rest, about a slanted axis through the base, which is the origin of both.
    # The whisker sags in the same way when inertia has died away.
    axis, times = np.array([0.2, 0.1, 1.0]), np.linspace(0.0, 0.12, 61)
    angles = 0.2 * smooth_step(times, 0.08)
    bar = Solid("bar", (Capsule((AT, -0.6e-3, -8e-3), (AT, -0.6e-3, 8e-3), 0.5e-3),))
    turns = [_path(times, head.matrix @ axis, sign * angles) for sign in (1, -1)]
    placed = PlacedObject(bar, head.position, head.rotation, friction=0.0)
    frames = Frames(0.119, 0.001, 1)
    moved = Scene("bar", STRAIGHT, (replace(placed, motion=turns[0]),), Still(), head, frames)
    passing = Scene("base", STRAIGHT, (placed,), Still(), replace(head, motion=turns[1]), frames)
    by_bar, by_base = (_wrench(scene) for scene in (moved, passing))
    back = turns[0].turn(np.array([0.119]))[0]
    assert np.linalg.norm(by_bar[:3]) > 1e-5
    np.testing.assert_allclose(by_bar[:3], back @ by_base[:3], atol=2e-3 * np.linalg.norm(by_bar[:3]))
    np.testing.assert_allclose(by_bar[3:], back @ by_base[3:], atol=2e-3 * np.linalg.norm(by_bar[3:]))


def _path(times, axis, angles):
    turns = Rotation.from_rotvec(angles[:, None] * axis / np.linalg.norm(axis)).as_euler("xyz")
    return Path(tuple(times), ((0.0, 0.0, 0.0),) * len(times), tuple(map(tuple, turns)))


def test_turning_the_whole_scene_turns_the_wrench():
    head = Head((0.01, -0.02, 0.03), (0.3, -0.5, 1.2))
    turned, matrix = _wrench(pushed_bar(head)), euler_matrix(head.rotation)
    plain = _wrench(pushed_bar())
    np.testing.assert_allclose(turned[:3], matrix @ plain[:3], atol=2e-3 * np.linalg.norm(plain[:3]))
    np.testing.assert_allclose(turned[3:], matrix @ plain[3:], atol=2e-3 * np.linalg.norm(plain[3:]))


def test_the_left_side_feels_the_mirror_image():
    frames = Frames(0.01, 0.005, 16)
    wrenches = []
    for side, sign in (("right", 1), ("left", -1)):
        ball = PlacedObject(sphere(2e-3), position=(sign * 0.012, 0.004, 0.0065), friction=0.2)
        scene = Scene("ball", WhiskerArray.mouse(side=side, whiskers="C2"), (ball,), Whisking(), frames=frames)
        dataset = simulate(scene, fidelity=Fidelity.preset("fast"), cache=False)
        assert dataset["contact"].values.any()
        wrenches.append(dataset["wrench"].values[0, :, 0].astype(float))
    # Forces are vectors and moments pseudo-vectors of the mirror x → −x.
    mirrored = wrenches[0] * [-1, 1, 1, 1, -1, -1]
    scale = np.abs(wrenches[0]).max(axis=0)
    np.testing.assert_allclose(wrenches[1] / scale, mirrored / scale, atol=0.02)


def test_a_still_whisker_in_front_of_a_distant_object_feels_exactly_nothing():
    far = PlacedObject(sphere(1e-3), position=(0.5, 0.0, 0.0))
    dataset = simulate(Scene("far", STRAIGHT, (far,), Still()), fidelity=Fidelity.preset("fast"), cache=False)
    assert (dataset["wrench"].values == 0).all()
    assert not dataset["contact"].values.any()


def test_c0_to_c3_touch_each_of_the_six_rodgers_stimuli_after_the_start():
    scenes = get_recipe("rodgers", whiskers="C0-C3").scenes
    dataset = simulate(scenes, fidelity=Fidelity.preset("fast"), cache=False)
    assert (dataset["status"] == "ok").all()
    touched = dataset["contact"].values.any(axis=2)
    assert touched.any(axis=1).all()
    assert not touched[:, 0].any()
    # No whisker reaches a stimulus before it has left its retracted pose.
    assert dataset["time"].values[touched.any(axis=0)].min() > 0.01


@pytest.mark.slow
def test_all_thirty_whiskers_stay_sound_on_the_six_stimuli_and_a_finer_simulation_says_the_same():
    dissimilarities = []
    for fidelity in (Fidelity.preset("balanced"), Fidelity(links=16, time_step=5e-5, steps_per_period=30)):
        dataset = simulate(get_recipe("rodgers").scenes, fidelity=fidelity, cache=False)
        assert (dataset["status"] == "ok").all()
        counts = dataset["contact"].any("time").sum("whisker").values
        # The unbent whiskers of the whisking array cut these objects 11, 8, 5 and 12, 7, 4 times.
        np.testing.assert_allclose(counts, [11, 8, 5, 12, 7, 4], atol=1)
        wrench = dataset["wrench"].values
        force = np.linalg.norm(wrench[..., :3], axis=-1).max(axis=(1, 2))
        assert (force > 1e-5).all()
        assert (force < 1e-3).all()
        scaled = wrench / np.repeat([1e-4, 1e-6], 3)
        dissimilarities.append(1 - np.corrcoef(scaled.reshape(6, -1))[np.triu_indices(6, 1)])
    assert np.corrcoef(dissimilarities)[0, 1] > 0.98
