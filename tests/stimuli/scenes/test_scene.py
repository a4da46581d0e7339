from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation, euler_matrix
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.motion.jobs import Trace
from brainbench.stimuli.motion.recorded import Recorded, Trajectory
from brainbench.stimuli.motion.trajectories import ArrayFollicle, Path, Still, Translation, Whisking
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from brainbench.stimuli.scenes.scene import Frames, Head, Scene, clip_wrenches, low_pass
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.stimulus_set import read_stimulus_set, to_axes, write_stimulus_set
from brainbench.stimuli.sweeps.sweep_scenes import Span, SweepGrid
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engines import FakeEngine

ARRAY = WhiskerArray.mouse(whiskers="C1,C2")
TURNED = Head((0.01, 0.02, 0.03), (0.2, -0.4, 0.7))


class ToneEngine(WhiskerEngine):
    """Forces are sines (N) of one frequency (Hz)."""

    name = "tone"

    def __init__(self, frequency):
        super().__init__()
        self.frequency = frequency

    def run(self, jobs, fidelity, *, progress=None, workers=None, record_shape=False):
        return [self._trace(job.times) for job in jobs]

    def _trace(self, times):
        wrench = np.tile(np.sin(2 * np.pi * self.frequency * times)[:, None], (1, 6))
        nothing = np.zeros(len(times), bool)
        return Trace(wrench, nothing, np.full(len(times), np.nan))


def _simulate(frames, backend=None, labels=("a",), **changes):
    scenes = [Scene(label, ARRAY, frames=frames, **changes) for label in labels]
    return simulate(scenes, fidelity=Fidelity(), backend=backend or FakeEngine())


def _amplitude(frames, frequency):
    force = _simulate(frames, ToneEngine(frequency))["wrench"].values[0, 20:-20, 0, 0]
    return np.abs(force).max()


def test_without_a_filter_a_tone_above_nyquist_aliases_and_with_one_it_is_gone():
    # 100 frames per second show nothing above 50 Hz: 412 Hz appears as 12 Hz.
    plain = Frames(0.0, 0.01, 150)
    assert _amplitude(plain, 412.0) > 0.95
    assert _amplitude(Frames(0.0, 0.01, 150, average=20), 412.0) > 0.01
    for phase in ("zero", "causal"):
        assert _amplitude(Frames(0.0, 0.01, 150, average=20, lowpass=40.0, phase=phase), 412.0) < 2e-4


def test_a_slow_tone_passes_the_filter_unchanged_and_undelayed():
    frames = Frames(0.005, 0.01, 150, average=20, lowpass=40.0)
    force = _simulate(frames, ToneEngine(4.0))["wrench"].values[0, :, 0, 0]
    np.testing.assert_allclose(force[20:-20], np.sin(2 * np.pi * 4.0 * frames.times)[20:-20], atol=1e-3)


def test_the_causal_filter_delays_by_the_phase_of_a_butterworth_and_never_knows_the_future():
    times = np.arange(4000) / 1000
    cutoff, tone = 40.0, 4.0
    filtered = low_pass(np.sin(2 * np.pi * tone * times), 1000.0, cutoff, phase="causal")
    # H(s) = 1/∏(s² + a s + 1) with a = 2 sin(π/8), 2 sin(3π/8), at s = i tone/cutoff.
    s = 1j * tone / cutoff
    gain = 1 / np.prod([s**2 + 2 * np.sin(angle) * s + 1 for angle in (np.pi / 8, 3 * np.pi / 8)])
    expected = np.abs(gain) * np.sin(2 * np.pi * tone * times + np.angle(gain))
    np.testing.assert_allclose(filtered[2000:], expected[2000:], atol=5e-3)
    step = low_pass((times > 2.0).astype(float), 1000.0, cutoff, phase="causal")
    assert (step[times <= 2.0] == 0).all()
    assert low_pass((times > 2.0).astype(float), 1000.0, cutoff)[1995] > 0


@pytest.mark.parametrize(("phase", "gain"), [("causal", np.sqrt(0.5)), ("zero", 0.5)])
def test_the_cutoff_is_where_it_is_said_to_be(phase, gain):
    times = np.arange(8000) / 1000
    filtered = low_pass(np.sin(2 * np.pi * 30.0 * times), 1000.0, 30.0, phase=phase)
    assert np.abs(filtered[3000:5000]).max() == pytest.approx(gain, rel=2e-3)


def test_numbers_after_a_simulation_became_unstable_stay_unknown_and_spoil_nothing_before():
    signal = np.ones((400, 2))
    signal[250:, 1] = np.nan
    for phase in ("zero", "causal"):
        filtered = low_pass(signal, 1000.0, 50.0, phase=phase)
        assert np.isfinite(filtered[:, 0]).all()
        assert np.isfinite(filtered[:250, 1]).all()
        assert np.isnan(filtered[250:, 1]).all()
        np.testing.assert_allclose(filtered[100:250, 1], 1.0, atol=1e-3)


@given(
    first=st.floats(0.0, 0.05),
    interval=st.sampled_from([0.001, 0.009, 1 / 110]),
    average=st.integers(2, 12),
    phase=st.sampled_from(["zero", "causal"]),
)
def test_frames_lie_on_readings_and_readings_are_even(first, interval, average, phase):
    frames = Frames(first, interval, 7, average, lowpass=0.1 / interval, phase=phase)
    readings = frames.readings
    assert readings[0] >= 0
    np.testing.assert_allclose(np.diff(readings), interval / average, rtol=1e-6, atol=1e-12)
    split = frames.split(readings)
    assert split.shape == (7, average)
    np.testing.assert_allclose(split[:, 0], frames.times, atol=1e-12)
    np.testing.assert_allclose(frames.reduce(np.ones((len(readings), 3))).shape, (7, 3))


def test_means_of_readings_are_what_they_were():
    frames = Frames(0.001, 0.009, 5, average=3)
    values = np.arange(15.0) ** 2
    np.testing.assert_array_equal(frames.reduce(values), values.reshape(5, 3).mean(axis=1))
    np.testing.assert_allclose(frames.readings[:4], [0.001, 0.004, 0.007, 0.010])


def test_in_follicle_axes_the_whisker_points_along_x_and_the_world_returns():
    # The double's moment is the direction in which the whisker leaves its base.
    frames = Frames(0.002, 0.007, 12)
    world = _simulate(frames, head=TURNED)
    follicle = _simulate(Frames(0.002, 0.007, 12, axes="follicle"), head=TURNED)
    np.testing.assert_allclose(follicle["wrench"][..., 3:], np.broadcast_to([1, 0, 0], (1, 12, 2, 3)), atol=1e-6)
    assert np.abs(world["wrench"].values[..., 3:] - [1, 0, 0]).max() > 0.5
    assert (world.attrs["axes"], follicle.attrs["axes"]) == ("world", "follicle")
    assert follicle.attrs["frame"].startswith("follicle axes")
    back = to_axes(follicle, "world")
    np.testing.assert_allclose(back["wrench"], world["wrench"], atol=1e-6)
    assert back["wrench"].dtype == np.float32
    assert back.attrs["axes"] == "world"
    assert len({world.attrs["content_hash"], follicle.attrs["content_hash"], back.attrs["content_hash"]}) == 3
    np.testing.assert_allclose(to_axes(back, "follicle")["wrench"], follicle["wrench"], atol=1e-6)
    assert to_axes(world, "world") is world


def test_forces_in_follicle_axes_are_those_of_the_pose_at_the_frame():
    frames = Frames(0.0, 0.005, 9, axes="follicle")
    turned = _simulate(frames)["wrench"].values[0, :, 1, :3]
    position, euler = ArrayFollicle(ARRAY["C2"], Whisking()).pose(frames.times)
    np.testing.assert_allclose(turned, np.einsum("nji,nj->ni", base_rotation(euler), position), atol=1e-8)


def test_poses_that_are_not_in_a_set_cannot_be_invented():
    world = _simulate(Frames(0.0, 0.01, 4))
    with pytest.raises(UsageError, match=r"Frames\(axes='follicle'\)"):
        to_axes(world, "follicle")
    with pytest.raises(UsageError, match="did you mean 'follicle'"):
        to_axes(world, "folicle")  # type: ignore[arg-type]


def test_clipping_clips_and_counts_each_stimulus():
    plain = _simulate(Frames(0.0, 0.01, 10), labels=("a", "b"))["wrench"].values
    limit = float(np.median(np.abs(plain[..., :3])))
    clipped = _simulate(Frames(0.0, 0.01, 10, clip=limit), labels=("a", "b"))
    values = clipped["wrench"].values
    np.testing.assert_allclose(values[..., :3], np.clip(plain[..., :3], -limit, limit), rtol=1e-6)
    np.testing.assert_allclose(values[..., 3:], np.clip(plain[..., 3:], -limit * 1e-3, limit * 1e-3), rtol=1e-6)
    told = json.loads(clipped.attrs["clipped"])
    assert told["limit_N"] == limit
    assert set(told["components"]) == {"a", "b"}
    for label, part in zip(("a", "b"), plain, strict=True):
        count = told["components"][label]
        assert count["force"] == (np.abs(part[..., :3]) > np.float32(limit)).sum() > 0
        assert count["moment"] == (np.abs(part[..., 3:]) > np.float32(limit * 1e-3)).sum() > 0


def test_a_newton_is_the_published_range_and_what_is_unknown_stays_unknown():
    # 1000 in WHISKiT's mN and mN·mm.
    wrench = np.array([[1.2, -3.0, 0.5, 2e-3, -1e-3, np.nan]])
    values, changed = clip_wrenches(wrench, 1.0)
    np.testing.assert_array_equal(values, [[1.0, -1.0, 0.5, 1e-3, -1e-3, np.nan]])
    np.testing.assert_array_equal(changed, [[True, True, False, True, False, False]])


def test_first_contact_is_the_first_reading_with_contact_and_unknown_without():
    (position,), (euler,) = ArrayFollicle(ARRAY["C1"], Whisking()).pose(np.array([0.02]))
    whisker = ARRAY["C1"].whisker
    tip = position + base_rotation(euler)[:, :2] @ whisker.centre_line(whisker.arc_length)
    met = (PlacedObject(sphere(0.5e-3), position=tuple(tip)),)
    dense = _simulate(Frames(0.0, 0.001, 60), objects=met)
    coarse = _simulate(Frames(0.0, 0.01, 6, average=10), objects=met)
    filtered = _simulate(Frames(0.0, 0.01, 6, average=10, lowpass=40.0), objects=met)
    contact = dense["contact"].sel(whisker="C1").values[0]
    assert contact.any()
    assert not contact[0]
    expected = dense["time"].values[np.argmax(contact)]
    for dataset in (dense, coarse, filtered):
        assert dataset["first_contact"].dims == ("stimulus", "whisker")
        assert dataset["first_contact"].sel(whisker="C1").values[0] == pytest.approx(expected, abs=1e-12)
        assert np.isnan(dataset["first_contact"].sel(whisker="C2").values[0])
    np.testing.assert_array_equal(filtered["contact"], coarse["contact"])


def test_the_set_says_how_its_frames_were_made():
    assert _simulate(Frames(0.0, 0.01, 4)).attrs["readout"] == "instantaneous"
    assert _simulate(Frames(0.0, 0.01, 4, 5)).attrs["readout"] == "mean of 5 readings, 2 ms apart"
    text = _simulate(Frames(0.0, 0.01, 4, 20, lowpass=40.0, phase="causal")).attrs["readout"]
    assert text == "Butterworth low-pass of order 4 at 40 Hz, causal, on 20 readings, 0.5 ms apart"


def test_what_is_not_used_does_not_change_the_name_of_a_stimulus():
    assert Frames().config() == {"first": 0.001, "interval": 0.009, "count": 110, "average": 1}
    used = Frames(average=9, lowpass=40.0, axes="follicle", clip=1.0).config()
    assert used == {
        "first": 0.001, "interval": 0.009, "count": 110, "average": 9,
        "lowpass": 40.0, "phase": "zero", "axes": "follicle", "clip": 1.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lowpass": 60.0, "average": 20}, r"60 Hz lets aliases through.*nothing above 55.56 Hz"),
        ({"lowpass": 50.0}, r"50 Hz .*average is 1"),
    ],
)
def test_impossible_frames_are_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        Frames(**changes)


def test_a_set_in_follicle_axes_survives_the_disk_with_its_poses(tmp_path):
    dataset = _simulate(Frames(0.002, 0.007, 12, axes="follicle", clip=1.0), head=TURNED)
    stored = read_stimulus_set(write_stimulus_set(dataset, tmp_path / "set.h5"))
    np.testing.assert_array_equal(to_axes(stored, "world")["wrench"], to_axes(dataset, "world")["wrench"])
    assert stored.attrs["clipped"] == dataset.attrs["clipped"]


def test_in_follicle_axes_a_turning_head_changes_nothing_about_where_the_whisker_points():
    turn = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.5), (0.0, 0.0, 1.0))
    head = Head((0.01, 0.0, 0.0), (0.2, -0.4, 0.7), Path((0.0, 0.1, 0.2), ((0.0, 0.0, 0.0),) * 3, turn))
    dataset = _simulate(Frames(0.002, 0.007, 12, axes="follicle"), head=head, whisking=Still())
    np.testing.assert_allclose(dataset["wrench"][..., 3:], np.broadcast_to([1, 0, 0], (1, 12, 2, 3)), atol=1e-6)
    pointing = to_axes(dataset, "world")["wrench"].values[0, :, 0, 3:]
    assert np.abs(pointing[-1] - pointing[0]).max() > 0.1


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
