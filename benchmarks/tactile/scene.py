"""What the tactile benchmarks measure: the published pyramid, its sensors, and states of it.

One sensor of 10 × 10 taxels on the top of ``box0``, which ``box1`` half covers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from brainbench.core.devices import mujoco_module
from brainbench.geometry import Mesh
from robotics_bridge import hands
from robotics_bridge.hands.scenes import closing, holding
from robotics_bridge.physics import (
    Geometry,
    HandState,
    MujocoEngine,
    MujocoWarpEngine,
    TouchScene,
)
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

mujoco = mujoco_module()

EDGE = 0.25
"""Edge of a box (m)."""
SPACING = 0.999
"""Distance of neighbouring boxes in edges."""
ROWS = 4
"""Boxes in the lowest row."""


def pyramid() -> Any:
    """Return the ``mujoco.MjModel`` of the pyramid: links ``box0`` … ``box9``, time step 0.01 s.

    Numbers run up each leaning column, so that ``box1`` rests on ``box0`` (and on its neighbour), as published.
    The boxes start one thousandth of an edge into one another, so that the published warm-up settles them.
    """
    half, pitch = EDGE / 2, EDGE * SPACING
    boxes = []
    for column in range(ROWS):
        for level in range(ROWS - column):
            x, z = (column + level / 2) * pitch, half + level * pitch
            boxes.append(
                f'<body name="box{len(boxes)}" pos="{x} 0 {z}"><freejoint/>'
                f'<geom name="box{len(boxes)}" type="box" size="{half} {half} {half}" density="1000"/></body>'
            )
    return mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.01" tolerance="1e-5"/><worldbody>'
        f'<geom name="floor" type="plane" size="0 0 1"/>{"".join(boxes)}</worldbody></mujoco>'
    )


def initial_velocities(num_envs: int, dofs: int, seed: int = 0) -> np.ndarray:
    """Return the published random start velocities [B, nv]: 0.04 times uniform numbers in [0, 1)."""
    return 0.04 * np.random.default_rng(seed).random((num_envs, dofs))


FULL = Noise.preset("published-force")
CLASSES = ("kinematic", "depth", "contact", "distance", "proximity", "elastomer", "temperature", "audio")
CELLS = {"temperature": 8, "audio": 160}
"""Numbers of a reading of the sensors that are no taxels."""
CONTACT = ("geom", "distance", "position", "normal", "force", "friction")
State = Mapping[str, np.ndarray]


def grid(count: int, radius: float = 0.004) -> Probes:
    """About ``count`` taxels over the top face of a box."""
    side = round(count**0.5)
    return Probes.grid(side, max(1, round(count / side)), size=(0.2, 0.2), center=(0, 0, 0.125), radius=radius)


def sensors(name: str, count: int = 100, points: int = 500, noise: Noise | None = None) -> dict[str, Any]:
    """The published sensor of a class on ``box0``, tracking ``box1``."""
    common: dict[str, Any] = {"link": "box0", "probes": grid(count), "track": ("box1",)}
    if noise is not None:
        common["noise"] = noise
    makers = {
        "distance": lambda: SurfaceDistanceProbe(**common),
        "contact": lambda: ContactProbe(**common),
        "depth": lambda: ContactDepthProbe(**common),
        "kinematic": lambda: KinematicTaxel(**common, total="law"),
        "proximity": lambda: ProximityTaxel(**common, points=points),
        "elastomer": lambda: ElastomerTaxel(**common, points=points),
        "temperature": lambda: TemperatureGrid(link="box0", cells=(2, 2, 2)),
        "audio": _audio,
    }
    return {name: makers[name]()}


def _audio() -> ContactAudio:
    modes = Modes(tuple(200.0 * k for k in range(1, 17)), (40.0,) * 16, (1.0,) * 16)
    return ContactAudio(link="box0", modes=modes, samples=160)


def engine_of(envs: int, device: str) -> Any:
    """The engine of a device with the pyramid in its published start."""
    model = pyramid()
    if device == "cpu":
        engine = MujocoEngine(model, envs, contacts=128)
    else:
        engine = MujocoWarpEngine(model, envs, device=device, contacts=128)
    engine.set(qvel=initial_velocities(envs, model.nv))
    return engine


def snapshot(state: HandState) -> dict[str, np.ndarray]:
    """Copy a state to the host; contacts sorted by environment."""
    count = min(int(state.contact_count.numpy()[0]), state.contact_env.shape[0])
    env = state.contact_env.numpy()[:count]
    order = np.argsort(env, kind="stable")
    kept = {name: getattr(state, f"contact_{name}").numpy()[:count][order] for name in CONTACT}
    return {
        "pose": state.pose_torch[..., [0, 1, 2, 6, 3, 4, 5]].cpu().numpy(),
        "velocity": state.velocity.numpy(),
        "env": env[order],
        **kept,
    }


def restore(found: State, envs: int, device: str, target: HandState | None = None) -> HandState:
    """A state of ``envs`` environments on a device that repeats those of a snapshot."""
    small, links = found["pose"].shape[:2]
    order = np.arange(envs) % small
    start = np.searchsorted(found["env"], np.arange(small + 1))
    rows = [np.arange(start[s], start[s + 1]) for s in range(small)]
    chosen = np.concatenate([rows[e] for e in order]).astype(int)
    owner = np.repeat(np.arange(envs), [len(rows[e]) for e in order])
    if target is None:
        target = HandState.empty(envs, links, (len(found["env"]) // small + 16) * envs, device)
    target.set_pose(found["pose"][order])
    target.set_velocity(found["velocity"][order])
    rest = {name: found[name][chosen] for name in CONTACT if name != "geom"}
    target.set_contacts(owner, found["geom"][chosen], **rest)
    return target


def settled(envs: int, device: str, steps: int) -> dict[str, np.ndarray]:
    """A snapshot of the settled pyramid."""
    engine = engine_of(envs, device)
    engine.step(steps)
    return snapshot(engine.state)


def totals_cases(steps: int) -> dict[str, tuple[TouchScene, State, dict[str, Any]]]:
    """Scene, settled state and taxels of bodies on a pad, a hand that holds a ball, and the pyramid, by name."""
    cases = {}
    ball, block = 'type="sphere" size=".01" mass=".2"', 'type="box" size=".03 .03 .03" mass=".5"'
    for name, geom, side, width in (("ball", ball, 10, 0.03), ("ball", ball, 32, 0.1), ("block", block, 32, 0.1)):
        model = mujoco.MjModel.from_xml_string(
            '<mujoco><worldbody><body name="pad"><geom type="box" size=".05 .05 .01"/></body><body pos="0 0 '
            f'{0.0405 if name == "block" else 0.0205}"><freejoint/><geom {geom}/></body></worldbody></mujoco>'
        )
        engine = MujocoEngine(model, 1, contacts=16)
        engine.step(500)
        pad = Probes.grid(side, side, size=(width, width), center=(0, 0, 0.01), radius=0.004)
        taxels = {"pad": KinematicTaxel(link="pad", probes=pad)}
        cases[f"{name} on a pad of {side**2:,} taxels"] = engine.scene, snapshot(engine.state), taxels
    hand = hands.load("xhand1")
    engine, closed = MujocoEngine(holding(hand, radius=0.028, reach=0.9), 1, contacts=64), closing(hand, 0.72)
    for step in range(260):
        engine.set(ctrl=closed * min(step / 200, 1.0))
        engine.step()
    taxels = {link: KinematicTaxel(link=link, probes=probes) for link, probes in hand.layout("med", "hand").items()}
    cases["XHand1 holds a ball, 199 taxels"] = engine.scene, snapshot(engine.state), taxels
    for count in (100, 1000):
        taxels = {"box0": KinematicTaxel(link="box0", probes=grid(count), track=("box1",))}
        cases[f"pyramid, {count:,} taxels"] = scene_of(), settled(64, "cpu", steps), taxels
    return cases


def scene_of() -> TouchScene:
    """The pyramid's geometries."""
    return TouchScene.from_mujoco(pyramid())


CHECKED = 8
"""Environments and updates of the comparison of devices."""
RESTARTED = [3, 5]


def checked_sensors() -> dict[str, Any]:
    """Sensors whose readings are compared between devices, clean and noisy."""
    noise = Noise(white=1e-3, walk=1e-3)
    config = {name: made for kind in CLASSES[:6] for name, made in sensors(kind, points=300).items()}
    config |= {f"{name} noisy": replace(made, noise=noise) for name, made in config.items()}
    config["kinematic raycast"] = replace(config["kinematic"], query="raycast")
    config["kinematic engine"] = replace(config["kinematic"], total="engine")
    return config | sensors("temperature") | sensors("audio")


def episode(steps: int = CHECKED) -> list[dict[str, np.ndarray]]:
    """Snapshots of a falling pyramid, from the processor's engine."""
    engine = engine_of(CHECKED, "cpu")
    engine.step(30)
    found = []
    for _ in range(steps):
        engine.step()
        found.append(snapshot(engine.state))
    return found


def replay(states: list[dict[str, np.ndarray]], device: str) -> dict[str, np.ndarray]:
    """Readings [updates, B, ...] of the checked sensors over an episode, with a reset in its middle."""
    config = checked_sensors()
    suite = SensorSuite(scene_of(), config, num_envs=CHECKED, device=device)
    state = restore(states[0], CHECKED, device)
    read: dict[str, list[np.ndarray]] = {name: [] for name in config}
    for number, found in enumerate(states):
        restore(found, CHECKED, device, state)
        suite.update(state)
        if number == len(states) // 2:
            suite.reset(RESTARTED)
        for name, kept in read.items():
            kept.append(suite.read(name).cpu().numpy().copy())
    return {name: np.stack(kept) for name, kept in read.items()}


def bumpy_box(edge: float, triangles: int) -> Mesh:
    """A box whose faces are cut into about as many triangles."""
    side = max(1, round((triangles / 12) ** 0.5))
    points = np.linspace(-0.5, 0.5, side + 1) * edge
    corners, faces = [], []
    u, v = (axis.ravel() for axis in np.meshgrid(points, points, indexing="ij"))
    for axis in range(3):
        for sign in (-1, 1):
            start = len(corners) * (side + 1) ** 2
            sheet = np.zeros(((side + 1) ** 2, 3))
            sheet[:, axis], sheet[:, (axis + 1) % 3], sheet[:, (axis + 2) % 3] = sign * edge / 2, u, v
            corners.append(sheet)
            for i in range(side):
                for j in range(side):
                    a = start + i * (side + 1) + j
                    b, c, d = a + side + 1, a + side + 2, a + 1
                    faces += [(a, b, c), (a, c, d)] if sign > 0 else [(a, c, b), (a, d, c)]
    rounded = np.round(np.concatenate(corners), 9).astype(np.float64)
    merged, index = np.unique(rounded, axis=0, return_inverse=True)
    return Mesh(merged, index.reshape(-1)[np.array(faces)])


def with_mesh(scene: TouchScene, name: str, triangles: int) -> TouchScene:
    """The scene with one box replaced by triangles."""
    (number,) = scene.geometries_of(name)
    old = scene.geometries[number]
    new = Geometry(name=old.name, link=old.link, kind="mesh", mesh=bumpy_box(0.25, triangles))
    return replace(scene, geometries=(*scene.geometries[:number], new, *scene.geometries[number + 1 :]))
