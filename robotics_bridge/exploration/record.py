"""Touch of a hand that explores objects: [K, T, 35, 6] and, as input of encoders, [K, T, 30, 5, 7].

Objects follow their movement exactly, as if held by a strong robot, with true velocities; the hand's own servos give
way. Letters: K condition (object and procedure), T frame of 9 ms, S sub-step of a time step.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, SUB_STEP_SECONDS, SUB_STEPS, check_stimulus_set
from brainbench.core.errors import DataError, UsageError, check_each, check_number, check_once, listing
from brainbench.core.files import content_hash, to_json
from brainbench.core.limits import Limit, limited
from brainbench.core.progress import Progress, track
from brainbench.core.rotations import from_matrices, from_rpy, to_matrices
from brainbench.core.version import __version__
from robotics_bridge import hands
from robotics_bridge.hands.observations import observe, sensors_for
from robotics_bridge.hands.scenes import OBJECT, flexed, holding_spec, replace_drives
from robotics_bridge.physics import Geometry, MujocoEngine
from robotics_bridge.physics.scene import compile_variants
from robotics_bridge.policies.encoders.taxel_grid import FINGERS, SITES, HandCalibration, TaxelGrid
from robotics_bridge.sensors import SensorSuite


@dataclass(frozen=True)
class Pose:
    """A place of the object, and how far the fingers are closed."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    """Above the palm; negative presses."""
    yaw: float = 0.0
    """Turn about the vertical."""
    closing: float = 0.3
    """Share of their range to which the fingers are flexed."""


_ABOVE, _PRESSED, _LIGHT = 0.008, -0.002, -0.001
STEP = 1e-3  # seconds past the end of a procedure at which its pose is known, for forward differences there


def _ramp(time: float, start: float, end: float) -> float:
    check_number("time in an exploratory procedure (s)", time, least=0, most=1 + STEP)
    # 3 s² − 2 s³: starts and ends at rest, so that prescribed objects do not jerk.
    share = min(max((time - start) / (end - start), 0.0), 1.0)
    return share * share * (3 - 2 * share)


def _lateral(time: float) -> Pose:
    """Rub to and fro across the fingers, pressed: texture."""
    z = _ABOVE + (_PRESSED - _ABOVE) * _ramp(time, 0.0, 0.25)
    return Pose(y=0.012 * math.sin(4 * math.pi * max(time - 0.25, 0.0)), z=z)


def _static(time: float) -> Pose:
    """Press and hold: hardness."""
    return Pose(z=_ABOVE + (1.5 * _PRESSED - _ABOVE) * _ramp(time, 0.0, 0.5))


def _enclosure(time: float) -> Pose:
    """Close the fingers around it: global shape."""
    z = _ABOVE + (_LIGHT - _ABOVE) * _ramp(time, 0.0, 0.2)
    return Pose(z=z, closing=0.15 + 0.55 * _ramp(time, 0.2, 0.85))


def _contour(time: float) -> Pose:
    """Turn its outline along the fingers: exact shape."""
    z = _ABOVE + (_LIGHT - _ABOVE) * _ramp(time, 0.0, 0.2)
    # The object turns about itself while its middle goes once around a circle: the outline passes along the fingers.
    turn = 2 * math.pi * _ramp(time, 0.2, 1.0)
    return Pose(x=0.008 * math.sin(turn), y=0.008 * (1 - math.cos(turn)), z=z, yaw=turn, closing=0.45)


PROCEDURES: Mapping[str, Callable[[float], Pose]] = {
    "lateral_motion": _lateral,
    "static_pressure": _static,
    "enclosure": _enclosure,
    "contour_following": _contour,
}
"""Name → movement over one second: time from 0 to 1 s → pose; UsageError for another time."""

_STEPS = 2  # physics steps per frame
TWIST = 1.6e-5
"""Torsional friction of a taxel (N·m·s): that of a patch of 4 mm with the published k_t, stated since data depend on
it."""
_DENSE = 2e5  # density of explored objects (kg/m³): contacts must not move what is held


@limited(of="{} of an explored object", unresolved=("geometry",), eq=False)
class Explored:
    """An object to explore."""

    label: str
    geometry: Geometry
    """Its shape; link and pose do not matter. A mesh collides as its convex hull; taxels feel the surface itself."""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation in which it is held (w, x, y, z)."""
    retreat: Annotated[float, Limit(least=-1, most=1, unit="m")] = 0.0
    """Held so much further away than the procedure says (m)."""

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.quaternion))
        check_number(f"length of the quaternion of {self.label!r}", length, above=1e-6)
        extent = float(np.max(self.geometry.reach(np.concatenate([np.eye(3), -np.eye(3)]))))
        check_number(f"extent of {self.label!r} from its origin (m)", extent, most=1)


@dataclass(frozen=True, eq=False)
class HandRecording:
    """Touch of a hand, by condition."""

    hand: str
    labels: tuple[str, ...]
    """One per condition: object, or object/procedure where there are several procedures."""
    objects: tuple[str, ...]
    """Object of each condition."""
    procedures: tuple[str, ...]
    """Procedure of each condition."""
    times: NDArray[np.float64]
    """[T] (s)."""
    wrench: NDArray[np.float32]
    """[K, T, 35, 6] of every site about its centre (N, N·m; palm's axes; action of the object on the skin)."""
    config: Mapping[str, Any]
    """Options of the recording."""

    def grid(self) -> torch.Tensor:
        """Return the wrenches as [K, T/S, S·6, 5, 7], in the hand's own units."""
        count, frames = self.wrench.shape[:2]
        if frames % SUB_STEPS:
            raise UsageError(f"{frames} frames do not divide into time steps of {SUB_STEPS} sub-steps.")
        return torch.from_numpy(self.wrench).transpose(2, 3).reshape(count, frames // SUB_STEPS, -1, *GRID_SHAPE)

    def calibration(self) -> HandCalibration:
        """Return the calibration that gives touched sites of this recording the size of a whisker's base."""
        return HandCalibration.fit(self.grid())

    def dataset(self, calibration: HandCalibration | None = None) -> xr.Dataset:
        """Return a stimulus set whose whiskers are the 35 sites, in a network's units by a :meth:`calibration`."""
        used = calibration or self.calibration()
        gains = np.array(used.gains(1), dtype=np.float32)
        rows, cols = np.divmod(np.arange(SITES), GRID_SHAPE[1])
        names = [f"{FINGERS[row]}-{col}" for row, col in zip(rows, cols, strict=True)]
        wrench = self.wrench * gains
        dataset = xr.Dataset(
            {
                "wrench": (("stimulus", "time", "whisker", "channel"), wrench, {"units": "N (F), N m (M)"}),
                "contact": (("stimulus", "time", "whisker"), np.linalg.norm(self.wrench[..., :3], axis=-1) > 1e-4),
            },
            coords={
                "stimulus": np.array(self.labels, dtype=object),
                "time": ("time", self.times, {"units": "s"}),
                "whisker": np.array(names, dtype=object),
                "row": ("whisker", rows),
                "col": ("whisker", cols),
                "side": ("whisker", np.array(["right"] * SITES, dtype=object)),
                "object": ("stimulus", np.array(self.objects, dtype=object)),
                "procedure": ("stimulus", np.array(self.procedures, dtype=object)),
                "channel": np.array(CHANNELS, dtype=object),
            },
            attrs={
                "array": f"hand:{self.hand}",
                "scene": to_json(self.config, indent=None),
                "fidelity": json.dumps({name: self.config[name] for name in ("resolution", "placement")}),
                "seed": int(self.config["seed"]),
                "backend": "mujoco",
                "version": __version__,
                "frame": "palm axes at the reference posture; action of the object on the skin, about a site's centre",
                "hand_calibration": to_json(used, indent=None),
            },
        )
        dataset.attrs["config_hash"] = content_hash(self.config, used)
        dataset.attrs["content_hash"] = content_hash(list(self.labels), self.times, wrench)
        return check_stimulus_set(dataset)


def record_exploration(
    objects: Sequence[Explored],
    procedures: Sequence[str] = tuple(PROCEDURES),
    *,
    hand: str = "xhand1",
    resolution: str = "med",
    placement: str = "hand",
    noisy: bool = False,
    frames: int = 110,
    seed: int = 0,
    progress: Progress | None = None,
) -> HandRecording:
    """Explore every object by every procedure and return what the hand felt.

    Args:
        objects: What to explore; labels differ.
        procedures: Names of :data:`~robotics_bridge.exploration.record.PROCEDURES`.
        hand: Name or file of the hand.
        noisy: With the published imperfections of force taxels, drawn by ``seed``.
        frames: T, of 9 ms; a procedure is stretched over them.
        progress: Called with (frames done, frames, what).
    """
    check_each("exploratory procedure", procedures, PROCEDURES)
    check_once("procedures", procedures)
    labels = [item.label for item in objects]
    check_number("frames", frames, least=1, whole=True)
    if not labels or not procedures or len(set(labels)) < len(labels):
        raise UsageError("Exploration needs objects with different labels, and procedures.")
    conditions = [(item, procedure) for item in objects for procedure in procedures]
    world = _World(hand, [item for item, _ in conditions], SUB_STEP_SECONDS * frames)
    grid = TaxelGrid(world.hand, resolution=resolution, placement=placement)
    sensors = sensors_for("force_torque", grid.layout, noisy=noisy, track=(OBJECT,), twist=TWIST)
    suite = SensorSuite(world.engine.scene, sensors, num_envs=len(conditions), seed=seed)
    felt = []
    for frame in track(range(frames), "exploring", progress):
        for sub_step in range(_STEPS):
            world.move(conditions, (frame * _STEPS + sub_step) / (frames * _STEPS))
            suite.update(world.engine.state, world.engine.timestep)
        readings = {link: suite.read(link).clone() for link in grid.layout}
        taxels = observe("force_torque", readings, grid.layout).view(len(conditions), 1, grid.items, 6)
        felt.append(grid(taxels).flatten(2).transpose(1, 2).numpy())
    labels = [f"{item.label}/{name}" if len(procedures) > 1 else item.label for item, name in conditions]
    # What is no number stays so from step to step.
    if bad := [label for label, flaw in zip(labels, suite.diverged.tolist(), strict=True) if flaw]:
        raise DataError(f"The simulation of the hand became unstable while it explored {listing(bad)}.")
    config = {
        "hand": hand, "resolution": resolution, "placement": placement, "noisy": noisy, "twist": TWIST,
        "frames": frames, "seed": seed,
        "procedures": list(procedures),
        "objects": [
            {
                "label": target.label, "quaternion": target.quaternion, "retreat": target.retreat,
                "mesh": None if (mesh := target.geometry.mesh) is None else content_hash(mesh.vertices, mesh.faces),
                "geometry": [target.geometry.kind, *target.geometry.size] if mesh is None else None,
            }
            for target in objects
        ],
    }  # fmt: skip
    return HandRecording(
        world.hand.name,
        tuple(labels), tuple(item.label for item, _ in conditions), tuple(name for _, name in conditions),
        np.linspace(SUB_STEP_SECONDS, SUB_STEP_SECONDS * frames, frames), np.stack(felt, axis=1), config,
    )  # fmt: skip


class _World:
    """One environment per condition: the hand palm up, the object where its procedure puts it."""

    def __init__(self, hand: str, objects: Sequence[Explored], span: float) -> None:
        self.hand, self.span = hands.load(hand), span
        spec = holding_spec(self.hand, timestep=SUB_STEP_SECONDS / _STEPS)
        servos = {drive.name for drive in spec.actuators if drive.biasprm[1] < 0}
        # A file may drive its joints by motors, by tendons, or some of them alone.
        if not {*self.hand.joints} <= servos:
            replace_drives(spec)
        kinds = list(dict.fromkeys(objects))
        models = compile_variants(spec, OBJECT, [item.geometry for item in kinds], density=_DENSE)
        self.engine = MujocoEngine(
            models, len(objects), assignment=tuple(kinds.index(item) for item in objects), contacts=128
        )
        model = self.engine.model
        joint = model.body(OBJECT).jntadr[0]
        self._at, self._speed = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._place = model.body(OBJECT).pos.copy()
        self._drives = [model.actuator(name).id for name in self.hand.joints]
        # Jaws are not at zero when they are open.
        self._open, self._closed = (flexed(self.hand, share)[self.hand.joint_numbers] for share in (0.0, 1.0))
        # How far the lowest point of a held object lies below its body's origin (m), by the support function downwards:
        # row 2 of the rotation is the vertical in the object's frame.
        self._bottoms = {id(item): float(item.geometry.reach(-to_matrices(item.quaternion)[2])) for item in kinds}

    def move(self, conditions: Sequence[tuple[Explored, str]], time: float) -> None:
        """Put every object where it is at a time (0 to 1 of its procedure), and step the hand once."""
        for data, (explored, procedure) in zip(self.engine.data, conditions, strict=True):
            pose, after = PROCEDURES[procedure](time), PROCEDURES[procedure](time + STEP)
            data.qpos[self._at : self._at + 7] = self._held(pose, explored)
            # Velocity by a forward difference over 1 ‰ of the procedure: friction needs the speed of an object that is
            # put in place.
            names, span = ("x", "y", "z", "yaw"), STEP * self.span
            *rates, spin = [(getattr(after, name) - getattr(pose, name)) / span for name in names]
            data.qvel[self._speed : self._speed + 3] = rates
            # MuJoCo wants the angular velocity in the body's own axes.
            upright = to_matrices(data.qpos[self._at + 3 : self._at + 7])[2]
            data.qvel[self._speed + 3 : self._speed + 6] = spin * upright
            data.ctrl[self._drives] = self._open + pose.closing * (self._closed - self._open)
        self.engine.step()

    def _held(self, pose: Pose, explored: Explored) -> NDArray[np.float64]:
        height = pose.z + explored.retreat + self._bottoms[id(explored)]
        # Yaw about the world's vertical, applied after the orientation in which the object is held.
        turned = from_matrices(to_matrices(from_rpy((0.0, 0.0, pose.yaw))) @ to_matrices(explored.quaternion))
        return np.concatenate([[self._place[0] + pose.x, self._place[1] + pose.y, height], turned])
