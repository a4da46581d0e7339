"""Motions are cut so finely that cubic pieces follow them, and steps with them; what cannot be followed is refused."""

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.motion_pieces import KNOT, MOST_PIECES, SPEED_ERROR, Cutting
from brainbench.stimuli.engines.mujoco import MujocoWhiskerEngine
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.engines.stepping import SteppedJob
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.objects.obstacle import Obstacle, Sphere
from tests.factories.engine_scenes import C2, FLAT, Oscillation


def _cut(motion, stop=0.05, *, step=1e-4, finest=None):
    return Cutting(0.0, stop, step, step).cut(lambda t: motion(t)[:, None], finest, "a test")


def _pulse(at, width, height=1.0):
    return lambda t: np.where((t > at) & (t < at + width), height * np.sin(np.pi * (t - at) / width) ** 4, 0.0)


@pytest.mark.parametrize("frequency", [20.0, 200.0, 1000.0, 2000.0])
def test_pieces_follow_the_velocity_of_a_sinusoid(frequency):
    omega = 2 * np.pi * frequency
    pieces = _cut(lambda t: np.sin(omega * t))
    times, first = pieces.times(0.0)
    assert len(first) == len(pieces.count) + 1
    # SciPy's Hermite spline through the same knots.
    from scipy.interpolate import CubicHermiteSpline

    spline = CubicHermiteSpline(times, np.sin(omega * times), omega * np.cos(omega * times))
    fine = np.linspace(0, 0.05, 100_003)
    assert np.abs(spline(fine, 1) - omega * np.cos(omega * fine)).max() < 2 * SPEED_ERROR * omega
    assert (pieces.count > 1).any() == (frequency > 100)
    # No more than twice as fine as needed.
    coarser = CubicHermiteSpline(times[::4], np.sin(omega * times[::4]), omega * np.cos(omega * times[::4]))
    assert np.abs(coarser(fine, 1) - omega * np.cos(omega * fine)).max() > SPEED_ERROR * omega


def test_a_pulse_between_the_milliseconds_is_seen_and_cut_where_it_is():
    pieces = _cut(_pulse(0.5302, 1e-4), stop=1.0)
    fast = np.flatnonzero(pieces.count > 1)
    assert fast.tolist() == [530]
    limit = pieces.longest_steps(2e-3, 25)
    # Two milliseconds before it steps must not reach across it.
    assert np.flatnonzero(limit < 2e-3).tolist() == [528, 529, 530]
    assert limit[530] <= 1e-4 / 25


def test_a_motion_that_says_how_fine_it_is_is_looked_at_less_often():
    seen = []

    def motion(times):
        seen.append(len(times))
        return np.sin(40 * np.pi * times)

    _cut(motion, finest=0.05)
    told = sum(seen)
    seen.clear()
    _cut(motion)
    assert sum(seen) > 10 * told
    assert Whisking(frequency=8.0, onset=0.01).finest == 0.02


def test_corners_are_kept_and_do_not_shorten_the_steps():
    corners = np.array([0.0, 0.0103, 0.02, 1.0])
    pieces = _cut(lambda t: np.interp(t, corners, [0.0, 1.0, 0.3, 0.3]))
    found = set(np.flatnonzero(pieces.count == MOST_PIECES).tolist())
    assert {10} < found <= {10, 19, 20}
    assert (pieces.longest_steps(1e-4, 25) == 1e-4).all()


@pytest.mark.parametrize(
    ("motion", "culprit"),
    [
        (lambda t: np.where(t < 0.0123, 0.0, 0.5), "jumps by 0.5 mm at 0.0123 s"),
        (lambda t: 1e-3 * np.sin(2 * np.pi * 60e3 * t), "20 kHz"),
        (lambda t: np.where(t < 0.0123, 0.0, np.nan), "not finite at 0.01"),
    ],
)
def test_what_cannot_be_followed_is_refused(motion, culprit):
    with pytest.raises(UsageError, match=culprit):
        _cut(motion)


def _push(width, reach=1e-3):
    """A ball that lies just beside the whisker and is pushed against it once."""

    def motion(times):
        place = np.zeros((len(times), 3))
        place[:, 1] = _pulse(0.0102, width, reach)(times)
        return place, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return Obstacle((Sphere((0.008, -1.2e-3, 0.0), 1e-3),), motion, friction=0.0)


def test_an_obstacle_pulse_of_a_tenth_of_a_millisecond_is_felt_by_all_engines_alike():
    """Readings of .1 ms; engines share the motion and nothing else. Before, no engine felt it."""
    job = Job(C2, StillFollicle(), (_push(1e-4),), np.arange(1, 201) * 1e-4)
    runs = ((RodEngine(), "accurate"), (RodEngine(), "balanced"), (MujocoWhiskerEngine(), "balanced"))
    traces = [engine.run([job], Fidelity.preset(fidelity))[0] for engine, fidelity in runs]
    assert [trace.status for trace in traces] == ["ok"] * 3
    assert all(trace.contact.any() for trace in traces)
    fine, rod, mujoco = (np.abs(trace.wrench[:, 3:]).max() for trace in traces)
    assert fine > 1e-6
    assert rod == pytest.approx(fine, rel=0.03)
    assert mujoco == pytest.approx(fine, rel=0.1)


@pytest.mark.parametrize("amplitude", [1e-6, 0.0])
def test_equal_steps_follow_a_shake_too(amplitude):
    shake = Oscillation(shift=(0.0, amplitude, 0.0), rest=FLAT, frequency=1000.0)
    fidelity = Fidelity.preset("balanced")
    stepped = SteppedJob(Job(C2, shake, (), np.array([0.01])), fidelity, record_shape=False)
    given = fidelity.step_of(stepped.chain)
    if amplitude:
        assert 0.4 * KNOT / fidelity.steps_per_period < stepped.step <= KNOT / fidelity.steps_per_period
        assert stepped.step < given
    else:
        assert stepped.step == given


@pytest.mark.parametrize("engine", ["rod", "mujoco"])
@pytest.mark.parametrize(
    ("poses", "culprit"),
    [
        (lambda n: (np.zeros((n, 3)), np.zeros((n, 4))), "quaternion of zero length at"),
        (lambda n: (np.zeros((n, 3)), np.zeros((n - 1, 4))), r"one for each of the n = .* received the shapes"),
        (lambda n: (np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])), r"positions \[n, 3\] and quaternions"),
        (lambda n: (np.zeros((n, 2)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))), r"positions \[n, 3\] and quaternions"),
    ],
    ids=["zero quaternions", "too few quaternions", "one pose", "positions in a plane"],
)
def test_poses_of_objects_that_are_none_are_refused(engine, poses, culprit):
    ball = Obstacle((Sphere((0.008, 0.01, 0.0), 1e-3),), lambda times: poses(len(times)))
    job = Job(C2, StillFollicle(), (ball,), np.array([0.01]))
    with pytest.raises(UsageError, match=culprit):
        get_engine(engine).run([job], Fidelity(links=8))


def test_a_base_with_too_few_angles_is_refused():
    class Short:
        def pose(self, times):
            return np.zeros((len(times), 3)), np.zeros((len(times) - 1, 3))

    with pytest.raises(UsageError, match="base of a whisker must give positions"):
        RodEngine().run([Job(C2, Short(), (), np.array([0.01]))], Fidelity(links=8))
