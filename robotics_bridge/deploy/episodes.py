"""Episodes as a LeRobot data set (layout v3.0), written with our own Parquet and JSON; lerobot itself is not needed.

Per frame: ``observation.state`` (joint positions, rad), ``observation.velocity``, ``action`` (joint targets, rad),
``observation.tactile`` [N, 6] (force and torque of each point, link frame, about the link's origin) and
``observation.wrench`` [6] (their sum in the palm's frame, about its origin). Where the points sit, and the unit of the
forces, stands once in ``meta/tactile.json``. Arrays of two axes are nested lists, as LeRobot stores them.
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
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.encoders.finger_axes import FingerAxes, finger_axes_of

VERSION = "v3.0"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_COUNTERS = ("frame_index", "episode_index", "index", "task_index")


@dataclass(frozen=True, eq=False)
class TactilePoints:
    """Places of the points of ``observation.tactile``. Letters: N point, L link."""

    links: tuple[str, ...]
    """L."""
    link: NDArray[np.int64]
    """[N] number of each point's link."""
    position: NDArray[np.float64]
    """[N, 3] in the link's frame (m)."""
    normal: NDArray[np.float64]
    """[N, 3] outward, link frame."""


@dataclass(frozen=True, eq=False)
class Episode:
    """Frames of one episode; every array has a row per frame T."""

    task: str
    """Task that was done, in words."""
    state: NDArray[np.floating]
    """[T, J] joint positions (rad)."""
    velocity: NDArray[np.floating]
    """[T, J] (rad/s)."""
    action: NDArray[np.floating]
    """[T, J] joint targets (rad)."""
    tactile: NDArray[np.floating]
    """[T, N, 6]."""
    wrench: NDArray[np.floating]
    """[T, 6]."""


def total_wrench(
    points: NDArray[np.floating], links: Sequence[str], link: NDArray[np.int64], axes: FingerAxes
) -> NDArray:
    """Return the sum [6] of points' wrenches [N, 6] in the palm's frame, about its origin, fingers at reference."""
    total = np.zeros(6)
    for number, name in enumerate(links):
        force, torque = np.split(points[link == number].sum(axis=0), 2)
        turn, origin = axes.place[name]
        # Wrenches moved to the palm's origin: F = R f, M = R m + x₀ × F, with the fingers at their reference position.
        total[:3] += turn @ force
        total[3:] += turn @ torque + np.cross(origin, turn @ force)
    return total


class SessionRecorder:
    """Keeps a session of a deployed policy; touch is one point per finger tip, where the hand senses it.

    Forces stay in the unit in which the hand reports pressure.

    Args:
        contract: Of the policy.
    """

    def __init__(self, contract: PolicyContract) -> None:
        self.hand, self.contract = hands.load(contract.hand), contract
        layout = self.hand.layout("med", "tips")
        self.axes = finger_axes_of(self.hand, self.hand.layout("med", "hand"))
        fingers = tuple(self.hand.fingers)
        tips = {chain[-1]: finger for finger, chain in self.hand.fingers.items()}
        self.rows = [fingers.index(tips[link]) for link in layout]
        position, normal = (
            np.stack([getattr(probes, name)[probes.active].mean(axis=0) for probes in layout.values()])
            for name in ("position", "normal")
        )
        self.points = TactilePoints(tuple(layout), np.arange(len(layout)), position, normal)
        self.frames: list[tuple[NDArray[np.floating], ...]] = []
        """State, velocity, action, tactile and wrench of each tick."""

    def __call__(self, reading: HandReading, obs: Any, action: Any, targets: NDArray[np.floating]) -> None:
        """Keep a tick, as a :class:`~robotics_bridge.deploy.controller.Controller` reports it."""
        del obs, action
        # The maker's pressure is about outward normals with axes z, y, x; a force on the skin points inward.
        force = -reading.pressure[self.rows][:, ::-1]
        torque = np.cross(self.points.position, force).astype(float)
        points = np.concatenate([force, torque], axis=1)
        wrench = total_wrench(points, self.points.links, self.points.link, self.axes)
        self.frames.append((reading.position, reading.velocity, targets, points, wrench))

    def write(self, folder: Path, joints: tuple[str, ...]) -> Path:
        """Write the session as a data set; see :func:`write_lerobot`."""
        task = self.contract.more.get("task", "deployed policy")
        episode = Episode(task, *(np.array([frame[part] for frame in self.frames]) for part in range(5)))
        about = {"robot": self.hand.name, "unit": "unit of the hand's pressure"}
        return write_lerobot(folder, [episode], fps=self.contract.rate, joints=joints, points=self.points, **about)


def check_folder(folder: Path, fps: float) -> None:
    """Check that a data set can be written, before it is recorded.

    Raises:
        UsageError: the folder is not empty or no folder, or LeRobot knows no such rate.
        MissingDependencyError: pyarrow is not installed.
    """
    if find_spec("pyarrow") is None:
        raise missing_dependency("pyarrow", extra="board", purpose="Writing a LeRobot data set")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{str(folder)!r} is not empty; a data set is written into a folder of its own.")
    if not fps > 0 or fps != round(fps):
        raise UsageError(f"A data set has a whole number of frames per second; received {fps!r}.")


def write_lerobot(
    folder: str | Path,
    episodes: Sequence[Episode],
    *,
    fps: float,
    joints: Sequence[str],
    points: TactilePoints,
    robot: str = "xhand1",
    unit: str = "N",
) -> Path:
    """Write episodes as a data set that LeRobot opens.

    Args:
        folder: Where to; must not exist or be empty.
        episodes: At least one frame each.
        fps: Frames per second; a whole number, as LeRobot demands.
        joints: Names of the joints J.
        points: Where the tactile points sit.
        robot: Name of the robot.
        unit: Of forces; torques are in that times metres.

    Raises:
        UsageError: the folder is not empty, or an episode does not fit.
        MissingDependencyError: pyarrow is not installed.
    """
    folder = Path(folder)
    check_folder(folder, fps)
    import pandas

    if not episodes:
        raise UsageError("A data set needs episodes; received none.")
    shapes = {
        "observation.state": (len(joints),), "observation.velocity": (len(joints),), "action": (len(joints),),
        "observation.tactile": (len(points.link), 6), "observation.wrench": (6,),
    }  # fmt: skip
    tasks = list(dict.fromkeys(episode.task for episode in episodes))
    tables, rows, first = [], [], 0
    for number, episode in enumerate(episodes):
        table = _frames(episode, number, first, tasks.index(episode.task), fps, shapes)
        length = len(episode.state)
        rows.append(_row(number, episode.task, first, length, table))
        tables.append(table)
        first += length
    _write_frames(folder / _DATA.format(chunk_index=0, file_index=0), tables, shapes)
    # LeRobot reads the tasks as the index of a table.
    described = {
        "episodes/chunk-000/file-000": pandas.DataFrame(rows),
        "tasks": pandas.DataFrame({"task_index": range(len(tasks))}, index=pandas.Index(tasks, name="task")),
    }
    for file, frame in described.items():
        with atomic_path(folder / "meta" / f"{file}.parquet") as temporary:
            frame.to_parquet(temporary)
    whole = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    write_json(folder / "meta" / "stats.json", {name: _stats(value) for name, value in whole.items()})
    names = {"observation.tactile": ["point", "channel"], "observation.wrench": ["Fx", "Fy", "Fz", "Mx", "My", "Mz"]}
    features = {
        name: {"dtype": "float32", "shape": list(shape), "names": names.get(name, list(joints))}
        for name, shape in shapes.items()
    }
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in _COUNTERS}
    write_json(
        folder / "meta" / "tactile.json",
        {
            "frame": "link axes; torques about the link's origin", "units": [unit, f"{unit}·m"], "links": points.links,
            "link": points.link, "position": points.position, "normal": points.normal,
        },
    )  # fmt: skip
    # Last, so that a folder with it is complete.
    write_json(
        folder / "meta" / "info.json",
        {
            "codebase_version": VERSION, "robot_type": robot, "total_episodes": len(episodes), "total_frames": first,
            "total_tasks": len(tasks), "chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
            "fps": round(fps), "splits": {"train": f"0:{len(episodes)}"}, "data_path": _DATA, "video_path": None,
            "features": features,
        },
    )  # fmt: skip
    return folder


def _frames(
    episode: Episode, number: int, first: int, task: int, fps: float, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray]:
    length = len(episode.state)
    parts = (episode.state, episode.velocity, episode.action, episode.tactile, episode.wrench)
    found: dict[str, NDArray] = {}
    for (name, shape), part in zip(shapes.items(), parts, strict=True):
        values = np.asarray(part, dtype=np.float32)
        if not length or values.shape != (length, *shape):
            raise UsageError(f"{name} of episode {number} has the shape {values.shape}; expected {(length, *shape)}.")
        if not np.isfinite(values).all():
            raise DataError(f"{name} of episode {number} holds values that are no numbers.")
        found[name] = values
    found["timestamp"] = (np.arange(length) / fps).astype(np.float32)
    frame = np.arange(length)
    counters = (frame, np.full(length, number), first + frame, np.full(length, task))
    return found | dict(zip(_COUNTERS, counters, strict=True))


def _stats(values: NDArray) -> dict[str, list[Any]]:
    flat = values.astype(np.float64)
    found = {name: np.atleast_1d(getattr(np, name)(flat, axis=0)).tolist() for name in ("min", "max", "mean", "std")}
    return {**found, "count": [len(values)]}


def _row(number: int, task: str, first: int, length: int, table: Mapping[str, NDArray]) -> dict[str, Any]:
    row: dict[str, Any] = {
        "episode_index": number, "tasks": [task], "length": length, "dataset_from_index": first,
        "dataset_to_index": first + length, "data/chunk_index": 0, "data/file_index": 0,
        "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0,
    }  # fmt: skip
    for name, values in table.items():
        row |= {f"stats/{name}/{key}": value for key, value in _stats(values).items()}
    return row


def _write_frames(path: Path, tables: list[dict[str, NDArray]], shapes: Mapping[str, tuple[int, ...]]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    def kind(name: str) -> Any:
        if name not in shapes:
            return pa.float32() if name == "timestamp" else pa.int64()
        inner = pa.float32()
        for size in reversed(shapes[name]):
            inner = pa.list_(inner, size) if len(shapes[name]) == 1 else pa.list_(inner)
        return inner

    schema = pa.schema([(name, kind(name)) for name in tables[0]])
    with atomic_path(path) as temporary, parquet.ParquetWriter(temporary, schema, compression="snappy") as writer:
        for table in tables:  # a row group per episode, so that one can be read alone
            columns = [pa.array(values.tolist(), type=schema.field(name).type) for name, values in table.items()]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))
