"""Sound of contacts and drives: resonances, energy of impacts, pitch, distance and delay, materials apart."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics.engines import MujocoEngine
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.audio.modes import find_modes
from robotics_bridge.sensors.audio.runtime import Microphone, joint_drive
from robotics_bridge.sensors.audio.sensors import ActuationAudio, ContactAudio, Modes
from robotics_bridge.sensors.suite import SensorSuite
from tests.factories.touch_scenes import DT, MODES, RATE, K, box_scene, make_box, require_processor, strike, touch_box


def test_an_impact_rings_as_the_sum_of_damped_modes():
    suite, state = make_box()
    heard = strike(suite, state, 20)
    t = np.arange(1, len(heard) + 1) / RATE
    impulse = 10 * DT
    expected = sum(
        impulse * gain * np.exp(-decay * (t - 1 / RATE)) * np.sin(2 * np.pi * frequency * t)
        for frequency, decay, gain in MODES.rows()
    )
    assert heard == pytest.approx(expected, abs=2e-3 * np.abs(expected).max())


def test_what_rings_rings_on_when_the_time_step_changes():
    suite, state = make_box()
    heard, times, now = [strike(suite, state, 1)], [np.arange(1, K + 1) / RATE], DT
    for dt in (DT, DT / 2, DT / 2, DT, 0.8 * DT, DT):
        suite.update(state, dt)
        heard.append(suite.read("sound")[0, 0].numpy().copy())
        times.append(now + dt / K * np.arange(1, K + 1))
        now += dt
    t, impulse = np.concatenate(times), 10 * DT
    expected = sum(
        impulse * gain * np.exp(-decay * (t - 1 / RATE)) * np.sin(2 * np.pi * frequency * t)
        for frequency, decay, gain in MODES.rows()
    )
    assert np.concatenate(heard) == pytest.approx(expected, abs=5e-3 * np.abs(expected).max())


def test_a_microphone_keeps_its_time_step():
    suite, state = make_box()
    listener = Microphone().build(suite)
    for dt in (DT, DT):
        suite.update(state, dt)
        listener.update(state, dt)
    with pytest.raises(UsageError, match=r"stays as it was; received another, 0\.00495 s"):
        listener.update(state, 0.99 * DT)


def test_the_spectrum_peaks_at_the_modal_frequencies():
    suite, state = make_box()
    heard = strike(suite, state, 60)
    spectrum = np.abs(np.fft.rfft(heard * np.hanning(len(heard))))
    frequency = np.fft.rfftfreq(len(heard), 1 / RATE)
    for mode in MODES.frequency:
        near = np.abs(frequency - mode) < 100
        assert frequency[near][spectrum[near].argmax()] == pytest.approx(mode, abs=4)
        assert spectrum[near].max() > 20 * np.median(spectrum)


def test_loudness_grows_with_the_impulse_and_a_steady_load_is_silent():
    suite, state = make_box()
    soft, hard = strike(*make_box(), 4, force=5.0), strike(*make_box(), 4, force=50.0)
    assert hard == pytest.approx(10 * soft, abs=float(1e-4 * np.abs(hard).max()))
    touch_box(state, 30.0)
    for _ in range(400):
        suite.update(state, DT)
    assert np.abs(suite.read("sound").numpy()).max() < 1e-4 * np.abs(hard).max()
    quiet = strike(*make_box(threshold=20.0), 3, force=15.0)
    assert np.all(quiet == 0)


def test_a_longer_contact_excites_high_modes_less():
    def share(contact_time: float) -> float:
        heard = strike(*make_box(contact_time=contact_time), 40)
        spectrum = np.abs(np.fft.rfft(heard)) ** 2
        frequency = np.fft.rfftfreq(len(heard), 1 / RATE)
        return spectrum[frequency > 3000].sum() / spectrum.sum()

    assert share(1e-3) < 0.1 * share(0.0)


def test_sliding_colours_the_same_resonances_and_grows_with_speed_and_force():
    def rub(speed: float, force: float = 2.0) -> np.ndarray:
        suite, state = make_box(threshold=1e9)
        touch_box(state, force)
        velocity = np.zeros((1, 3, 6))
        velocity[0, 2, 0] = speed
        state.set_velocity(velocity)
        heard = []
        for _ in range(200):
            suite.update(state, DT)
            heard.append(suite.read("sound")[0, 0].numpy().copy())
        return np.concatenate(heard[40:])

    slow = rub(0.1)
    assert np.all(rub(0.0) == 0)
    assert rub(0.2) == pytest.approx(2 * slow, rel=1e-3, abs=1e-6)
    assert rub(0.1, 6.0) == pytest.approx(3 * slow, rel=1e-3, abs=1e-6)
    spectrum = np.abs(np.fft.rfft(slow)) ** 2
    frequency = np.fft.rfftfreq(len(slow), 1 / RATE)
    near = np.any([np.abs(frequency - mode) < 60 for mode in MODES.frequency], axis=0)
    assert spectrum[near].sum() > 0.8 * spectrum.sum()


def test_modes_beyond_half_the_sample_rate_are_left_out():
    sensor = ContactAudio(link="box", modes=Modes((500.0, 20_000.0), (5.0, 5.0), (1.0, 100.0)), samples=K)
    suite, state = SensorSuite(box_scene(), {"sound": sensor}, num_envs=1), HandState.empty(1, 3, 4)
    assert np.abs(strike(suite, state, 3)).max() < 2 * 10 * DT


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0, True])
def test_modes_have_finite_numbers(value):
    for row in ((value, 1.0, 1.0), (1.0, value, 1.0)):
        with pytest.raises(UsageError, match=rf"of a mode .*received {value}"):
            Modes(*((number,) for number in row))


_DROP = """
<mujoco><option timestep="0.005"/><worldbody>
  <body name="slab"><geom name="slab" type="box" size="0.15 0.1 0.015"/></body>
  <body name="ball" pos="0.03 0.02 0.036"><freejoint/><geom name="ball" size="0.02" mass="0.05"/></body>
</worldbody></mujoco>"""


@pytest.mark.slow
def test_balls_on_wood_metal_and_glass_are_told_apart_by_a_linear_classifier_at_new_speeds():
    """Train on some impact speeds, test on others; features are log band powers, level removed."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    envs = 48
    rng = np.random.default_rng(0)
    model = mujoco.MjModel.from_xml_string(_DROP)
    materials = ("wood", "metal", "glass")
    engine = MujocoEngine(model, envs, threads=1)
    modes = {name: find_modes(engine.scene.geometries[0], name, cells=8) for name in materials}
    sensors = {name: ContactAudio(link="slab", samples=K, modes=modes[name]) for name in materials}
    suite = SensorSuite(engine.scene, sensors, num_envs=envs)
    velocity = np.zeros((envs, 6))
    velocity[:, 2] = -rng.uniform(0.3, 3.0, envs)
    velocity[:, :2] = rng.normal(0, 0.2, (envs, 2))
    engine.set(qvel=velocity)
    blocks = {name: [] for name in materials}
    for _ in range(60):
        engine.step()
        suite.update(engine.state, engine.timestep)
        for name in materials:
            blocks[name].append(suite.read(name)[:, 0].numpy().copy())
    features, labels, speed = [], [], np.abs(velocity[:, 2])
    for label, name in enumerate(materials):
        heard = np.concatenate(blocks[name], axis=1)
        assert np.all(np.abs(heard).max(axis=1) > 0)
        power = np.abs(np.fft.rfft(heard, axis=1)[:, 1:]) ** 2
        bands = np.log(power[:, : power.shape[1] // 64 * 64].reshape(envs, 64, -1).mean(axis=2) + 1e-20)
        features.append(bands - bands.mean(axis=1, keepdims=True))
        labels.append(np.full(envs, label))
    slow = np.tile(speed < np.median(speed), 3)
    x, y = np.concatenate(features), np.concatenate(labels)
    for train in (slow, ~slow):
        rule = make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000)).fit(x[train], y[train])
        assert rule.score(x[~train], y[~train]) >= 0.95


@pytest.mark.gpu
def test_cpu_and_cuda_agree():
    require_processor()
    heard = {}
    for device in ("cpu", "cuda"):
        sensors = {
            "contact": ContactAudio(link="box", modes=MODES, samples=K),
            "drives": ActuationAudio(link="box", joints=3, samples=K, hum=0.01),
        }
        suite, state = SensorSuite(box_scene(), sensors, num_envs=4, device=device), HandState.empty(4, 3, 16, device)
        listener = Microphone(position=(0.5, 0.0, 0.2)).build(suite)
        velocity = np.zeros((4, 3, 6))
        velocity[:, 2, 0] = 0.1
        state.set_velocity(velocity)
        joint_drive(suite, "drives")[1].fill_(7.0)
        blocks = []
        for block in range(6):
            if block == 1:
                touch_box(state, 10.0, envs=(0, 2))
            suite.update(state, DT)
            listener.update(state, DT)
            blocks.append(np.concatenate([listener.read().cpu().numpy(), suite.read("contact")[:, 0].cpu().numpy()]))
        heard[device] = np.stack(blocks)
    assert heard["cuda"] == pytest.approx(heard["cpu"], abs=float(2e-4 * np.abs(heard["cpu"]).max()))
