"""Small scenes and states that several tests share, and a box that is struck, with a microphone."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brainbench.core.devices import warp
from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors import ContactAudio, Probes, SensorSuite, TemperatureGrid
from robotics_bridge.sensors.audio.sensors import Modes
from robotics_bridge.sensors.temperature.materials import ThermalMaterial

PYRAMID = """<mujoco><option timestep="0.01" tolerance="1e-5"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
{boxes}</worldbody></mujoco>"""
PAD = Geometry(name="pad", link="hand", kind="box", size=(0.02, 0.02, 0.005))


def pyramid() -> mujoco.MjModel:
    """The published pyramid of ten boxes; numbers run up each leaning column."""
    places = [(column + level / 2, level) for column in range(4) for level in range(4 - column)]
    boxes = [
        f'<body name="box{n}" pos="{0.24975 * x} 0 {0.125 + 0.24975 * z}"><freejoint/>'
        f'<geom name="box{n}" type="box" size=".125 .125 .125" density="1000"/></body>'
        for n, (x, z) in enumerate(places)
    ]
    return mujoco.MjModel.from_xml_string(PYRAMID.format(boxes="".join(boxes)))


def falling(num_envs: int, dofs: int) -> np.ndarray:
    """The published random start velocities [B, nv]."""
    return 0.04 * np.random.default_rng(0).random((num_envs, dofs))


def pad_scene(*objects: Geometry, pad: Geometry = PAD) -> TouchScene:
    """A pad, by default on link ``hand`` (its top at z = 5 mm), and objects on links of their own."""
    return TouchScene(("world", pad.link, *dict.fromkeys(g.link for g in objects)), (pad, *objects))


def random_pose(rng: np.random.Generator, reach: float = 0.05) -> np.ndarray:
    """A pose [7] (x, y, z, qw, qx, qy, qz)."""
    return np.concatenate([rng.uniform(-reach, reach, 3), np.roll(Rotation.random(rng=rng).as_quat(), 1)])


def rotation_of(quaternions: np.ndarray) -> Rotation:
    """The turns of quaternions [..., 4] (w, x, y, z)."""
    return Rotation.from_quat(np.roll(quaternions, -1, axis=-1))


def state_of(
    scene: TouchScene, poses: np.ndarray, velocities: np.ndarray | None = None, *, touch: bool = True
) -> HandState:
    """A state [B, L, 7]; with ``touch``, geometry 0 is in contact with every other one."""
    poses = np.asarray(poses, dtype=float)
    others = range(1, len(scene.geometries))
    state = HandState.empty(len(poses), len(scene.links), max(len(poses) * len(scene.geometries), 1))
    state.set_pose(poses)
    if velocities is not None:
        state.set_velocity(velocities)
    if touch:
        env = np.repeat(np.arange(len(poses)), len(others))
        state.set_contacts(env, [(0, g) for _ in range(len(poses)) for g in others])
    return state


def poses_at(links: int, positions: dict[int, Sequence[float]], envs: int = 1) -> np.ndarray:
    """Poses [B, L, 7] with every link upright at the origin, but for those named."""
    poses = np.zeros((envs, links, 7))
    poses[..., 3] = 1
    for link, position in positions.items():
        poses[:, link, :3] = position
    return poses


def move_all(poses: np.ndarray, velocities: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move whole environments by one rigid motion [7]."""
    turn = rotation_of(motion[3:])
    shape = poses.shape[:-1]
    flat = poses.reshape(-1, 7)
    moved = np.concatenate(
        [turn.apply(flat[:, :3]) + motion[:3], np.roll((turn * rotation_of(flat[:, 3:])).as_quat(), 1, axis=1)], 1
    )
    v = velocities.reshape(-1, 6)
    spun = np.concatenate([turn.apply(v[:, :3]), turn.apply(v[:, 3:])], 1)
    return moved.reshape(*shape, 7), spun.reshape(*shape, 6)


BALL = Geometry(name="ball", link="object", kind="sphere", size=(0.01,))
GRID = Probes.grid(4, 5, size=(0.02, 0.03), center=(0, 0, 0.005), radius=0.003)


def suite_of(sensors: dict, envs: int = 1, scene: TouchScene | None = None, **options: object) -> SensorSuite:
    """Return a suite of sensors, by default on a pad beside a ball."""
    return SensorSuite(scene or pad_scene(BALL), sensors, num_envs=envs, **options)  # type: ignore[arg-type]


def touching(envs: int = 1, height: float = 0.0145) -> np.ndarray:
    """Return poses in which the ball lies on the pad."""
    return poses_at(3, {2: (0.001, -0.002, height)}, envs)


def ball_state(*heights: float) -> HandState:
    """Return a state in which the ball touches the pad, at a height in each environment (m)."""
    return state_of(pad_scene(BALL), np.concatenate([touching(height=height) for height in heights]))


PLAIN = ThermalMaterial(2.0, 1000.0, 1000.0, 0.8)


def make_grid(envs: int = 1, half: tuple[float, float, float] = (0.01, 0.02, 0.03), contacts: int = 0, **knobs):
    """Return a suite with one grid on a box, and a state; links are world, pad and object."""
    ball = Geometry(name="object", link="object", kind="sphere", size=(0.04,))
    scene = pad_scene(ball, pad=Geometry(name="pad", link="pad", kind="box", size=half))
    defaults = {"convection": 0.0, "radiates": False, "material": PLAIN}
    suite = SensorSuite(scene, {"grid": TemperatureGrid(link="pad", **{**defaults, **knobs})}, num_envs=envs)
    return suite, HandState.empty(envs, 3, contacts)


def touch_face(state: HandState, half: float, envs=(0,), depth: float = 0.0, height: float = 0.03) -> None:
    """Four contact points at the corners of a square on the upper face."""
    corners = np.array([[x, y, height] for x in (-half, half) for y in (-half, half)])
    env = np.repeat(envs, 4)
    state.set_contacts(
        env, np.tile([[0, 1]], (len(env), 1)), distance=np.full(len(env), -depth),
        position=np.tile(corners, (len(envs), 1)), normal=np.tile([0.0, 0, 1], (len(env), 1)),
    )  # fmt: skip


def require_processor() -> None:
    """Skip a test that compares with a processor where Warp has no compiler for it."""
    if not warp().is_cpu_available():
        pytest.skip("compares with a processor, for which this build of Warp has no compiler")


MODES = Modes((500.0, 1730.0, 4100.0), (8.0, 15.0, 40.0), (1.0, -0.7, 0.4))
DT, K = 0.005, 160
RATE = K / DT


def box_scene() -> TouchScene:
    """Return a box that a ball may strike."""
    ball = Geometry(name="ball", link="ball", kind="sphere", size=(0.02,))
    return pad_scene(ball, pad=Geometry(name="box", link="box", kind="box", size=(0.1, 0.1, 0.01)))


def make_box(envs: int = 1, **knobs) -> tuple[SensorSuite, HandState]:
    """Return the suite of a microphone on the box, and a state."""
    sensor = ContactAudio(link="box", modes=MODES, samples=K, **knobs)
    return SensorSuite(box_scene(), {"sound": sensor}, num_envs=envs), HandState.empty(envs, 3, 4 * envs)


def touch_box(state: HandState, force, envs=(0,)) -> None:
    """Put one contact of ball and box into some environments."""
    count = len(envs)
    state.set_contacts(
        list(envs), np.tile([[0, 1]], (count, 1)), force=np.full(count, force),
        position=np.zeros((count, 3)), normal=np.tile([0.0, 0, 1], (count, 1)),
    )  # fmt: skip


def strike(suite: SensorSuite, state: HandState, blocks: int, force: float = 10.0, name: str = "sound") -> np.ndarray:
    """Return what is heard in the blocks after a strike."""
    suite.update(state, DT)
    touch_box(state, force)
    heard = []
    for _ in range(blocks):
        suite.update(state, DT)
        heard.append(suite.read_ground_truth(name)[0, 0].numpy().copy())
        state.contact_count.fill_(0)
    return np.concatenate(heard)
