"""A box that is struck, with a microphone."""

from __future__ import annotations

import numpy as np

from robotics_bridge.physics.scene import Geometry, TouchScene
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.audio.sensors import ContactAudio, Modes
from robotics_bridge.sensors.suite import SensorSuite
from tests.factories.touch_scenes import pad_scene

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
