"""A session as a LeRobot data set (layout v3.0), written with our own Parquet and JSON; lerobot itself is not needed.

Per frame: ``observation.state`` (joint positions, rad), ``observation.velocity``, ``action`` (joint targets, rad),
``observation.tactile`` [N, 6] (force and torque of each point, link frame, about the link's origin) and
``observation.wrench`` [6] (their sum in the palm's frame, about its origin). Where the points sit, and the unit of the
forces, stands once in ``meta/tactile.json``. Arrays of two axes are nested lists, as LeRobot stores them. A session is
one episode. Letters: T frame, J joint, N point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, missing_dependency
from brainbench.core.files import atomic_path, write_json
from robotics_bridge import hands
from robotics_bridge.deploy.driver import HandReading
from robotics_bridge.deploy.session import PressureCalibration
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.encoders.taxel_grid import FingerAxes, finger_axes_of

VERSION = "v3.0"
PARTS = ("observation.state", "observation.velocity", "action", "observation.tactile", "observation.wrench")
"""What is recorded in each frame."""
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"


@dataclass(frozen=True, eq=False)
class TactilePoints:
    """Places of the points of ``observation.tactile``."""

    links: tuple[str, ...]
    """[N] link of each point."""
    position: NDArray[np.float64]
    """[N, 3] in the link's frame (m)."""
    normal: NDArray[np.float64]
    """[N, 3] outward, link frame."""


def total_wrench(points: NDArray[np.floating], links: Sequence[str], axes: FingerAxes) -> NDArray:
    """Return the sum [6] of points' wrenches [N, 6] in the palm's frame, about its origin, fingers at reference."""
    total = np.zeros(6)
    for point, link in zip(points, links, strict=True):
        turn, origin = axes.place[link]
        # Wrenches moved to the palm's origin: F = R f, M = R m + x₀ × F, with the fingers at their reference position.
        force = turn @ point[:3]
        total[:3] += force
        total[3:] += turn @ point[3:] + np.cross(origin, force)
    return total


class SessionRecorder:
    """Records a session of a deployed policy; touch is one point per finger tip, where the hand senses it.

    Forces stay in the unit in which the hand reports pressure. The folder is checked at once, and must be empty.
    """

    def __init__(self, contract: PolicyContract, folder: Path) -> None:
        check_folder(folder, contract.rate)
        self.hand, self.contract, self.folder = hands.load(contract.hand), contract, folder
        self.frames: list[tuple[NDArray[np.floating], ...]] = []
        """:data:`PARTS` of each tick."""

    def begin(self, joints: Sequence[str], fingers: Sequence[str]) -> SessionRecorder:
        """Take in the joints of a hand and the fingers that it senses, in the order of its reports; return itself."""
        finger_of = dict(zip(self.hand.tips, self.hand.fingers, strict=True))
        tips = self.hand.layout("med", "tips")
        layout = {link: probes for link, probes in tips.items() if finger_of[link] in fingers}
        self.joints, self.rows = tuple(joints), [list(fingers).index(finger_of[link]) for link in layout]
        self.axes = finger_axes_of(self.hand, self.hand.layout("med", "hand"))
        position, normal = (
            np.array([getattr(probes, name)[probes.active].mean(axis=0) for probes in layout.values()]).reshape(-1, 3)
            for name in ("position", "normal")
        )
        self.points = TactilePoints(tuple(layout), position, normal)
        return self

    def __call__(self, reading: HandReading, obs: Any, action: Any, targets: NDArray[np.floating]) -> None:
        """Keep a tick, as a :class:`~robotics_bridge.deploy.controller.Controller` reports it."""
        del obs, action
        # With the signs of the simulator, pressure is along outward normals with axes z, y, x (4.29); a force on the
        # skin points inward.
        force = -(reading.pressure[self.rows] * PressureCalibration.axes)[:, ::-1]
        torque = np.cross(self.points.position, force).astype(float)
        points = np.concatenate([force, torque], axis=1)
        wrench = total_wrench(points, self.points.links, self.axes)
        self.frames.append((reading.position, reading.velocity, targets, points, wrench))

    def write(self) -> Path | None:
        """Write the session as a data set (:func:`write_lerobot`) and return its folder; None if no tick was kept."""
        if not self.frames:
            return None
        frames = {name: np.array([frame[part] for frame in self.frames]) for part, name in enumerate(PARTS)}
        session = SessionFacts(
            task=self.contract.more.get("task", "deployed policy"), fps=self.contract.rate, joints=self.joints,
            points=self.points, robot=self.hand.name, unit="unit of the hand's pressure",
        )  # fmt: skip
        return write_lerobot(self.folder, frames, session)


@dataclass(frozen=True, kw_only=True, eq=False)
class SessionFacts:
    """What a data set says of a session beside its frames."""

    task: str
    """Task that was done, in words."""
    fps: float
    """Frames per second; a whole number, as LeRobot demands."""
    joints: Sequence[str]
    """Names of the joints J."""
    points: TactilePoints
    """Where the tactile points sit."""
    robot: str
    """Name of the robot."""
    unit: str
    """Unit of forces; torques are in that times metres."""


def check_folder(folder: Path, fps: float) -> None:
    """Check that a data set can be written, before it is recorded."""
    if find_spec("pyarrow") is None:
        raise missing_dependency("pyarrow", extra="board", purpose="Writing a LeRobot data set")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{str(folder)!r} is not empty; a data set is written into a folder of its own.")
    if not fps > 0 or fps != round(fps):
        raise UsageError(f"A data set has a whole number of frames per second; received {fps!r}.")


def write_lerobot(folder: Path, frames: Mapping[str, NDArray[np.floating]], session: SessionFacts) -> Path:
    """Write a session as a data set that LeRobot opens.

    Args:
        folder: Where to; must not exist or be empty.
        frames: :data:`PARTS` by name, [T, J], [T, N, 6] and [T, 6]; at least one frame.
        session: What is said of it.
    """
    task, fps, joints, points = session.task, session.fps, session.joints, session.points
    check_folder(folder, fps)
    import pandas

    sizes: list[tuple[int, ...]] = [*[(len(joints),)] * 3, (len(points.links), 6), (6,)]
    shapes: dict[str, tuple[int, ...]] = dict(zip(PARTS, sizes, strict=True))
    table, length = _columns(frames, fps, shapes), len(frames[PARTS[0]])
    _write_frames(folder / _DATA.format(chunk_index=0, file_index=0), table, shapes)
    stats = {name: _stats(values) for name, values in table.items()}
    episode = {
        "episode_index": 0, "tasks": [task], "length": length, "dataset_from_index": 0, "dataset_to_index": length,
        "data/chunk_index": 0, "data/file_index": 0, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
        **{f"stats/{name}/{key}": value for name, numbers in stats.items() for key, value in numbers.items()},
    }  # fmt: skip
    # LeRobot reads the tasks as the index of a table.
    described = {
        "episodes/chunk-000/file-000": pandas.DataFrame([episode]),
        "tasks": pandas.DataFrame({"task_index": [0]}, index=pandas.Index([task], name="task")),
    }
    for file, rows in described.items():
        with atomic_path(folder / "meta" / f"{file}.parquet") as temporary:
            rows.to_parquet(temporary)
    write_json(folder / "meta" / "stats.json", stats)
    names = {"observation.tactile": ["point", "channel"], "observation.wrench": ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]}
    features: dict[str, Any] = {
        name: {"dtype": "float32", "shape": list(shape), "names": names.get(name, list(joints))}
        for name, shape in shapes.items()
    }
    features |= {
        name: {"dtype": str(values.dtype), "shape": [1], "names": None}
        for name, values in table.items()
        if name not in shapes
    }
    write_json(
        folder / "meta" / "tactile.json",
        {
            "frame": "link axes; torques about the link's origin", "links": points.links,
            "units": [session.unit, f"{session.unit}·m"],
            "link": list(range(len(points.links))), "position": points.position, "normal": points.normal,
        },
    )  # fmt: skip
    # Last, so that a folder with it is complete.
    write_json(
        folder / "meta" / "info.json",
        {
            "codebase_version": VERSION, "robot_type": session.robot, "total_episodes": 1, "total_frames": length,
            "total_tasks": 1, "chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
            "fps": round(fps), "splits": {"train": "0:1"}, "data_path": _DATA, "video_path": None,
            "features": features,
        },
    )  # fmt: skip
    return folder


def _columns(
    frames: Mapping[str, NDArray[np.floating]], fps: float, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray]:
    """Return the checked columns of the table, and those by which LeRobot counts."""
    length, columns = len(frames[PARTS[0]]), dict[str, NDArray]()
    for name, shape in shapes.items():
        try:
            columns[name] = np.asarray(frames[name], dtype=np.float32)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"{name} is not an array of numbers of the shape {(length, *shape)}.") from error
        if not length or columns[name].shape != (length, *shape):
            raise UsageError(f"{name} has the shape {columns[name].shape}; expected {(length, *shape)}.")
        if not np.isfinite(columns[name]).all():
            raise DataError(f"{name} holds values that are no numbers.")
    frame, none = np.arange(length), np.zeros(length, dtype=np.int64)
    counters = {"frame_index": frame, "episode_index": none, "index": frame, "task_index": none}
    return {**columns, "timestamp": (frame / fps).astype(np.float32), **counters}


def _stats(values: NDArray) -> dict[str, list[Any]]:
    flat = values.astype(np.float64)
    stats = {name: np.atleast_1d(getattr(np, name)(flat, axis=0)).tolist() for name in ("min", "max", "mean", "std")}
    return {**stats, "count": [len(values)]}


def _write_frames(path: Path, table: Mapping[str, NDArray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    columns = {}
    for name, values in table.items():
        kind = pa.from_numpy_dtype(values.dtype)
        for size in reversed(shapes.get(name, ())):
            kind = pa.list_(kind, size) if values.ndim == 2 else pa.list_(kind)
        columns[name] = pa.array(values.tolist(), type=kind)
    with atomic_path(path) as temporary:
        parquet.write_table(pa.table(columns), temporary, compression="snappy")
