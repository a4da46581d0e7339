"""On a GPU sensors read what they read on a processor, also when an update is a replayed graph.

An episode of the published pyramid is kept in a file with what every class of sensor read on a processor;
``python -m tests.robotics_bridge.sensors.test_cuda`` writes it anew. Letters: T update, B environment.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robotics_bridge.physics import HandState, MujocoEngine, MujocoWarpEngine, TouchScene
from robotics_bridge.sensors import (
    ContactAudio,
    ContactDepthProbe,
    ContactProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Noise,
    Probes,
    ProximityTaxel,
    SensorSuite,
    SurfaceDistanceProbe,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio.sensors import Modes
from robotics_bridge.sensors.noise.stages import simulate
from tests.factories.touch_scenes import falling, pyramid, require_processor

TOLERANCE = {"ray": 2e-3, "gel": 1e-4, "sound": 2e-4}
"""Parts of the largest reading by which devices may differ; elsewhere rounding alone."""
TOTALS = {"sum": 1e-5, "sum and stick": 5e-3}
"""The same of sums over taxels, where how a face is shared is a choice and its force and moment are not. Noise of
single taxels is among the second."""


KEPT = Path(__file__).with_name("episode.npz")
CONTACT = ("geom", "env", "distance", "position", "normal", "force", "friction")
ENVS, UPDATES, ROOM, RESTARTED = 3, 5, 384, [1]
_PRESETS = {name: replace(Noise.preset(f"published-{name}"), quantum=0.0) for name in ("force", "depth", "proximity")}
# Rounding to steps would turn last digits into whole steps.
FULL = _PRESETS["force"]


def sensors() -> dict[str, Any]:
    """Return sensors of every class, clean and noisy."""
    grid = Probes.grid(7, 8, size=(0.24, 0.24), center=(0, 0, 0.125), radius=0.01)
    common: dict[str, Any] = {"link": "box0", "probes": grid, "track": ("box1",)}
    force = KinematicTaxel(**common, total="law")
    found: dict[str, Any] = {
        "distance": SurfaceDistanceProbe(**common),
        "bit": ContactProbe(**common),
        "depth": ContactDepthProbe(**common, noise=_PRESETS["depth"]),
        "ray": ContactDepthProbe(**common, query="raycast"),
        "force": force,
        "thesis": replace(force, convention="thesis", noise=FULL, twist=None),
        "crosstalk": replace(force, noise=replace(FULL, crosstalk=0.3)),
        "every link": replace(force, track=(), noise=FULL),
        "stick": replace(force, friction=0.8),
        "sum": replace(force, total="engine"),
        "sum and stick": replace(force, total="engine", friction=0.8, noise=FULL),
        "near": ProximityTaxel(**common, points=2000),
        "near, noisy": ProximityTaxel(**common, points=2000, noise=_PRESETS["proximity"]),
        "gel": ElastomerTaxel(**common, points=400),
        "grid": TemperatureGrid(link="box0", cells=(2, 2, 2)),
        "sound": ContactAudio(link="box0", modes=Modes((200.0, 450.0), (40.0, 60.0), (1.0, 0.5)), samples=40),
    }
    return found


def fill(state: HandState, kept: dict[str, np.ndarray], update: int) -> None:
    """Write one update of the episode into a state."""
    state.set_pose(kept["pose"][update])
    state.set_velocity(kept["velocity"][update])
    count = int(kept["count"][update])
    values = {name: kept[f"contact.{name}"][update, :count] for name in CONTACT}
    state.set_contacts(values.pop("env"), values.pop("geom"), **values)


def readings(kept: dict[str, np.ndarray], device: str) -> dict[str, np.ndarray]:
    """Return what the sensors read [T, B, …] over the episode, with a reset in its middle, and one noisy signal."""
    config, scene = sensors(), TouchScene.from_mujoco(pyramid())
    suite = SensorSuite(scene, config, num_envs=ENVS, device=device)
    state = HandState.empty(ENVS, len(scene.links), ROOM, device)
    read: dict[str, list[np.ndarray]] = {name: [] for name in config}
    for update in range(UPDATES):
        fill(state, kept, update)
        suite.update(state)
        for name, rows in read.items():
            rows.append(suite.read(name).cpu().numpy().copy())
        # After the reset nothing could be read but zeros.
        if update == UPDATES // 2:
            suite.reset(RESTARTED)
    signal = np.random.default_rng(1).normal(size=(6, 8, 12, 6)).astype(np.float32)
    measured = simulate(replace(FULL, crosstalk=0.3), signal, dt=0.01, layout=(3, 4), device=device)
    return {**{name: np.stack(rows) for name, rows in read.items()}, "noise alone": measured}


def record() -> dict[str, np.ndarray]:
    """Return the states of the episode, from the processor's engine."""
    model = pyramid()
    engine = MujocoEngine(model, ENVS, contacts=128)
    engine.set(qvel=falling(ENVS, model.nv))
    engine.step(150)
    rows: dict[str, list[np.ndarray]] = {}
    for _ in range(UPDATES):
        engine.step()
        state = engine.state
        row = {"pose": state.pose_torch[..., [0, 1, 2, 6, 3, 4, 5]].numpy(), "velocity": state.velocity.numpy()}
        row |= {f"contact.{name}": getattr(state, f"contact_{name}").numpy()[:ROOM] for name in CONTACT}
        row["count"] = state.contact_count.numpy()[0]
        for name, value in row.items():
            rows.setdefault(name, []).append(np.array(value))
    return {name: np.stack(values) for name, values in rows.items()}


def load() -> dict[str, np.ndarray]:
    """Return the episode and its readings, under ``reading.NAME``."""
    with np.load(KEPT, allow_pickle=False) as kept:
        return {name: kept[name] for name in kept.files}


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_an_episode_reads_as_it_did_on_the_processor_that_kept_it(device: str) -> None:
    kept = load()
    found = readings(kept, device)
    assert set(found) == {name.removeprefix("reading.") for name in kept if name.startswith("reading.")}
    for name, read in found.items():
        expected = kept[f"reading.{name}"]
        if name in TOTALS:
            read, expected = (values.sum((2, 3)) for values in (read, expected))
            force = np.abs(expected[..., :3]).max()
            # Moments about the link's origin: of forces that lie up to .12 m from it.
            np.testing.assert_allclose(read, expected, rtol=0, atol=TOTALS[name] * force, err_msg=name)
            continue
        assert np.abs(expected).max() > 0, name
        atol = TOLERANCE.get(name, 1e-5) * np.abs(expected).max()
        np.testing.assert_allclose(read, expected, rtol=0, atol=atol, err_msg=name)


@pytest.mark.gpu
def test_sensors_follow_the_engine_of_the_gpu() -> None:
    require_processor()
    model, config = pyramid(), sensors()
    engine = MujocoWarpEngine(model, 8, device="cuda", contacts=128)
    engine.set(qvel=falling(8, model.nv))
    engine.step(50)
    suites = [SensorSuite(engine.scene, config, num_envs=8, device=device) for device in ("cpu", "cuda")]
    mirror = HandState.empty(8, engine.state.num_links, engine.state.contact_env.shape[0])
    for _ in range(6):
        engine.step()
        count = int(engine.state.contact_count.numpy()[0])
        mirror.set_pose(engine.state.pose_torch[..., [0, 1, 2, 6, 3, 4, 5]])
        mirror.set_velocity(engine.state.velocity.numpy())
        contacts = {n: getattr(engine.state, f"contact_{n}").numpy()[:count] for n in CONTACT}
        mirror.set_contacts(contacts.pop("env"), contacts.pop("geom"), **contacts)
        for suite, state in zip(suites, (mirror, engine.state), strict=True):
            suite.update(state, engine.timestep)
    for name in config:
        here, there = (suite.read(name).cpu().numpy() for suite in suites)
        np.testing.assert_allclose(there, here, atol=2e-3 * np.abs(here).max(), err_msg=name)


def main() -> None:
    kept = record()
    read = readings(kept, "cpu")
    np.savez_compressed(KEPT, allow_pickle=False, **kept, **{f"reading.{name}": value for name, value in read.items()})


if __name__ == "__main__":
    main()
