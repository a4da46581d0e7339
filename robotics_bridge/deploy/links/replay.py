"""A log of a real hand's joints and touch, replayed on the simulated hand. Letters: T frame, J joint, N taxel.

A log is a LeRobot episode (layouts v2 and v3, as :mod:`robotics_bridge.deploy.links.episodes` writes them) or a table
of comma-separated numbers: ``time`` (s), joints by name (rad) and taxels as ``LINK:NUMBER`` (N along the inward
normal), numbered as the hand's layout has them.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import (
    BrainbenchError,
    DataError,
    UsageError,
    brief,
    listing,
    missing_dependency,
    unknown_name,
)
from brainbench.core.reading.tables import read_columns
from brainbench.core.reading.texts import read_json
from robotics_bridge.deploy.links.episodes import TactilePoints
from robotics_bridge.deploy.links.simulated_hand import SimulatedHand
from robotics_bridge.hands import Hand
from robotics_bridge.hands.layouts import Layout
from robotics_bridge.sensors import KinematicTaxel, Probes, SensorSuite

RADIUS = 4e-3  # sensing radius of a taxel whose log does not say (m)
_LARGEST = 1.0  # distance of a taxel from the origin of its link above which it looks like millimetres (m)
_STRONGEST = 1e9  # largest reading of a taxel, in any unit; beyond it the number is damaged
_TURN = 2 * np.pi  # largest joint angle (rad); beyond it angles look like degrees
_RATE = 200.0  # least physics reports per second
_MOST = 1_000_000  # most frames of an episode


@dataclass(frozen=True, eq=False)
class TouchLog:
    """What a real hand did and felt."""

    name: str
    time: NDArray[np.float64]
    """[T] (s), rising."""
    joints: tuple[str, ...]
    position: NDArray[np.float64]
    """[T, J] measured (rad, m)."""
    target: NDArray[np.float64]
    """[T, J] of the drives; the positions where the log has none."""
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
            if not np.isfinite(values).all():
                row = int(np.argwhere(~np.isfinite(values))[0][0])
                raise DataError(f"{self.name}: {what} of frame {row} is no finite number; cut the log there.")
        if len(self.time) < 2 or (late := np.flatnonzero(np.diff(self.time) <= 0)).size:
            where = f"frame {late[0] + 1} does not come after the one before" if len(self.time) > 1 else "one frame"
            raise DataError(f"{self.name}: time stamps must rise from frame to frame; {where}.")
        if not self.joints or not self.points.links:
            raise DataError(
                f"{self.name} needs joints and taxels; it has {len(self.joints)} and {self.force.shape[1]}."
            )
        if (most := float(np.abs(self.force).max(initial=0.0))) > _STRONGEST:
            raise DataError(
                f"{self.name}: a taxel reads {most:g}, more than any hand feels ({_STRONGEST:g}); correct it."
            )
        far = float(np.abs(self.points.position).max())
        if far > _LARGEST:
            raise DataError(f"{self.name}: a taxel lies {far:g} m from its link; scale millimetres by 1e-3.")


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
    count: dict[str, int] = {}
    names = []
    for link in links:
        names.append(f"{link}:{count.get(link, 0)}")
        count[link] = count.get(link, 0) + 1
    return names


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
            what = brief(f"{type(error).__name__}: {error}")
            raise DataError(f"The descriptions in {path.name}/meta are not as LeRobot writes them ({what}).") from None
    angles = [n for n, name in enumerate(log.joints) if hand.model.joint(name).type[0] == 3]
    widest = float(np.abs(log.position[:, angles]).max(initial=0.0))
    if widest > _TURN:
        raise DataError(f"{log.name}: a joint is at {widest:g} rad; angles are in radians, so scale degrees by π/180.")
    return log


def _of_hand(name: str, joints: Sequence[str], links: Sequence[str], hand: Hand) -> None:
    for kind, names, choices in (("joint", joints, hand.joints), ("link", links, hand.links())):
        if strange := [word for word in names if word not in choices]:
            raise DataError(
                f"{name} is a log of another hand than {hand.name!r}: {unknown_name(kind, strange[0], choices)}"
            )


def _placed(links: Sequence[str], numbers: Sequence[int], layout: Layout, name: str) -> TactilePoints:
    """Return the places of taxels that a layout numbers."""
    active = {link: np.flatnonzero(probes.active) for link, probes in layout.items()}
    for link, number in zip(links, numbers, strict=True):
        if link not in active or number >= len(active[link]):
            count = len(active.get(link, ()))
            raise DataError(f"{name}: the layout has {count} taxels on {link!r}; the log has a number {number}.")
    rows = [(layout[link], active[link][number]) for link, number in zip(links, numbers, strict=True)]
    position = np.array([probes.position[row] for probes, row in rows]).reshape(-1, 3)
    return TactilePoints(tuple(links), position, np.array([probes.normal[row] for probes, row in rows]).reshape(-1, 3))


def _read_table(path: Path, hand: Hand, layout: Layout) -> TouchLog:
    header, table = read_columns(path, "log of joints and taxels")
    if "time" not in header:
        raise DataError(f"{path.name} needs a column 'time' (s), joints (rad) and taxels LINK:NUMBER (N).")
    taxels = [name for name in header if ":" in name]
    joints = [name for name in header if name != "time" and name not in taxels]
    links, words = zip(*(name.rsplit(":", 1) for name in taxels), strict=True) if taxels else ((), ())
    if wrong := [name for name, word in zip(taxels, words, strict=True) if not word.isdecimal() or len(word) > 6]:
        raise DataError(f"{path.name}: a taxel's column is LINK:NUMBER, such as 'tip:0'; received {wrong[0]!r}.")
    _of_hand(path.name, joints, links, hand)
    points = _placed(links, [int(word) for word in words], layout, path.name)
    position = table[:, [header.index(name) for name in joints]]
    force = table[:, [header.index(name) for name in taxels]]
    time = table[:, header.index("time")]
    return TouchLog(path.name, time, tuple(joints), position, position, points, force, taxels=tuple(taxels))


def _read_episode(folder: Path, hand: Hand, layout: Layout, episode: int) -> TouchLog:
    name = folder.name
    info = read_json(folder / "meta" / "info.json", "LeRobot description")
    version = str(info.get("codebase_version", "")) if isinstance(info, dict) else ""
    if version[:2] not in ("v2", "v3"):
        raise DataError(f"{name} is no LeRobot data set of layout v2 or v3; its codebase_version is {version!r}.")
    features, count = info.get("features", {}), info.get("total_episodes", 0)
    if not 0 <= episode < count:
        raise UsageError(f"{name} has {count} episodes, from 0; received {episode}.")
    if absent := {"observation.state", "observation.tactile"} - set(features):
        raise DataError(f"{name} lacks {listing(sorted(absent))}: joints and touch are what is replayed.")
    frames = _frames(folder, version, episode, info)
    joints = _joint_names(features["observation.state"].get("names"))
    position = _stacked(frames, "observation.state", name)
    tactile = _stacked(frames, "observation.tactile", name)
    if position.shape[1:] != (len(joints),):
        raise DataError(f"{name}: observation.state has {position.shape[1:]} numbers and {len(joints)} joint names.")
    target, driven = position, _joint_names(features.get("action", {}).get("names"))
    if sorted(driven) == sorted(joints):
        target = _stacked(frames, "action", name)[:, [driven.index(joint) for joint in joints]]
    unit, described = "N", folder / "meta" / "tactile.json"
    if described.is_file():
        places = read_json(described, "places of tactile points")
        links = [places["links"][number] for number in places["link"]]
        points = TactilePoints(tuple(links), *(np.array(places[key], float) for key in ("position", "normal")))
        unit = str(places.get("units", ["N"])[0])
    else:
        links = [link for link, probes in layout.items() for _ in range(int(probes.active.sum()))]
        numbers = [int(word.rsplit(":", 1)[1]) for word in taxel_names(links)]
        points = _placed(links, numbers, layout, name)
    _of_hand(name, joints, links, hand)
    if tactile.shape[1] != len(links):
        raise DataError(
            f"{name} is a log of another hand: it has {tactile.shape[1]} taxels, {hand.name!r} {len(links)}; write "
            "their places into meta/tactile.json, or choose --placement and --resolution."
        )
    force = tactile if tactile.ndim == 2 else -(tactile[..., :3] * points.normal).sum(axis=-1)
    time = np.asarray(frames["timestamp"], float)
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
            if (rows := parquet.read_metadata(file).num_rows) > 100 * _MOST:
                raise DataError(f"{file.name} has {rows} frames, more than can be read at once.")
            table = parquet.read_table(file, filters=[("episode_index", "=", episode)])
        except (OSError, ValueError) as error:
            raise DataError(f"{file.name} of {folder.name} cannot be read: {str(error)[:100]}.") from None
        parts += [table.to_pandas()] if 0 < table.num_rows <= _MOST else []
    if not parts:
        raise DataError(f"{folder.name} holds no frames of episode {episode}.")
    return parts[0].sort_values("timestamp", kind="stable")


def replay(log: TouchLog, hand: str) -> Replay:
    """Let the simulated hand, which holds a ball, follow the log's joints, and read the same taxels.

    What lay in the real hand is not known: touch of anything else differs from the ball's.
    """
    steps = np.diff(log.time)
    step = float(np.median(steps))
    substeps = int(np.ceil(_RATE * step))
    body = SimulatedHand(hand, substeps / step)
    sensors = {}
    for link in dict.fromkeys(log.points.links):
        rows = np.array(log.points.links) == link
        probes = Probes(log.points.position[rows], log.points.normal[rows], np.full(rows.sum(), RADIUS))
        sensors[link] = KinematicTaxel(link=link, probes=probes, total="engine", friction=1.0)
    suite = SensorSuite(body.engine.scene, sensors, num_envs=1)
    columns = [body.joints.index(joint) for joint in log.joints]
    start = body.engine.data[0].qpos.copy()
    start[[int(body.engine.model.joint(joint).qposadr[0]) for joint in log.joints]] = log.position[0]
    body.engine.set(qpos=start)
    target = body.position
    simulated, position = np.zeros(log.force.shape), np.zeros(log.position.shape)
    for frame in range(len(log.time)):
        target[columns] = log.target[frame]
        body.drive(target)
        # A gap in the log is waited for.
        for _ in range(round(substeps * (steps[frame - 1] / step if frame else 1.0))):
            body.step()
        suite.update(body.engine.state, step)
        position[frame] = body.position[columns]
        for link in sensors:
            rows = np.array(log.points.links) == link
            force = suite.read(link)[0, :, :3].numpy()
            simulated[frame, rows] = -(force * log.points.normal[rows]).sum(axis=-1)
    return Replay(log, simulated, position)
