"""A session as a LeRobot data set, and a log of a real hand's joints and touch, replayed on the simulated hand.

A data set (layout v3.0) is written with our own Parquet and JSON; lerobot itself is not needed. Per frame:
``observation.state`` (joint positions, rad), ``observation.velocity``, ``action`` (joint targets, rad),
``observation.tactile`` [N, 6] (force and torque of each point, link frame, about the link's origin) and
``observation.wrench`` [6] (their sum in the palm's frame, about its origin), and ``observation.time`` (s since the
first frame, by the hand's clock; LeRobot's time stamps count frames). Where the points sit, and the unit of forces, is
said in ``meta/tactile.json``. Arrays of two axes are nested lists, as LeRobot stores them. A session is one episode.

A log is a LeRobot episode (layouts v2 and v3) or a table of comma-separated numbers: ``time`` (s), joints by name (rad)
and taxels as ``LINK:NUMBER`` (N along the inward normal), numbered as the hand's layout has them. Letters: T frame,
J joint, N point or taxel.
"""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import (
    BrainbenchError,
    DataError,
    UsageError,
    brief,
    check_number,
    listing,
    missing_dependency,
    unknown_name,
)
from brainbench.core.files import atomic_path, write_json
from brainbench.core.reading.tables import read_columns
from brainbench.core.reading.texts import read_json
from robotics_bridge import hands
from robotics_bridge.deploy.controller import PressureCalibration
from robotics_bridge.deploy.driver import HandReading
from robotics_bridge.deploy.links.simulated_hand import SimulatedHand
from robotics_bridge.hands import Hand
from robotics_bridge.hands.layouts import Layout
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.encoders.taxel_grid import FingerAxes, finger_axes_of
from robotics_bridge.sensors import KinematicTaxel, Probes, SensorSuite

VERSION = "v3.0"
PARTS = ("observation.state", "observation.velocity", "action", "observation.tactile", "observation.wrench")
"""What is recorded in each frame."""
TIME = "observation.time"
RADIUS = 4e-3  # sensing radius of a point that no layout places (m)
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
    radius: NDArray[np.float64] | float = RADIUS
    """[N] sensing radius (m)."""


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
        """:data:`PARTS` of each tick, and when it was measured by the hand's clock (s)."""

    def begin(self, joints: Sequence[str], fingers: Sequence[str]) -> SessionRecorder:
        """Take in the joints of a hand and the fingers that it senses, in the order of its reports; return itself."""
        finger_of = dict(zip(self.hand.tips, self.hand.fingers, strict=True))
        layout = {link: each for link, each in self.hand.layout("med", "tips").items() if finger_of[link] in fingers}
        self.joints, self.rows = tuple(joints), [list(fingers).index(finger_of[link]) for link in layout]
        self.axes = finger_axes_of(self.hand, self.hand.layout("med", "hand"))
        position, normal = (
            np.array([getattr(probes, name)[probes.active].mean(axis=0) for probes in layout.values()]).reshape(-1, 3)
            for name in ("position", "normal")
        )
        # The mean of the normals of a round tip is shorter than they are.
        self.points = TactilePoints(tuple(layout), position, normal / np.linalg.norm(normal, axis=1, keepdims=True))
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
        self.frames.append((reading.position, reading.velocity, targets, points, wrench, np.array([reading.time])))

    def write(self) -> Path | None:
        """Write the session as a data set (:func:`write_lerobot`) and return its folder; None if no tick was kept."""
        if not self.frames:
            return None
        parts = zip(*self.frames, strict=True)
        frames = {name: np.array(values) for name, values in zip((*PARTS, TIME), parts, strict=True)}
        frames[TIME] -= frames[TIME][0]
        session = SessionFacts(
            task=self.contract.task or "deployed policy", fps=self.contract.rate, joints=self.joints,
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
        frames: :data:`PARTS` by name, [T, J], [T, N, 6] and [T, 6], and if known :data:`TIME` [T, 1]; at least one.
        session: What is said of it.
    """
    task, fps, joints, points = session.task, session.fps, session.joints, session.points
    check_folder(folder, fps)
    import pandas

    sizes: list[tuple[int, ...]] = [*[(len(joints),)] * 3, (len(points.links), 6), (6,)]
    shapes: dict[str, tuple[int, ...]] = dict(zip(PARTS, sizes, strict=True)) | ({TIME: (1,)} if TIME in frames else {})
    table, length = _columns(frames, fps, shapes), len(frames[PARTS[0]])
    _write_frames(folder / _DATA.format(chunk_index=0, file_index=0), table, shapes)
    stats: dict[str, dict[str, list[Any]]] = {}
    for name, values in table.items():
        flat = values.astype(np.float64)
        moments = {part: getattr(np, part)(flat, axis=0) for part in ("min", "max", "mean", "std")}
        stats[name] = {part: np.atleast_1d(value).tolist() for part, value in moments.items()} | {
            "count": [len(values)]
        }
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
    wrench = [f"{part}{axis}" for part in "FM" for axis in "xyz"]
    names = {"observation.tactile": ["point", "channel"], "observation.wrench": wrench, TIME: ["s"]}
    features: dict[str, Any] = {
        name: {"dtype": str(table[name].dtype), "shape": list(shape), "names": names.get(name, list(joints))}
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
            # Single precision would round the clock of an hour to a quarter of a millisecond.
            columns[name] = np.asarray(frames[name], dtype=np.float64 if name == TIME else np.float32)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"{name} is not an array of numbers of the shape {(length, *shape)}.") from error
        if not length or columns[name].shape != (length, *shape):
            raise UsageError(f"{name} has the shape {columns[name].shape}; expected {(length, *shape)}.")
        if not np.isfinite(columns[name]).all():
            raise DataError(f"{name} holds values that are no numbers.")
    frame, none = np.arange(length), np.zeros(length, dtype=np.int64)
    counters = {"frame_index": frame, "episode_index": none, "index": frame, "task_index": none}
    return {**columns, "timestamp": (frame / fps).astype(np.float32), **counters}


def _write_frames(path: Path, table: Mapping[str, NDArray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Write a table with the arrays of each cell as nested lists, of fixed sizes where they have one axis."""
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


_LARGEST = 1.0  # distance of a taxel from the origin of its link above which it looks like millimetres (m)
_STRONGEST = 1e9  # largest reading of a taxel, in any unit; beyond it the number is damaged
_RATE = 200.0  # least physics reports per second
_STEPS = (1e-4, 1.0)  # shortest and longest median step of a log (s); beyond them time looks like ms, µs or frames
_GAP = 60.0  # longest gap of a log (s), through which the simulated hand waits
_MOST = 1_000_000  # most frames of an episode
_ALIKE, _SCALE = 0.7, 30.0  # correlation over all taxels from which sign and scale of a log are compared; largest scale


@dataclass(frozen=True, eq=False)
class TouchLog:
    """What a real hand did and felt."""

    name: str
    time: NDArray[np.float64]
    """[T] (s), rising."""
    joints: tuple[str, ...]
    position: NDArray[np.float64]
    """[T, J] measured (rad, m)."""
    target: NDArray[np.float64] | None
    """[T, J] of the drives on the way to each frame; None where the log has none."""
    points: TactilePoints
    force: NDArray[np.float64]
    """[T, N] along inward normals, in ``unit``."""
    unit: str = "N"
    taxels: tuple[str, ...] = ()
    """[N] ``LINK:NUMBER`` by the numbers of the log; by default counted on each link in their order."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "taxels", self.taxels or tuple(taxel_names(self.points.links)))
        for what in ("time", "position", "target", "force"):
            values = getattr(self, what)
            if values is not None and not np.isfinite(values).all():
                row = int(np.argwhere(~np.isfinite(values))[0][0])
                raise DataError(f"{self.name}: {what} of frame {row} is no finite number; cut the log there.")
        if len(self.time) < 2 or (late := np.flatnonzero(np.diff(self.time) <= 0)).size:
            where = f"frame {late[0] + 1} does not come after the one before" if len(self.time) > 1 else "one frame"
            raise DataError(f"{self.name}: time stamps must rise from frame to frame; {where}.")
        steps = np.diff(self.time)
        if not _STEPS[0] <= (step := float(np.median(steps))) <= _STEPS[1] or steps.max() > _GAP:
            raise DataError(
                f"{self.name}: frames come every {step:g} s (allowed: {_STEPS[0]:g} to {_STEPS[1]:g}), and the longest "
                f"gap is {steps.max():g} s (at most {_GAP:g}); give time in seconds, and cut the log at a gap."
            )
        if not self.joints or not self.points.links:
            counts = f"{len(self.joints)} and {self.force.shape[1]}"
            raise DataError(f"{self.name} needs joints and taxels; it has {counts}.")
        if (most := float(np.abs(self.force).max(initial=0.0))) > _STRONGEST:
            raise DataError(f"{self.name}: a taxel reads {most:g}, more than any hand feels ({_STRONGEST:g}).")
        for kind, names in {"taxel": self.taxels, "joint": self.joints}.items():
            name, times = Counter(names).most_common(1)[0]
            if times > 1:
                raise DataError(f"{self.name}: the {kind} {name} stands in it {times} times.")
        far = float(np.abs(self.points.position).max())
        if not far <= _LARGEST:
            raise DataError(f"{self.name}: a taxel lies {far:g} m from its link; scale millimetres by 1e-3.")
        lengths = np.linalg.norm(self.points.normal, axis=1)
        if not np.allclose(lengths, 1.0, atol=0.01):
            raise DataError(
                f"{self.name}: normals are {lengths.min():g} to {lengths.max():g} long; they must be 1 long."
            )


@dataclass(frozen=True, eq=False)
class Replay:
    """Real beside simulated readings."""

    log: TouchLog
    simulated: NDArray[np.float64]
    """[T, N] (N)."""
    position: NDArray[np.float64]
    """[T, J] of the simulated joints."""

    @property
    def tracking(self) -> float:
        """Root mean square of simulated less measured joints (rad, m)."""
        return float(np.sqrt(np.mean((self.position - self.log.position) ** 2)))

    @property
    def doubts(self) -> list[str]:
        """What speaks for another sign or unit of the log, where both hands feel the same course."""
        real, simulated = (values - values.mean(axis=0) for values in (self.log.force, self.simulated))
        product, power = float((real * simulated).sum()), float((simulated**2).sum())
        alike = product / max(np.sqrt(power * float((real**2).sum())), 1e-300)
        if alike < -_ALIKE:
            return ["The log falls where the simulated hand feels more: forces along inward normals are positive."]
        if self.log.unit == "N" and alike > _ALIKE and not 1 / _SCALE < (scale := product / power) < _SCALE:
            return [f"The log reads {scale:.3g} times what the simulated hand feels: is it in another unit than N?"]
        return []

    def rows(self) -> list[dict[str, Any]]:
        """Return link, number, peaks, error and correlation of every taxel."""
        rows = []
        for index, name in enumerate(self.log.taxels):
            real, simulated = self.log.force[:, index], self.simulated[:, index]
            moving = min(np.ptp(real), np.ptp(simulated)) > 0
            rows.append({
                "taxel": name, "real_peak": float(real.max()), "simulated_peak": float(simulated.max()),
                "error": float(np.sqrt(np.mean((simulated - real) ** 2))),
                "bias": float(np.mean(simulated - real)),
                "correlation": float(np.corrcoef(real, simulated)[0, 1]) if moving else None,
            })  # fmt: skip
        return rows


def taxel_names(links: Sequence[str]) -> list[str]:
    """Return ``LINK:NUMBER`` of taxels in their order."""
    numbers = defaultdict[str, Iterator[int]](count)
    return [f"{link}:{next(numbers[link])}" for link in links]


def read_touch_log(path: str | os.PathLike[str], hand: Hand, layout: Layout, episode: int = 0) -> TouchLog:
    """Read a LeRobot data set (a folder) or a table of joints and taxels (a file), and check that it is of a hand."""
    path = Path(path)
    if not path.is_dir():
        log = _read_table(path, hand, layout)
    else:
        try:
            log = _read_episode(path, hand, layout, episode)
        except BrainbenchError:
            raise
        except (KeyError, IndexError, TypeError, AttributeError, ValueError) as error:
            raise DataError(f"{path.name}/meta is not as LeRobot writes it ({brief(repr(error))}).") from None
    stated = log.position if log.target is None else np.concatenate([log.position, log.target])
    for name, positions in zip(log.joints, stated.T, strict=True):
        joint = hand.model.joint(name)
        unit, wrong = ("rad", "degrees") if joint.type[0] == 3 else ("m", "millimetres")
        low, high = joint.range if hand.model.jnt_limited[joint.id] else (-np.pi, np.pi)
        # An encoder's offset may lead out of a range, and never as far again as the range is wide.
        if positions.max() - high > (far := max(high - low, 0.1)) or low - positions.min() > far:
            far = positions[np.argmax(np.abs(positions))]
            raise DataError(f"{log.name}: {name} is at {far:g} {unit}, of {low:.3g} to {high:.3g}; are these {wrong}?")
    return log


def _of_hand(name: str, joints: Sequence[str], links: Sequence[str], hand: Hand) -> None:
    for kind, names, choices in (("joint", joints, hand.joints), ("link", links, hand.links())):
        if strange := [word for word in names if word not in choices]:
            raise DataError(f"{name} is of another hand than {hand.name!r}: {unknown_name(kind, strange[0], choices)}")


def _placed(links: Sequence[str], numbers: Sequence[int], layout: Layout, name: str) -> TactilePoints:
    """Return the places of taxels that a layout numbers."""
    active = {link: np.flatnonzero(probes.active) for link, probes in layout.items()}
    for link, number in zip(links, numbers, strict=True):
        if link not in active or number >= len(active[link]):
            count = len(active.get(link, ()))
            raise DataError(f"{name}: the layout has {count} taxels on {link!r}; the log has a number {number}.")
    rows = [(layout[link], active[link][number]) for link, number in zip(links, numbers, strict=True)]
    columns = [
        np.array([getattr(probes, key)[row] for probes, row in rows]) for key in ("position", "normal", "radius")
    ]
    return TactilePoints(tuple(links), columns[0].reshape(-1, 3), columns[1].reshape(-1, 3), columns[2])


def _read_table(path: Path, hand: Hand, layout: Layout) -> TouchLog:
    """Read a log as a table of joints and taxels."""
    header, table = read_columns(path, "log of joints and taxels")
    if "time" not in header:
        raise DataError(f"{path.name} needs a column 'time' (s), joints (rad) and taxels LINK:NUMBER (N).")
    taxels = [name for name in header if ":" in name]
    joints = [name for name in header if name != "time" and name not in taxels]
    links, words = zip(*(name.rsplit(":", 1) for name in taxels), strict=True) if taxels else ((), ())
    if wrong := [name for name, word in zip(taxels, words, strict=True) if not word.isdecimal() or len(word) > 6]:
        raise DataError(f"{path.name}: a taxel's column is LINK:NUMBER, such as 'tip:0'; received {wrong[0]!r}.")
    _of_hand(path.name, joints, links, hand)
    numbers = [int(word) for word in words]
    points = _placed(links, numbers, layout, path.name)
    position = table[:, [header.index(name) for name in joints]]
    force = table[:, [header.index(name) for name in taxels]]
    names = tuple(f"{link}:{number}" for link, number in zip(links, numbers, strict=True))
    time = table[:, header.index("time")]
    return TouchLog(path.name, time, tuple(joints), position, None, points, force, taxels=names)


def _read_episode(folder: Path, hand: Hand, layout: Layout, episode: int) -> TouchLog:
    """Read an episode of a LeRobot data set; taxels that it does not place are those of the hand's layout."""
    name = folder.name
    info = read_json(folder / "meta" / "info.json", "LeRobot description")
    version = str(info.get("codebase_version", "")) if isinstance(info, dict) else ""
    if version[:2] not in ("v2", "v3"):
        raise DataError(f"{name} is no LeRobot data set of layout v2 or v3; its codebase_version is {version!r}.")
    features, episodes = info.get("features", {}), info.get("total_episodes", 0)
    check_number(f"The number of an episode of {name}", episode, least=0, below=episodes, whole=True)
    if absent := {"observation.state", "observation.tactile"} - set(features):
        raise DataError(f"{name} lacks {listing(sorted(absent))}: joints and touch are what is replayed.")
    frames = _frames(folder, version, episode, info)
    time = np.asarray(frames["timestamp"], float)
    if TIME in features:
        # Of the ticks that used one report the last counts, whose targets hold.
        time = _stacked(frames, TIME, name)[:, 0]
        last = np.append(np.diff(time) != 0, True)
        frames, time = frames[last], time[last]
    joints = _joint_names(features["observation.state"].get("names"))
    position = _stacked(frames, "observation.state", name)
    tactile = _stacked(frames, "observation.tactile", name)
    if position.shape[1:] != (len(joints),):
        raise DataError(f"{name}: observation.state has {position.shape[1:]} numbers and {len(joints)} joint names.")
    target, driven = None, _joint_names(features.get("action", {}).get("names"))
    if sorted(driven) == sorted(joints):
        # An action is what follows its frame's state.
        actions = _stacked(frames, "action", name)[:, [driven.index(joint) for joint in joints]]
        target = np.concatenate([position[:1], actions[:-1]])
    unit, described = "N", folder / "meta" / "tactile.json"
    if described.is_file():
        places = read_json(described, "places of tactile points")
        links = [places["links"][number] for number in places["link"] if number >= 0]
        points = TactilePoints(tuple(links), *(np.array(places[key], float) for key in ("position", "normal")))
        if not (len(places["link"]), 3) == (len(links), 3) == points.position.shape == points.normal.shape:
            raise DataError(f"{name}: meta/tactile.json gives each point a link (from 0), position [3] and normal [3].")
        unit = str(places.get("units", ["N"])[0])
    else:
        taxels = [(link, number) for link, probes in layout.items() for number in range(probes.active.sum())]
        links, numbers = zip(*taxels, strict=True)
        points = _placed(links, numbers, layout, name)
    _of_hand(name, joints, links, hand)
    if tactile.shape[1] != len(links):
        raise DataError(
            f"{name} is a log of another hand: it has {tactile.shape[1]} taxels, {hand.name!r} {len(links)}; write "
            "their places into meta/tactile.json, or choose --placement and --resolution."
        )
    if tactile.shape[2:] not in ((), (3,), (6,)):
        raise DataError(
            f"{name}: observation.tactile is [N] (along inward normals), [N, 3] or [N, 6] (force and torque, frame of "
            f"the link) in each frame; received {list(tactile.shape[1:])}."
        )
    force = tactile if tactile.ndim == 2 else -(tactile[..., :3] * points.normal).sum(axis=-1)
    return TouchLog(name, time, tuple(joints), position, target, points, force, unit)


def _joint_names(names: Any) -> list[str]:
    """Return the names of a feature, which some write as ``{"motors": […]}`` and with the ending ``.pos``."""
    if isinstance(names, dict):
        names = next(iter(names.values()), [])
    return [str(name).removesuffix(".pos") for name in names or []]


def _stacked(frames: Any, column: str, name: str) -> NDArray[np.float64]:
    """Return the rows of a column as one array, whose cells may be nested lists."""
    try:
        return np.array([np.array(np.asarray(cell).tolist(), float) for cell in frames[column]], float)
    except (KeyError, ValueError, TypeError):
        raise DataError(f"{name}: {column} is missing, or its frames differ in their length.") from None


def _frames(folder: Path, version: str, episode: int, info: dict[str, Any]) -> Any:
    """Return the table of an episode's frames."""
    import pandas

    try:
        from pyarrow import parquet
    except ImportError:
        raise missing_dependency("pyarrow", extra="board", purpose="Reading a LeRobot data set") from None
    if version.startswith("v2"):
        chunk = episode // max(int(info.get("chunks_size", 1000)), 1)
        files = [folder / "data" / f"chunk-{chunk:03d}" / f"episode_{episode:06d}.parquet"]
    else:
        files = sorted((folder / "data").glob("chunk-*/file-*.parquet"))
    parts = []
    for file in files:
        try:
            if (rows := parquet.read_metadata(file).num_rows) <= 100 * _MOST:
                table = parquet.read_table(file, filters=[("episode_index", "=", episode)])
                rows = table.num_rows
        except (OSError, ValueError) as error:
            raise DataError(f"{file.name} of {folder.name} cannot be read: {str(error)[:100]}.") from None
        if rows > _MOST:
            raise DataError(f"{file.name} has {rows} frames; more than {_MOST} are not replayed.")
        parts += [table.to_pandas()] if rows else []
    if not parts:
        raise DataError(f"{folder.name} holds no frames of episode {episode}.")
    return pandas.concat(parts).sort_values("timestamp", kind="stable")


def replay(log: TouchLog, hand: str) -> Replay:
    """Let the simulated hand, which holds a ball, follow the log's joints, and read the same taxels.

    What lay in the real hand is not known: touch of anything else differs from the ball's.
    """
    step = float(np.median(np.diff(log.time)))
    substeps = int(np.ceil(_RATE * step))
    body = SimulatedHand(hand, substeps / step)
    sensors = {}
    rows_of = {link: np.array(log.points.links) == link for link in log.points.links}
    for link, rows in rows_of.items():
        radius = np.broadcast_to(log.points.radius, rows.shape)[rows]
        probes = Probes(log.points.position[rows], log.points.normal[rows], radius)
        sensors[link] = KinematicTaxel(link=link, probes=probes, total="engine", friction=1.0)
    suite = SensorSuite(body.engine.scene, sensors, num_envs=1)
    columns = [body.joints.index(joint) for joint in log.joints]
    target = body.position
    target[columns] = log.position[0]
    body.place(target)
    simulated, position = np.zeros(log.force.shape), np.zeros(log.position.shape)
    # A gap in the log is waited for, and what is rounded away at a frame is made up for at the next.
    reports = np.diff(np.round(substeps * (log.time - log.time[0]) / step).astype(int), prepend=0)
    passed = np.diff(log.time, prepend=log.time[0] - step)
    targets = log.target
    if targets is None:
        # A damped drive stays behind joints that move, and a target that is held half a frame ahead of its mean.
        way = np.diff(log.position, axis=0, prepend=log.position[:1])
        targets = log.position + way * (body.lag[columns] / passed[:, None] - 0.5)
    for frame in range(len(log.time)):
        target[columns] = targets[frame]
        body.drive(target)
        for _ in range(reports[frame]):
            body.step()
        suite.update(body.engine.state, passed[frame])
        position[frame] = body.position[columns]
        for link, rows in rows_of.items():
            force = suite.read(link)[0, :, :3].numpy()
            simulated[frame, rows] = -(force * log.points.normal[rows]).sum(axis=-1)
    return Replay(log, simulated, position)
