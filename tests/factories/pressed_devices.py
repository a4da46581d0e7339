"""Synthetic devices that a ball presses, with faults: simulated taxels and their noise make the logs."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors.calibration.calibrate import Log
from robotics_bridge.sensors.calibration.devices import TOLERANCES, DeviceFit
from robotics_bridge.sensors.calibration.presses import SHARED, Device, Presses
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.noise.stages import simulate
from robotics_bridge.sensors.probes.placement import Probes
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.taxels.sensors import KinematicTaxel

DT, BALL, RADIUS, PITCH = 0.01, 5e-3, 4e-3, 4e-3
FAULTS = ("shifted", "axes", "gain", "friction", "delay")
KINDS: dict[str, dict[str, Any]] = {
    "3 × 3 taxels": {}, "2 × 5": {"shape": (2, 5)}, "4 × 4": {"shape": (4, 4)}, "1 × 1": {"shape": (1, 1)},
    "ball of 3 mm": {"ball": 3e-3}, "ball of 8 mm": {"ball": 8e-3}, "one channel": {"axes": 1},
    "curved, 12 mm": {"bend": 12e-3}, "8 touches": {"touches": 8},
}  # fmt: skip
"""Devices of other kinds, and how they are pressed; the first is that of the measurement."""


class Planted(NamedTuple):
    """A device, its log and the noise that was planted."""

    device: Device
    presses: Presses
    noise: Noise


def respond(presses: Presses, device: Device) -> np.ndarray:
    """Return the forces [T, N, 3] that simulated taxels of stiffness 1 feel."""
    blocks, step = presses.stretches(presses.near.any(axis=0)), presses.log.step
    scene = TouchScene(("device", "ball"), (Geometry(name="ball", link="ball", kind="sphere", size=(presses.radius,)),))
    law = {name: device.shared[name] for name in ("exponent", "damping", "friction", "grip")}
    here = Probes(device.place, presses.probes.normal, presses.probes.radius)
    taxel = KinematicTaxel(link="device", probes=here, stiffness=1.0, total="law", pairs="all", **law)
    suite = SensorSuite(scene, {"taxels": taxel}, num_envs=len(blocks))
    state = HandState.empty(len(blocks), 2, 1)
    pose, velocity = np.zeros((len(blocks), 2, 7)), np.zeros((len(blocks), 2, 6))
    pose[..., 3] = 1
    lengths = np.array([len(block) for block in blocks])
    rows = np.stack([np.pad(block, (0, lengths.max() - len(block)), mode="edge") for block in blocks])
    forces = np.zeros((len(presses.ball), len(here), 3))
    for index in range(rows.shape[1]):
        pose[:, 1, :3], velocity[:, 1, :3] = presses.ball[rows[:, index]], presses.speed[rows[:, index]]
        state.set_pose(pose)
        state.set_velocity(velocity)
        suite.update(state, step)
        pressed = index < lengths
        reading = suite.read_ground_truth("taxels").numpy().reshape(len(blocks), -1, 6)
        forces[rows[pressed, index]] = reading[pressed, :, :3]
    return forces


def bent(points: np.ndarray, bend: float) -> np.ndarray:
    """Return points [..., 3] of a flat pad and above it, laid around a cylinder of radius ``bend`` (m)."""
    angle, far = points[..., 0] / bend, bend + points[..., 2]
    return np.stack([far * np.sin(angle), points[..., 1], far * np.cos(angle) - bend], axis=-1)


def ball_path(rng: np.random.Generator, touches: int, extent: np.ndarray, ball: float = BALL) -> np.ndarray:
    """Return the centre [T, 3] of a ball that presses, slides and lifts, at random places, depths and speeds."""
    parts = []
    for _ in range(touches):
        x, y = rng.uniform(-1, 1, 2) * extent
        depth, way = rng.uniform(0.8e-3, 2.5e-3), rng.uniform(-3e-3, 3e-3, 2)
        fall, slide, rest = rng.integers(4, 16), rng.integers(10, 24), 6
        gap = 1.5e-3 + RADIUS + ball
        down = np.linspace(0, 1, fall) ** 1.3
        slid = np.clip(np.arange(fall + slide + rest) - fall, 0, slide) / slide
        lower = np.r_[down, np.ones(slide + rest)]
        high = gap - lower * (1.5e-3 + depth)
        press = np.c_[x + slid * way[0], y + slid * way[1], high]
        lift = np.c_[np.repeat(press[-1:, :2], 5, 0), np.linspace(press[-1, 2], gap, 7)[1:-1]]
        parts.append(np.concatenate([np.repeat(np.add(press[:1], [[0, 0, 5e-3]]), 6, 0), press, lift]))
    return np.concatenate(parts)


def plant(
    seed: int,
    fault: str = "",
    *,
    shape: tuple[int, int] = (3, 3),
    touches: int = 24,
    axes: int = 3,
    ball: float = BALL,
    bend: float = np.inf,
) -> Planted:
    """Return a random device with the log of its presses; ``fault`` is planted. ``bend`` (m) is the radius of a pad
    that is a part of a cylinder."""
    rng = np.random.default_rng(seed)
    half = PITCH * (np.array(shape[::-1]) - 1) / 2
    nominal = Probes.grid(*shape, size=tuple(2 * half[::-1]), radius=RADIUS)
    if np.isfinite(bend):
        foot = nominal.position
        normal = bent(foot + np.array([0, 0, 1]), bend) - bent(foot, bend)
        nominal = Probes(bent(foot, bend), normal, nominal.radius, shape)
    count, bad = len(nominal), int(rng.integers(len(nominal)))
    shared = {
        "stiffness": np.log(rng.uniform(200, 2000)), "exponent": rng.uniform(1.0, 1.6),
        "damping": rng.uniform(0.5, 3.0), "friction": rng.uniform(0.2, 0.8), "grip": rng.uniform(0.4, 0.9),
        "crosstalk": rng.uniform(0.05, 0.3) * (len(nominal) > 1), "hysteresis": rng.uniform(0.1, 0.5),
        "hysteresis_tau": np.log(rng.uniform(0.03, 0.2)), "read_delay": 0.0,
    }  # fmt: skip
    place = nominal.position + rng.normal(0, 1.5e-4, (count, 3))
    turn = rng.normal(0, np.radians(2.0), (count, 3))
    gain = rng.normal(0, 0.05, count)
    if fault == "shifted":
        way = rng.normal(size=2)
        place[bad, :2] += rng.uniform(1.8e-3, 3e-3) * way / np.linalg.norm(way)
    elif fault == "gain":
        gain[bad] += rng.choice([-1, 1]) * np.log(rng.uniform(1.7, 2.5))
    elif fault == "friction":
        shared["friction"] = 0.0
    elif fault == "delay":
        shared["read_delay"] = DT * int(rng.integers(2, 6))
    shared["stiffness"] += gain.mean()
    gain -= gain.mean()
    path = ball_path(rng, touches, half + 1e-3, ball)
    path = bent(path, bend) if np.isfinite(bend) else path
    device = Device(
        shared, place, np.tile(np.eye(3), (count, 1, 1)), Rotation.from_rotvec(turn), gain, np.zeros((count, axes))
    )
    log = Log(np.arange(len(path)) * DT, np.zeros((len(path), count * axes)), ball=path)
    presses = Presses(log, nominal, ball)
    force = respond(presses, device) * np.exp(shared["stiffness"] + gain)[:, None]
    # Crosstalk has no memory: all readings are mixed as environments of one update.
    mixed = simulate(Noise(crosstalk=shared["crosstalk"]), force[None], dt=DT, layout=shape)[0]
    read = np.einsum("nji,tnj->tni", device.turn.as_matrix(), mixed)
    if axes == 1:
        read = -np.einsum("tnj,nj->tn", mixed, device.turn.apply(np.array(nominal.normal)))[..., None]
    if fault == "axes":
        order = [[1, 0, 2], [2, 1, 0], [0, 2, 1], [1, 2, 0]][int(rng.integers(4))]
        read[:, bad] = read[:, bad][:, order]
    size = float(np.abs(read).max())
    lasting = {name: shared[name] for name in ("hysteresis", "read_delay")}
    lasting["hysteresis_tau"] = float(np.exp(shared["hysteresis_tau"]))
    noise = Noise(white=rng.uniform(0.002, 0.01) * size, bias=0.02 * size, **lasting)
    readings = simulate(noise, read[:, None], dt=DT, seed=seed)[:, 0].astype(float)
    log = Log(log.time, readings.reshape(len(path), -1), ball=path)
    return Planted(device, Presses(log, nominal, ball), noise)


def outcomes(planted: Planted, fit: DeviceFit) -> dict[str, list[bool]]:
    """Return by number whether its interval holds the planted value."""
    truth = {name: planted.device.shared[name] for name in SHARED}
    stiffness = np.exp(truth["stiffness"])
    truth |= {"stiffness": stiffness, "damping": stiffness * truth["damping"], "white": planted.noise.white,
              "hysteresis_tau": np.exp(truth["hysteresis_tau"]), "bias": planted.noise.bias}  # fmt: skip
    hits = {name: [fit.estimates[name].low <= value <= fit.estimates[name].high] for name, value in truth.items()}
    del hits["read_delay"]
    for n, row in enumerate(fit.taxels):
        hits.setdefault("place", []).extend(np.abs(row["place"] - planted.device.place[n]) <= row["place_error"])
        off = abs(np.log(row["gain"]) - planted.device.gain[n])
        hits.setdefault("gain", []).append(bool(off <= row["gain_error"]))
    return hits


def false_faults(planted: Planted, fit: DeviceFit) -> list[str]:
    """Return the faults that a device is accused of, whose planted number lies within its tolerance."""
    device = planted.device
    shift = np.linalg.norm(device.place - planted.presses.probes.position, axis=1)
    true = {"shifted": (shift, "place"), "turned": (device.turn.magnitude(), "turn"),
            "gain": (np.abs(device.gain), "gain")}  # fmt: skip
    return [
        fault.text
        for fault in fit.faults
        if not fault.taxel or fault.kind not in true
        or true[fault.kind][0][int(fault.taxel)] <= TOLERANCES[true[fault.kind][1]]
    ]  # fmt: skip


def tilts(planted: Planted, fit: DeviceFit) -> np.ndarray:
    """Return the angles [N] of fitted normals from the planted ones (degrees)."""
    true = planted.device.turn.apply(np.array(planted.presses.probes.normal))
    return np.degrees(np.arccos(np.clip((true * fit.probes.normal).sum(axis=1), -1, 1)))
