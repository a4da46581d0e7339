import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.stimuli.motion.recorded import Recorded, Trajectory
from brainbench.stimuli.motion.trajectories import Still, Translation
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from brainbench.stimuli.scenes.scene import Frames, Head, Scene
from brainbench.stimuli.sweeps.sweep_scenes import Span, SweepGrid
from brainbench.stimuli.whiskers.array import WhiskerArray

PAIR = WhiskerArray.mouse(whiskers="C1,C2")


def test_the_default_frames_are_those_of_the_published_pipeline():
    times = Frames().times
    assert len(times) == 110
    np.testing.assert_allclose(times * 1e3, np.arange(1000)[1::9][:110])


def test_the_readings_of_a_frame_fill_its_interval():
    frames = Frames(0.001, 0.009, 2, average=3)
    np.testing.assert_allclose(frames.times, [0.001, 0.010])
    np.testing.assert_allclose(frames.readings, [0.001, 0.004, 0.007, 0.010, 0.013, 0.016])


def test_a_scene_needs_a_label():
    with pytest.raises(UsageError, match="needs a label"):
        Scene("", PAIR)


def test_there_is_one_job_per_whisker_with_every_object():
    scene = Scene("two", PAIR, (PlacedObject(sphere(1e-3)), PlacedObject(sphere(2e-3))))
    jobs = scene.jobs()
    assert [job.whisker for job in jobs] == [mount.whisker for mount in PAIR]
    assert all(len(job.obstacles) == 2 for job in jobs)
    np.testing.assert_array_equal(jobs[0].times, Frames().times)


def test_objects_are_seen_from_the_array():
    head = Head((1e-3, 2e-3, 3e-3), (0.2, -0.3, 0.4))
    ball = PlacedObject(sphere(1e-3), position=(0.01, 0.02, 0.03))
    centre = Scene("ball", PAIR, (ball,), head=head).jobs()[0].obstacles[0].parts[0].centre
    back = euler_matrix(head.rotation) @ centre + head.position
    np.testing.assert_allclose(back, ball.position, atol=1e-15)


def test_moving_the_head_is_moving_the_object_the_other_way_as_the_whisker_sees_it():
    velocity, turn = np.array([0.01, -0.02, 0.03]), (0.2, -0.3, 0.4)
    ball = sphere(1e-3)
    moving_head = Scene(
        "a", PAIR, (PlacedObject(ball),), Still(), Head(rotation=turn, motion=Translation(tuple(velocity)))
    )
    moving_ball = Scene(
        "b", PAIR, (PlacedObject(ball, motion=Translation(tuple(-velocity))),), Still(), Head(rotation=turn)
    )
    times = np.linspace(0, 1, 11)
    first, second = moving_head.jobs()[0], moving_ball.jobs()[0]
    gap_first = np.array(first.obstacles[0].parts[0].centre) - first.follicle.pose(times)[0]
    gap_second = (
        np.array(second.obstacles[0].parts[0].centre)
        + second.obstacles[0].motion(times)[0]
        - second.follicle.pose(times)[0]
    )
    np.testing.assert_allclose(gap_first, gap_second, atol=1e-15)


def test_the_configuration_holds_everything_but_the_array():
    scene = Scene("one", PAIR)
    assert scene.config() == scene.select("C1").config()
    assert scene.config() != Scene("one", PAIR, whisking=Still()).config()
    assert scene.config() != Scene("one", PAIR, head=Head((0.0, 0.0, 1e-9))).config()


@pytest.mark.parametrize(
    "make",
    [
        lambda: PlacedObject(sphere(1e-3), rotation=(0, 0, 30)),
        lambda: Head(rotation=(0, 15, 0)),
        lambda: SweepGrid(rotation=(0, 30, 90)),
        lambda: SweepGrid(turns=(0, 90)),
        lambda: SweepGrid(rotation=Span(0, 89, 1)),
        lambda: WhiskerArray.mouse().replace("C2", angles=(80, 10, -30)),
        lambda: Recorded(Trajectory(("RC2",), np.zeros((1, 2, 3))), start=-10),
        lambda: Recorded(Trajectory(("RC2",), np.zeros((1, 2, 3))), initial={"RC2": (80, 10, -30)}),
    ],
)
def test_degrees_are_not_taken_for_radians(make):
    with pytest.raises(UsageError, match=r"\(rad\)"):
        make()
