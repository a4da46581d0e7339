"""Scene files: one TOML file describes one or several labelled scenes. Units stand in the keys.

::

    description = "A pole in front of two whiskers"

    [array]                      # species = "mouse" | "rat"; side = "right" | "left" | "both"
    species = "mouse"
    whiskers = "C1,C2"
    [array.replace.C2]           # optional: other whisker properties, SI units, by selection
    young_modulus = 3.3e9

    [head]                       # the array frame in the world; rotation about x, then y, then z
    position_mm = [0, 0, 0]
    rotation_deg = [0, 0, 0]
    velocity_mm_s = [0, 10, 0]   # optional; or keyframes since t = 0: times_ms, path_mm and path_deg, a list each

    [whisking]                   # kind = "sinusoid" | "still" | "recorded"
    frequency_hz = 20
    protraction_deg = 30
    retraction_deg = 10
    onset_ms = 50
    rotations = "knutsen"
    # recorded: path = "whisking.csv", rate_hz = 1000, layout = "rat-60", start_deg = -10, initial_path = "angles.csv"

    [frames]
    first_ms = 1
    interval_ms = 9
    count = 110
    average = 18                 # readings per frame; 1 = instantaneous
    # instead of interval_ms: rate_hz = 1000. lowpass_hz = 50 filters the readings instead of averaging them;
    # phase = "zero" | "causal". axes = "world" | "follicle". clip_newton = 1 (moments: 1 mm times that)

    [[animal]]                   # optional: more animals, then whiskers are named "a:C2", "b:C2"
    name = "b"                   # with [animal.array], [animal.head] and [animal.whisking] as above

    [[scene]]                    # a scene's own [scene.head], [scene.whisking] win key by key
    label = "pole"
    [[scene.object]]             # position and rotation as for the head
    shape = "cylinder"
    radius_mm = 0.5
    height_mm = 20
    position_mm = [14, 5, 0]
    friction = 0.3               # optional; velocity_mm_s = [0, -30, 0] moves the object

``[[object]]`` at the top level stands in every scene. Other shapes: ``sphere`` (``radius_mm``), ``box``
(``size_mm``), ``capsule`` (``radius_mm``, ``length_mm``), ``rodgers`` (``diagonal_mm``, ``segments``) and
``mesh`` (``path`` relative to the file, ``unit``, ``diagonal_mm``, ``collision`` = "hull" | "exact" | "pieces" |
"decomposition") and ``family:NAME`` for a procedural shape (``seed``, ``diagonal_mm``, ``detail``, ``collision``;
names: ``brainbench stimuli objects``). A decomposition takes ``method`` = "coacd" | "vhacd", ``threshold`` and
``most_pieces``.
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.errors import BrainbenchError, DataError, DataFileNotFoundError, UsageError, unknown_name
from brainbench.geometry import DecompositionSettings
from brainbench.stimuli import shapes
from brainbench.stimuli.frames import Frames
from brainbench.stimuli.morphology import SPECIES, WhiskerArray
from brainbench.stimuli.motion import ROTATIONS, Still, Translation, Whisking
from brainbench.stimuli.motion import Path as HeadPath
from brainbench.stimuli.objects import (
    PlacedObject,
    Solid,
    box,
    capsule,
    cylinder,
    mesh_solid,
    rodgers_solid,
    shape_solid,
    sphere,
)
from brainbench.stimuli.scene import Animal, Head, Scene
from brainbench.stimuli.sweeps import SweepScenes

if TYPE_CHECKING:
    from brainbench.stimuli.motion import Rotations
    from brainbench.stimuli.trajectory import Recorded

_WHISKINGS = ("sinusoid", "still", "recorded")
_MM = 1e-3
_FAMILY = "family:"
_NOTHING: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Recipe:
    """Labelled scenes that belong together."""

    name: str
    description: str
    scenes: Sequence[Scene]
    """A tuple, or a lazy sequence that builds each scene when it is asked for (sweeps)."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels in order."""
        return self.scenes.labels if isinstance(self.scenes, SweepScenes) else tuple(s.label for s in self.scenes)


def load_scene(path: str | os.PathLike[str], *, whiskers: str = "all") -> Recipe:
    """Read a scene file; the module's documentation lists the keys.

    Args:
        path: a ``.toml`` file.
        whiskers: keep only these of the file's whiskers; see :meth:`WhiskerArray.select`.

    Raises:
        UsageError: a key is unknown (the message has the nearest), missing or of the wrong kind.
        DataError: the file is missing or is not TOML.
    """
    path = Path(path)
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataFileNotFoundError(f"There is no scene file {os.fspath(path)!r}.") from error
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataError(f"The scene file {os.fspath(path)!r} cannot be read as TOML ({error}).") from error
    try:
        return _recipe(path, data, whiskers)
    except BrainbenchError as error:
        raise type(error)(f"{os.fspath(path)}: {error}") from error


def _recipe(path: Path, data: dict[str, Any], whiskers: str) -> Recipe:
    top = _Table("the scene file", data)
    description = top.take("description", _text, "")
    array = _array(top.table("array"))
    others = tuple(_animal(_Table("[[animal]]", item), path.parent) for item in top.take("animal", _tables, []))
    shared = {name: top.take(name, _mapping, _NOTHING) for name in ("head", "whisking", "frames")}
    common = top.take("object", _tables, [])
    entries = top.take("scene", _tables, [])
    top.finish()
    if not entries:
        raise UsageError("the file has no [[scene]].")
    scenes = [_scene(entry, array, others, shared, common, path.parent).select(whiskers) for entry in entries]
    repeated = sorted({scene.label for scene in scenes if [s.label for s in scenes].count(scene.label) > 1})
    if repeated:
        raise UsageError(f"several scenes have the label {repeated[0]!r}; labels must differ.")
    return Recipe(path.stem, description, tuple(scenes))


def _scene(
    entry: Mapping[str, Any],
    array: WhiskerArray,
    others: tuple[Animal, ...],
    shared: Mapping[str, Mapping[str, Any]],
    common: list[Mapping[str, Any]],
    folder: Path,
) -> Scene:
    table = _Table("[[scene]]", entry)
    label = table.take("label", _text)
    merged = {name: {**shared[name], **table.take(name, _mapping, _NOTHING)} for name in ("head", "whisking")}
    objects = [*common, *table.take("object", _tables, [])]
    table.finish()
    return Scene(
        label=label,
        array=array,
        objects=tuple(_object(_Table(f"[[object]] of scene {label!r}", item), folder) for item in objects),
        whisking=_whisking(_Table("[whisking]", merged["whisking"]), folder),
        head=_head(_Table("[head]", merged["head"])),
        frames=_frames(_Table("[frames]", shared["frames"])),
        others=others,
    )


def _animal(table: _Table, folder: Path) -> Animal:
    animal = Animal(
        name=table.take("name", _text),
        array=_array(table.table("array")),
        whisking=_whisking(table.table("whisking"), folder),
        head=_head(table.table("head")),
    )
    table.finish()
    return animal


def _array(table: _Table) -> WhiskerArray:
    species = table.take("species", _text, "mouse")
    if species not in SPECIES:
        raise unknown_name("species", species, SPECIES)
    make = WhiskerArray.mouse if species == "mouse" else WhiskerArray.rat
    array = make(side=table.take("side", _text, "right"))  # type: ignore[arg-type]
    for pattern, changes in table.take("replace", _mapping, _NOTHING).items():
        array = array.replace(pattern, **_mapping(changes))
    array = array.select(table.take("whiskers", _text, "all"))
    table.finish()
    return array


def _head(table: _Table) -> Head:
    head = Head(
        position=table.take("position_mm", _vector(_MM), (0.0, 0.0, 0.0)),
        rotation=table.take("rotation_deg", _vector(math.pi / 180), (0.0, 0.0, 0.0)),
        motion=_path(table) or _motion(table),
    )
    table.finish()
    return head


def _path(table: _Table) -> HeadPath | None:
    """Keyframes of a head; None when it has none."""
    keys = ("times_ms", "path_mm", "path_deg")
    times = table.take(keys[0], _list(_number(_MM)), None)
    places = table.take(keys[1], _list(_vector(_MM)), None)
    turns = table.take(keys[2], _list(_vector(math.pi / 180)), None)
    if times is None:
        if places is None and turns is None:
            return None
        raise UsageError(f"{table.name} needs the key {keys[0]!r} beside its path.")
    still = ((0.0, 0.0, 0.0),) * len(times)
    return HeadPath(times, still if places is None else places, still if turns is None else turns)


def _whisking(table: _Table, folder: Path) -> Still | Whisking | Recorded:
    kind = table.take("kind", _text, "sinusoid")
    if kind not in _WHISKINGS:
        raise unknown_name("kind of whisking", kind, _WHISKINGS)
    usual = Whisking()
    name = table.take("rotations", _text, usual.rotations.name)
    if name not in ROTATIONS:
        raise unknown_name("set of rotations", name, ROTATIONS)
    whisking = Whisking(
        frequency=table.take("frequency_hz", _number(1.0), usual.frequency),
        protraction=table.take("protraction_deg", _number(math.pi / 180), usual.protraction),
        retraction=table.take("retraction_deg", _number(math.pi / 180), usual.retraction),
        onset=table.take("onset_ms", _number(_MM), usual.onset),
        rotations=ROTATIONS[name],
    )
    recorded = _recorded(table, folder, ROTATIONS[name]) if kind == "recorded" else None
    table.finish()
    return recorded or (whisking if kind == "sinusoid" else Still())


def _recorded(table: _Table, folder: Path, rotations: Rotations) -> Recorded:
    from brainbench.stimuli.trajectory import Recorded, load_initial_angles, load_trajectory

    layout = table.take("layout", _text, None)
    rate = table.take("rate_hz", _number(1.0), 1000.0)
    initial = table.take("initial_path", _text, None)
    return Recorded(
        load_trajectory(folder / table.take("path", _text), layout=layout, rate=rate),
        start=table.take("start_deg", _number(math.pi / 180), 0.0),
        rotations=rotations,
        initial={} if initial is None else load_initial_angles(folder / initial, layout=layout),
    )


def _frames(table: _Table) -> Frames:
    usual = Frames()
    interval = table.take("interval_ms", _number(_MM), None)
    rate = table.take("rate_hz", _number(1.0), None)
    if interval is not None and rate is not None:
        raise UsageError("[frames] takes interval_ms or rate_hz, not both.")
    if rate is not None:
        if rate <= 0:
            raise UsageError(f"'rate_hz' of [frames] must be positive; received {rate:g}.")
        interval = 1 / rate
    frames = Frames(
        first=table.take("first_ms", _number(_MM), usual.first),
        interval=usual.interval if interval is None else interval,
        count=table.take("count", _whole, usual.count),
        average=table.take("average", _whole, usual.average),
        lowpass=table.take("lowpass_hz", _number(1.0), usual.lowpass),
        phase=table.take("phase", _text, usual.phase),
        axes=table.take("axes", _text, usual.axes),
        clip=table.take("clip_newton", _number(1.0), usual.clip),
    )
    table.finish()
    return frames


def _motion(table: _Table) -> Still | Translation:
    velocity = table.take("velocity_mm_s", _vector(_MM), None)
    onset = table.take("velocity_onset_ms", _number(_MM), None)
    if velocity is None:
        return Still()
    return Translation(velocity) if onset is None else Translation(velocity, onset)


def _object(table: _Table, folder: Path) -> PlacedObject:
    shape = table.take("shape", _text)
    if shape not in _SHAPES and not shape.startswith(_FAMILY):
        raise unknown_name("shape", shape, [*_SHAPES, f"{_FAMILY}NAME"])
    placed = PlacedObject(
        solid=_family(table, shape.removeprefix(_FAMILY)) if shape not in _SHAPES else _SHAPES[shape](table, folder),
        position=table.take("position_mm", _vector(_MM), (0.0, 0.0, 0.0)),
        rotation=table.take("rotation_deg", _vector(math.pi / 180), (0.0, 0.0, 0.0)),
        motion=_motion(table),
        friction=table.take("friction", _number(1.0), None),
    )
    table.finish()
    return placed


def _mesh(table: _Table, folder: Path) -> Solid:
    path = folder / table.take("path", _text)
    return mesh_solid(
        path,
        unit=table.take("unit", _text),
        diagonal=table.take("diagonal_mm", _length, None),
        collision=table.take("collision", _text, "hull"),
        decomposition=_decomposition(table),
    )


def _family(table: _Table, name: str) -> Solid:
    shape = shapes.make(name, table.take("seed", _whole, 0), detail=table.take("detail", _whole, 4_000))
    return shape_solid(
        shape,
        diagonal=table.take("diagonal_mm", _length, 0.04),
        collision=table.take("collision", _text, None),
        decomposition=_decomposition(table),
    )


def _decomposition(table: _Table) -> DecompositionSettings:
    usual = DecompositionSettings()
    return DecompositionSettings(
        method=table.take("method", _text, usual.method),  # type: ignore[arg-type]
        threshold=table.take("threshold", _number(1.0), usual.threshold),
        most_pieces=table.take("most_pieces", _whole, usual.most_pieces),
    )


def _rodgers(table: _Table, folder: Path) -> Solid:
    diagonal = table.take("diagonal_mm", _length, 0.055)
    return rodgers_solid(diagonal, segments=table.take("segments", _whole, 24))


_SHAPES: dict[str, Callable[[_Table, Path], Solid]] = {
    "sphere": lambda table, folder: sphere(table.take("radius_mm", _length)),
    "box": lambda table, folder: box(table.take("size_mm", _vector(_MM))),
    "cylinder": lambda table, folder: cylinder(table.take("radius_mm", _length), table.take("height_mm", _length)),
    "capsule": lambda table, folder: capsule(table.take("radius_mm", _length), table.take("length_mm", _length)),
    "rodgers": _rodgers,
    "mesh": _mesh,
}

_REQUIRED = object()


class _Table:
    """One TOML table from which known keys are taken; whatever is left is an error."""

    def __init__(self, name: str, data: Mapping[str, Any]) -> None:
        self.name = name
        self._rest = dict(data)
        self._known: list[str] = []

    def take(self, key: str, convert: Callable[[Any], Any], default: Any = _REQUIRED) -> Any:
        self._known.append(key)
        if key not in self._rest:
            if default is _REQUIRED:
                raise UsageError(f"{self.name} needs the key {key!r}.")
            return default
        value = self._rest.pop(key)
        try:
            return convert(value)
        except (TypeError, ValueError) as error:
            raise UsageError(f"{key!r} of {self.name} must be {error}; received {value!r}.") from error

    def table(self, key: str) -> _Table:
        return _Table(f"[{key}]", self.take(key, _mapping, _NOTHING))

    def finish(self) -> None:
        for key in self._rest:
            raise unknown_name(f"key of {self.name}", key, sorted(self._known))


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("a text")
    return value


def _whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError("a whole number")
    return value


def _number(factor: float) -> Callable[[Any], float]:
    def convert(value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise TypeError("a finite number")
        return value * factor

    return convert


def _list(item: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, ...]]:
    def convert(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise TypeError("a list")
        return tuple(map(item, value))

    return convert


def _length(value: Any) -> float:
    return _number(_MM)(value)


def _vector(factor: float) -> Callable[[Any], tuple[float, float, float]]:
    def convert(value: Any) -> tuple[float, float, float]:
        if not isinstance(value, list) or len(value) != 3:
            raise TypeError("three numbers in brackets")
        x, y, z = map(_number(factor), value)
        return x, y, z

    return convert


def _mapping(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise TypeError("a table")
    return value


def _tables(value: Any) -> list[Mapping[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise TypeError("a list of tables in double brackets")
    return value
