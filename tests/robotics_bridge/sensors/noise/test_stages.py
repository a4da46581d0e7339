"""Stages of the noise: published sequences, moments of every distribution, independence of the batch."""

import math
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from brainbench.core.errors import UsageError
from robotics_bridge.sensors.context import LaunchContext, ReadoutSlice
from robotics_bridge.sensors.noise.model import Noise, stream_key
from robotics_bridge.sensors.noise.stages import ReadingNoise, gaussian_weights, noise_params, simulate
from tests.factories.touch_scenes import require_processor


def _constant(value: float = 0.0, steps: int = 50, envs: int = 40, probes: int = 30, channels: int = 2) -> np.ndarray:
    return np.full((steps, envs, probes, channels), value, dtype=np.float32)


def test_hysteresis_follows_the_published_sequence():
    noise = Noise(hysteresis=0.5, hysteresis_tau=0.05)
    read = simulate(noise, _constant(0.03, steps=5, envs=1, probes=1, channels=1), dt=0.01).ravel()
    assert read == pytest.approx([0.045, 0.042281, 0.040055, 0.038232, 0.036740], abs=1e-6)


@settings(max_examples=15)
@given(st.floats(-1.0, 2.0), st.floats(0.002, 1.0), st.sampled_from([1e-3, 5e-3, 0.03]))
def test_hysteresis_equals_its_two_equations_for_any_signal(strength, tau, dt):
    x = np.cumsum(np.random.default_rng(0).normal(size=(40, 1, 3, 1)), axis=0).astype(np.float32)
    xi, before, expected = 0.0, 0.0, []
    for value in x.astype(float):
        xi = math.exp(-dt / tau) * xi + (value - before)
        before = value
        expected.append(value + strength * xi)
    read = simulate(Noise(hysteresis=strength, hysteresis_tau=tau), x, dt=dt)
    assert read == pytest.approx(np.array(expected), rel=2e-4, abs=2e-4)


def test_white_noise_is_standard_normal_and_independent_over_channels_and_time():
    read = simulate(Noise(white=1.0), _constant(steps=60), dt=0.01)
    assert stats.kstest(read.ravel(), "norm").pvalue > 0.01
    assert stats.kurtosis(read.ravel()) == pytest.approx(0, abs=0.05)
    assert abs(np.corrcoef(read[..., 0].ravel(), read[..., 1].ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(read[1:].ravel(), read[:-1].ravel())[0, 1]) < 0.02
    assert abs(np.corrcoef(read[:, 1:].ravel(), read[:, :-1].ravel())[0, 1]) < 0.02


def test_the_drift_grows_with_the_root_of_time_and_is_independent_of_the_white_noise():
    read = simulate(Noise(walk=0.1), _constant(), dt=0.01)
    assert np.diff(read, axis=0).std() == pytest.approx(0.1, rel=0.01)
    assert read[-1].std() == pytest.approx(0.1 * math.sqrt(50), rel=0.05)
    both = simulate(Noise(walk=0.1, white=1.0), _constant(), dt=0.01)
    white = simulate(Noise(white=1.0), _constant(), dt=0.01)
    assert both - white == pytest.approx(read, abs=1e-5)


def test_bias_and_quantisation_act_last():
    x = np.linspace(-1, 1, 60, dtype=np.float32).reshape(-1, 1, 1, 1)
    read = simulate(Noise(bias=0.013, quantum=0.1), x, dt=0.01)
    assert read == pytest.approx(0.1 * np.round((x + 0.013) / 0.1), abs=1e-6)


def test_gain_is_uniform_over_probes_and_holds_for_the_episode():
    read = simulate(Noise(gain=(0.85, 1.15)), _constant(2.0, steps=3, envs=60, probes=80), dt=0.01)
    assert np.ptp(read, axis=0).max() == 0
    assert np.ptp(read, axis=3).max() == 0
    assert stats.kstest(read[0, ..., 0].ravel() / 2, "uniform", args=(0.85, 0.3)).pvalue > 0.01


def test_dead_probes_are_as_many_as_asked_for_and_stuck_at_one_value_in_all_channels():
    noise = Noise(dead_probability=0.2, dead_range=(5.0, 7.0))
    read = simulate(noise, _constant(1.0, steps=3, envs=100, probes=100), dt=0.01)
    stuck = read[0, ..., 0] != 1.0
    assert stuck.mean() == pytest.approx(0.2, abs=0.015)
    assert np.ptp(read, axis=0).max() == 0
    assert read[..., 0] == pytest.approx(read[..., 1])
    assert stats.kstest(read[0, ..., 0][stuck], "uniform", args=(5, 2)).pvalue > 0.01


@cache
def _radius_kernel():
    from brainbench.core.devices import warp
    from robotics_bridge.sensors.kernels.noise import NoiseParams, radius_noise

    wp = warp()

    @wp.kernel(module="unique", enable_backward=False)
    def radii(p: NoiseParams, out: wp.array2d(dtype=wp.float32)):
        age, probe = wp.tid()
        out[age, probe] = radius_noise(p, 0, probe, age, 0)

    return radii


def test_the_radius_error_is_uniform_and_new_in_every_update():
    from brainbench.core.devices import warp

    wp = warp()
    out = wp.zeros((200, 50), dtype=wp.float32, device="cpu")
    wp.launch(_radius_kernel(), dim=(200, 50), inputs=[noise_params(Noise(radius=3e-4), 7, "a"), out], device="cpu")
    assert stats.kstest(out.numpy().ravel(), "uniform", args=(-3e-4, 6e-4)).pvalue > 0.01
    assert abs(np.corrcoef(out.numpy()[1:].ravel(), out.numpy()[:-1].ravel())[0, 1]) < 0.03


_FULL = Noise(
    white=0.1, walk=0.02, bias=0.3, quantum=1e-3, gain=(0.8, 1.2), dead_probability=0.1, hysteresis=0.5,
    read_delay=0.02, jitter=0.01, crosstalk=0.3,
)  # fmt: skip


def test_an_environment_reads_the_same_in_any_batch():
    x = np.random.default_rng(1).normal(size=(6, 8, 12, 6)).astype(np.float32)
    together = simulate(_FULL, x, dt=0.01, layout=(3, 4))
    apart = [simulate(_FULL, x[:, i : i + 2], dt=0.01, layout=(3, 4), env_offset=i) for i in range(0, 8, 2)]
    assert np.array_equal(together, np.concatenate(apart, axis=1))


def test_other_seeds_and_other_names_read_differently_and_the_same_ones_alike():
    x = _constant(steps=2, envs=2, probes=3)
    first = simulate(Noise(white=1.0), x, dt=0.01, seed=1)
    assert np.array_equal(first, simulate(Noise(white=1.0), x, dt=0.01, seed=1))
    for other in ({"seed": 2}, {"seed": 1, "name": "other"}):
        assert not np.any(first == simulate(Noise(white=1.0), x, dt=0.01, **other))
    assert stream_key(1, "23") != stream_key(12, "3")


def test_a_normalised_crosstalk_keeps_the_total_away_from_the_edge_and_strength_zero_changes_nothing():
    x = np.zeros((1, 1, 15 * 17, 1), np.float32)
    x[0, 0, 7 * 17 + 8] = 1
    spread = simulate(Noise(crosstalk=0.6, crosstalk_sigma=1.2), x, dt=0.01, layout=(15, 17)).reshape(15, 17)
    assert spread.sum() == pytest.approx(1, abs=1e-5)
    weights = gaussian_weights(1.2, 5)
    assert spread[7, 9] == pytest.approx(0.6 * weights[0] * weights[1], rel=1e-5)
    assert spread[7, 8] == pytest.approx(0.4 + 0.6 * weights[0] ** 2, rel=1e-5)
    assert spread == pytest.approx(spread[::-1, ::-1], abs=1e-7)
    assert np.array_equal(simulate(Noise(bias=0.0), x, dt=0.01), x)


def test_crosstalk_loses_at_the_edge_what_falls_off_it():
    from scipy.ndimage import correlate1d

    x = np.random.default_rng(2).normal(size=(1, 2, 20, 3)).astype(np.float32)
    read = simulate(Noise(crosstalk=0.4, crosstalk_sigma=0.8), x, dt=0.01, layout=(4, 5))
    half = gaussian_weights(0.8, 4)
    kernel = np.concatenate([half[:0:-1], half])
    grid = x.reshape(2, 4, 5, 3)
    blurred = correlate1d(correlate1d(grid, kernel, axis=1, mode="constant"), kernel, axis=2, mode="constant")
    assert read.reshape(2, 4, 5, 3) == pytest.approx(0.6 * grid + 0.4 * blurred, abs=1e-5)


def test_crosstalk_without_a_grid_is_refused():
    with pytest.raises(UsageError, match=r"'sensor' .* 4 probes"):
        simulate(Noise(crosstalk=0.5), _constant(probes=4), dt=0.01)


@pytest.mark.parametrize("layout", [(2, 3), (4,), (-2, -2), (2, 2.0)])
def test_a_layout_is_that_of_the_probes(layout):
    if layout == (4,):
        simulate(Noise(), _constant(probes=4), dt=0.01, layout=layout)
        return
    with pytest.raises(UsageError, match="layout"):
        simulate(Noise(), _constant(probes=4), dt=0.01, layout=layout)


@pytest.mark.parametrize("dt", [0.0, -0.01, math.nan, math.inf, True, "0.1"])
def test_time_goes_on(dt):
    with pytest.raises(UsageError, match=rf"dt .*{dt}"):
        simulate(Noise(hysteresis=0.5), _constant(), dt=dt)


def test_late_readings_hold_the_last_value_and_carry_the_noise_of_their_time():
    ramp = np.arange(20, dtype=np.float32).reshape(-1, 1, 1, 1)
    assert simulate(Noise(read_delay=0.03), ramp, dt=0.01).ravel() == pytest.approx(np.maximum(np.arange(20) - 3, 0))
    # Between two updates the earlier one is held.
    assert simulate(Noise(read_delay=0.025), ramp, dt=0.01).ravel() == pytest.approx(np.maximum(np.arange(20) - 3, 0))
    now = simulate(Noise(white=1.0), ramp, dt=0.01)
    late = simulate(Noise(white=1.0, read_delay=0.03), ramp, dt=0.01)
    assert np.array_equal(late[3:], now[:-3])


def test_jitter_varies_the_delay_within_its_bounds_and_alike_for_all_probes():
    ramp = np.broadcast_to(np.arange(300, dtype=np.float32).reshape(-1, 1, 1, 1), (300, 5, 4, 1))
    age = ramp - simulate(Noise(read_delay=0.05, jitter=0.05), ramp, dt=0.01)
    settled = age[20:]
    assert np.ptp(settled, axis=2).max() == 0
    assert set(np.unique(settled)) == set(range(1, 11))
    assert settled.mean() == pytest.approx(5.5, abs=0.3)
    assert not np.array_equal(settled[:, 0], settled[:, 1])


def _stage(noise: Noise, envs: int = 3, probes: int = 4, active: np.ndarray | None = None, gained: bool = True):
    from brainbench.core.devices import pick_device

    context = LaunchContext(envs, pick_device("cpu"), 0, 0)
    context.age.fill_(0)
    slices = [ReadoutSlice("sensor", noise, 0, (probes,), active=active)]
    return context, ReadingNoise(slices, 1, context, fusable=False, gained=gained)


def test_a_reset_redraws_and_forgets_in_its_environment_alone():
    noise = Noise(walk=1.0, gain=(0.5, 2.0), hysteresis=1.0)
    clock, stage = _stage(noise, gained=False)
    out = stage.io.measured

    def read(x: float = 1.0) -> np.ndarray:
        out.fill_(x)
        stage.launch(0.01)
        return out.numpy()[0].copy()

    for step in range(10):
        clock.age.fill_(step)
        before = read()
    clock.age.assign(np.array([10, 0, 10], np.int32))
    clock.episode.assign(np.array([0, 1, 0], np.int32))
    begun = read()
    change = np.abs(begun - before)
    gain = begun[1] / 2  # x_0 (1 + β) plus one step of the walk
    assert np.all(change[[0, 2]] < 5)
    assert np.all((gain > 0.5 - 2) & (gain < 2 + 2))
    clock.age.assign(np.array([11, 0, 11], np.int32))
    clock.episode.assign(np.array([0, 1, 0], np.int32))
    again = out.numpy()[0, 1].copy()
    assert np.array_equal(read()[1], again)


def test_fillers_read_zero_and_a_broken_environment_harms_no_other():
    noise = Noise(bias=1.0, walk=0.1, hysteresis=0.5)
    clock, stage = _stage(noise, active=np.array([True, True, False, True]))
    for step in range(3):
        clock.age.fill_(step)
        values = np.ones((1, 3, 4), np.float32)
        if step == 1:
            values[0, 1] = np.nan
        stage.io.measured.assign(values)
        stage.launch(0.01)
        read = stage.read().numpy()[0]
        assert np.all(read[:, 2] == 0)
        assert np.isnan(read[1, [0, 1, 3]]).all() == (step == 1)
        assert np.isfinite(read[[0, 2]]).all()


def test_the_state_counts_two_numbers_per_channel():
    _clock, stage = _stage(Noise(walk=1.0, hysteresis=0.5, read_delay=0.01), probes=10)
    read = 2 * 3 * 10  # the truth and what is measured
    assert sum(array.size for array in stage.memory) == read + 3 * 10 * 2
    plain = _stage(Noise(white=1.0, gain=(0.5, 2), dead_probability=0.5), probes=10)[1]
    assert sum(array.size for array in plain.memory) == read
    stage.launch(0.01)
    assert sum(array.size for array in stage.rings) == 3 * 3 * 10


def test_a_shorter_step_than_the_ring_has_room_for_is_refused():
    _clock, stage = _stage(Noise(read_delay=0.1))
    stage.launch(0.05)
    with pytest.raises(UsageError, match=r"21 readings.*room for 3"):
        stage.launch(0.005)


def test_a_signal_with_other_axes_is_refused():
    with pytest.raises(UsageError, match=r"received \(3, 4\)"):
        simulate(Noise(), np.zeros((3, 4)), dt=0.01)


@pytest.mark.slow
def test_noise_in_the_sensors_kernel_and_in_stages_measures_alike():
    from robotics_bridge.physics import Geometry, HandState, TouchScene
    from robotics_bridge.sensors import KinematicTaxel, Probes, SensorSuite

    shapes = (
        Geometry(name="pad", link="pad", kind="box", size=(0.02, 0.02, 0.005), position=(0, 0, -0.005)),
        Geometry(name="ball", link="ball", kind="sphere", size=(0.02,)),
    )
    knobs = {
        "white": 0.1, "walk": 0.02, "bias": 0.3, "gain": (0.8, 1.2), "dead_probability": 0.2, "dead_range": (1.0, 2.0),
        "hysteresis": 0.5, "radius": 1e-3,
    }  # fmt: skip
    read = {}
    for way, crosstalk in (("fused", 0.0), ("staged", 1e-12)):
        probes = Probes.grid(4, 5, size=(0.02, 0.02), radius=0.004)
        taxels = KinematicTaxel(link="pad", probes=probes, noise=Noise(**knobs, crosstalk=crosstalk))
        suite = SensorSuite(TouchScene(("pad", "ball"), shapes), {"taxels": taxels}, num_envs=3, seed=5)
        state = HandState.empty(3, 2, 3)
        state.set_contacts([0, 1, 2], [[0, 1]] * 3)
        pose = np.zeros((3, 2, 7))
        pose[..., 3] = 1
        pose[:, 1, 2] = [0.018, 0.019, 0.0195]
        state.set_pose(pose)
        for step in range(6):
            if step == 3:
                suite.reset([1])
            suite.update(state, 0.01)
        read[way] = suite.read("taxels").numpy().copy()
    assert read["staged"] == pytest.approx(read["fused"], rel=1e-4, abs=1e-5)


@pytest.mark.gpu
def test_cpu_and_cuda_measure_the_same_bits():
    require_processor()
    x = np.random.default_rng(1).normal(size=(20, 64, 12, 6)).astype(np.float32)
    cpu, cuda = (simulate(_FULL, x, dt=0.01, layout=(3, 4), device=device) for device in ("cpu", "cuda"))
    assert np.array_equal(cpu, cuda)
