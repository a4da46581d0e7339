"""Scene files: one TOML file describes one or several labelled scenes. Units stand in the keys: docs/scene-files.md."""

from __future__ import annotations

import dataclasses
import glob
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from brainbench.core.contracts import GRID_SHAPE
from brainbench.core.errors import (
    BrainbenchError,
    UsageError,
    brief,
    check_each,
    check_name,
    listing,
    repeats,
    unknown_name,
)
from brainbench.core.limits import Limit, check_value
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_toml
from brainbench.core.reading.values import read_table
from brainbench.core.rotations import Length, Vector
from brainbench.geometry import DecompositionSettings
from brainbench.stimuli.motion import trajectories
from brainbench.stimuli.motion.recorded import (
    PlayOptions,
    Recorded,
    Tracked,
    load_angles,
    load_initial_angles,
    load_tracks,
    load_trajectory,
)
from brainbench.stimuli.motion.trajectories import ROTATIONS, Rotations, Spin, Still, Translation, Whisking
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.objects.solid import (
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
from brainbench.stimuli.scenes.scene import Animal, Frames, Head, Scene, WhiskerMotion
from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes
from brainbench.stimuli.tracks.readers import TrackOptions
from brainbench.stimuli.whiskers.array import ROWS, SPECIES, MountedWhisker, WhiskerArray, published_whisker
from brainbench.stimuli.whiskers.whisker import Whisker

MILLI = 1e-3
"""Metres in a millimetre, seconds in a millisecond."""
_UNITS = {
    "_mm_s": MILLI, "_deg_s": math.pi / 180, "_m_s2": 1, "_m_s": 1, "_mm": MILLI, "_ms": MILLI,
    "_deg": math.pi / 180, "_hz": 1, "_newton": 1,
}  # fmt: skip
"""Ends of keys → what their numbers are multiplied by to be in SI units."""
_FAMILY = "family:"
_TRIAL = "{trial}"


class Table(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Table of a TOML file, whose keys end in their unit; a key that is missing is None."""

    def si(self, *keys: str, **renamed: str) -> dict[str, Any]:
        """Return what the file says of some keys, in SI units, by the keys without their units or by other names."""
        names = {**{_unit_of(key)[0]: key for key in keys}, **renamed}
        values = {name: (getattr(self, key), _unit_of(key)[1]) for name, key in names.items()}
        return {name: _scaled(value, factor) for name, (value, factor) in values.items() if value is not None}


class _Moving(Table):
    position_mm: Vector | None = None
    rotation_deg: Vector | None = None
    velocity_mm_s: Vector | None = None
    velocity_onset_ms: float | None = None
    times_ms: tuple[float, ...] | None = None
    path_mm: tuple[Vector, ...] | None = None
    path_deg: tuple[Vector, ...] | None = None


class _Object(_Moving, kw_only=True):
    shape: str
    spin_deg_s: Vector | None = None
    spin_onset_ms: float | None = None
    friction: float | None = None


class _Surface(_Object):
    diagonal_mm: float | None = None
    collision: str | None = None
    method: str | None = None
    threshold: float | None = None
    most_pieces: int | None = None


class _Mesh(_Surface, kw_only=True):
    path: str
    unit: str


class _Family(_Surface):
    seed: int | None = None
    detail: int | None = None


class _Whisking(Table):
    kind: str | None = None
    rotations: str | None = None
    frequency_hz: float | None = None
    protraction_deg: float | None = None
    retraction_deg: float | None = None
    onset_ms: float | None = None


class _Recorded(_Whisking, kw_only=True):
    path: str
    rate_hz: float | None = None
    layout: str | None = None
    initial_path: str | None = None
    start_deg: float | None = None


class _Track(_Whisking, kw_only=True):
    path: str
    whiskers: dict[str, str] = {}
    frame_rate_hz: float | None = None
    mm_per_pixel: float | None = None
    layout: str | None = None
    zero_frame: int | None = None
    parts: list[str] | None = None
    least_likelihood: float | None = None
    identities_path: str | None = None
    rest_deg: float | None = None
    view: str | None = None
    rostral_deg: float | None = None
    longest_gap_ms: float | None = None
    lowpass_hz: float | None = None


class _Frames(Table):
    first_ms: float | None = None
    interval_ms: float | None = None
    rate_hz: Annotated[float, Limit(above=0)] | None = None
    count: int | None = None
    average: int | None = None
    lowpass_hz: float | None = None
    phase: str | None = None
    axes: str | None = None
    clip_newton: float | None = None


class _Array(Table):
    species: str | None = None
    side: str | None = None
    whiskers: str = "all"
    replace: dict[str, dict[str, Any]] = {}


class _Mount(Table, kw_only=True):
    name: str
    position_mm: Vector
    angles_deg: Vector
    whisker: dict[str, Any] = {}


class _Species(Table, kw_only=True):
    species: str
    citation: str = ""
    side: str = "right"
    rules: str | None = None
    whisker: dict[str, Any] = {}
    mount: list[dict[str, Any]]


class _Animal(Table):
    name: str
    array: dict[str, Any] = {}
    head: dict[str, Any] = {}
    whisking: dict[str, Any] = {}


class _Scene(Table):
    label: str
    head: dict[str, Any] = {}
    whisking: dict[str, Any] = {}
    object: list[dict[str, Any]] = []
    gravity_m_s2: Vector | None = None
    air_flow_m_s: Vector | None = None


class _File(Table):
    description: str = ""
    twist: bool = True
    array: dict[str, Any] = {}
    head: dict[str, Any] = {}
    whisking: dict[str, Any] = {}
    frames: dict[str, Any] = {}
    animal: list[dict[str, Any]] = []
    object: list[dict[str, Any]] = []
    gravity_m_s2: Vector | None = None
    air_flow_m_s: Vector | None = None
    scene: list[dict[str, Any]] = []


_WHISKINGS: dict[str, type[_Whisking]] = {
    "sinusoid": _Whisking, "still": _Whisking, "recorded": _Recorded, "track": _Track,
}  # fmt: skip
_PRIMITIVES: dict[str, tuple[Callable[..., Solid], list[Any]]] = {
    "sphere": (sphere, [("radius_mm", float)]),
    "box": (box, [("size_mm", Vector)]),
    "cylinder": (cylinder, [("radius_mm", float), ("height_mm", float)]),
    "capsule": (capsule, [("radius_mm", float), ("length_mm", float)]),
    "rodgers": (rodgers_solid, [("diagonal_mm", float | None, None), ("segments", int | None, None)]),
}
"""Shape → function, and keys with their types and defaults."""


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
    """Read a scene file; docs/scene-files.md lists the keys.

    Args:
        path: a ``.toml`` file.
        whiskers: keep only these of the file's whiskers; see :meth:`WhiskerArray.select`.
    """
    path = Path(path)
    data = read_toml(path, "scene file")
    try:
        with readable(path, "scene file"):
            return _recipe(path, data, whiskers)
    except BrainbenchError as error:
        raise type(error)(f"{os.fspath(path)}: {error}") from error


def _unit_of(key: str) -> tuple[str, float | None]:
    """Return a key without its unit, and the factor to SI units; None for what is no number with a unit."""
    unit = next((unit for unit in _UNITS if key.endswith(unit)), "")
    return key.removesuffix(unit), _UNITS.get(unit)


def _scaled(value: Any, factor: float | None) -> Any:
    if factor is None:
        return value
    return tuple(_scaled(inner, factor) for inner in value) if isinstance(value, tuple) else value * factor


def _recipe(path: Path, data: dict[str, Any], whiskers: str) -> Recipe:
    file = read_table(_File, data, "the scene file")
    array = _array(file.array, path.parent)
    others = tuple(_animal(read_table(_Animal, animal, "[[animal]]"), path.parent) for animal in file.animal)
    side = array.mounts[0].full_name[0]
    if not file.scene:
        raise UsageError("the file has no [[scene]].")
    scenes = []
    for table in _trials(file, path.parent):
        name = f"[[object]] of scene {table.label!r}"
        scene = Scene(
            label=table.label,
            array=array,
            objects=tuple(_object(entry, name, path.parent) for entry in (*file.object, *table.object)),
            whisking=_whisking(table.whisking, path.parent, side),
            head=_head({**file.head, **table.head}),
            frames=_frames(file.frames),
            others=others,
            twist=file.twist,
            **{**file.si("gravity_m_s2", "air_flow_m_s"), **table.si("gravity_m_s2", "air_flow_m_s")},
        )
        scenes.append(scene.select(whiskers))
    if twice := repeats(scene.label for scene in scenes):
        raise UsageError(f"several scenes have the label {twice[0]!r}; labels must differ.")
    return Recipe(path.stem, file.description, tuple(scenes))


def _animal(table: _Animal, folder: Path) -> Animal:
    array = _array(table.array, folder)
    whisking = _whisking(table.whisking, folder, array.mounts[0].full_name[0])
    return Animal(table.name, array, whisking, _head(table.head))


def _trials(file: _File, folder: Path) -> Iterator[_Scene]:
    """Yield the scenes of a file with their whisking, one for each trial where a label asks for trials."""
    for entry in file.scene:
        table = read_table(_Scene, entry, "[[scene]]")
        whisking = {**file.whisking, **table.whisking}
        where = str(whisking.get("path", ""))
        if _TRIAL not in table.label:
            yield msgspec.structs.replace(table, whisking=whisking)
            continue
        if whisking.get("kind") != "track" or where.count(_TRIAL) != 1:
            raise UsageError(
                f"the label {table.label!r} asks for trials; they are the files of tracked whisking, whose path holds "
                f"{_TRIAL} once, as in tracks/{_TRIAL}.csv: received {brief(where)}."
            )
        before, after = where.split(_TRIAL)
        files = sorted(folder.glob(f"{glob.escape(before)}*{glob.escape(after)}"))
        if not files:
            raise UsageError(f"there is no file {where!r} in {brief(os.fspath(folder))}, whatever {_TRIAL} is.")
        for track in files:
            trial = track.relative_to(folder).as_posix().removeprefix(before).removesuffix(after)
            # The keys of a trial may name its own files, so that every text of the scene is filled in.
            data = msgspec.json.encode({**entry, "whisking": whisking}).replace(
                _TRIAL.encode(), msgspec.json.encode(trial)[1:-1]
            )
            yield read_table(_Scene, msgspec.json.decode(data), "[[scene]]")


def load_array(path: str | os.PathLike[str]) -> WhiskerArray:
    """Read a species file, the whiskers of any animal; docs/scene-files.md lists the keys."""
    table = read_table(_Species, read_toml(path, "species file"), f"the species file {brief(os.fspath(path))}")
    check_name("side", table.side, ("right", "left"))
    if table.rules is not None:
        check_name("rules of a species file", table.rules, SPECIES)
    mounts = [_mount(read_table(_Mount, entry, "[[mount]]"), table) for entry in table.mount]
    twice = repeats(mount.name for mount in mounts)
    if not mounts or twice:
        has = f"{brief(twice[0])} has several" if twice else "received none"
        raise UsageError(f"A species file has one [[mount]] for each whisker; {has}.")
    return WhiskerArray(table.species, tuple(mounts), table.citation)


def _mount(table: _Mount, species: _Species) -> MountedWhisker:
    name, given = table.name, {**species.whisker, **table.whisker}
    if not re.fullmatch(rf"[{ROWS}][0-{GRID_SHAPE[1] - 1}]", name):
        raise UsageError(
            f"A whisker is named by its row, one of {ROWS}, and its column, 0 to {GRID_SHAPE[1] - 1}, as C2; received "
            f"{brief(name)}."
        )
    properties = dataclasses.fields(Whisker)
    check_each(f"property of the whisker {name}", given, [field.name for field in properties])
    needed = {field.name for field in properties if field.default is dataclasses.MISSING}
    row, col = ROWS.index(name[0]), int(name[1:])
    if species.rules is not None and "arc_length" in given:
        # The rules of a species state what is not given: radii by arc length and place, and the material.
        check_value("arc_length of a whisker", given["arc_length"], Length)
        rod = published_whisker(given["arc_length"] / MILLI, 0.0, row, col, species=species.rules)
        given = {**{name: getattr(rod, name) for name in needed}, "friction": rod.friction, **given}
    if missing := sorted(needed - set(given)):
        raise UsageError(f"The whisker {name} needs {listing(missing)}, in its own table or for all in [whisker].")
    mount = table.si("position_mm", "angles_deg")
    return MountedWhisker(name, species.side, row, col, whisker=Whisker(**given), **mount)  # type: ignore[arg-type]


def _array(data: Mapping[str, Any], folder: Path) -> WhiskerArray:
    table = read_table(_Array, data, "[array]")
    if (table.species or "").endswith(".toml"):
        array = load_array(folder / str(table.species))
        array = array if table.side is None else array.on_side(table.side)  # type: ignore[arg-type]
    else:
        array = WhiskerArray.of(**table.si("species", "side"))
    for pattern, changes in table.replace.items():
        array = array.replace(pattern, **changes)
    return array.select(table.whiskers)


def _frames(data: Mapping[str, Any]) -> Frames:
    table = read_table(_Frames, data, "[frames]")
    if table.interval_ms is not None and table.rate_hz is not None:
        raise UsageError("[frames] takes interval_ms or rate_hz, not both.")
    given = table.si("first_ms", "interval_ms", "count", "average", "lowpass_hz", "phase", "axes", "clip_newton")
    if table.rate_hz is not None:
        given["interval"] = 1 / table.rate_hz
    return Frames(**given)


def _whisking(data: Mapping[str, Any], folder: Path, side: str) -> WhiskerMotion:
    """Return what ``[whisking]`` says; paths are relative to ``folder``, names without a side are of ``side``."""
    kind = str(data.get("kind", "sinusoid"))
    check_name("kind of whisking", kind, _WHISKINGS)
    table = read_table(_WHISKINGS[kind], data, "[whisking]")
    given = table.si("rotations", "frequency_hz", "protraction_deg", "retraction_deg", "onset_ms")
    if table.rotations is not None:
        check_name("set of rotations", table.rotations, ROTATIONS)
        given["rotations"] = ROTATIONS[table.rotations]
    whisking = Whisking(**given)
    if isinstance(table, _Track):
        return _tracked(table, folder, side, whisking.rotations)
    if not isinstance(table, _Recorded):
        return whisking if kind == "sinusoid" else Still()
    angles = table.initial_path and load_initial_angles(folder / table.initial_path, layout=table.layout)
    played = load_trajectory(folder / table.path, layout=table.layout, **table.si(rate="rate_hz"))
    return Recorded(played, rotations=whisking.rotations, initial=angles or {}, **table.si("start_deg"))


def _tracked(table: _Track, folder: Path, side: str, rotations: Rotations) -> Tracked:
    given = table.si("rest_deg", "rostral_deg", "view", "longest_gap_ms", "lowpass_hz")
    if given.get("lowpass") == 0:
        given["lowpass"] = None
    options = PlayOptions(**given)
    if table.layout == "angles":
        return load_angles(folder / table.path, options, rotations=rotations)
    if table.mm_per_pixel is None and table.rostral_deg is not None:
        raise UsageError("[whisking] needs the key 'mm_per_pixel' beside 'rostral_deg': bases move by lengths.")
    track = TrackOptions(
        # Directions have no scale; without displacements any will do.
        metres_per_pixel=MILLI * (table.mm_per_pixel or 0.1),
        identities=table.identities_path and os.fspath(folder / table.identities_path),
        parts=tuple(table.parts or ()),
        **table.si("layout", "zero_frame", "least_likelihood", frame_rate="frame_rate_hz"),
    )
    whiskers = {name if name[:1] in ("L", "R") else side + name: label for name, label in table.whiskers.items()}
    return load_tracks(folder / table.path, whiskers, track, options, rotations=rotations)


def _head(data: Mapping[str, Any]) -> Head:
    table = read_table(_Moving, data, "[head]")
    # The keys of several tables are joined here: an onset for all scenes moves nothing in a scene without velocity.
    motions = [_steady(Translation, table, "velocity_mm_s", "velocity_onset_ms"), _keyframes(table, "[head]")]
    return Head(**table.si("position_mm", "rotation_deg"), motion=_only(motions, "[head]", "a velocity or keyframes"))


def _object(data: Mapping[str, Any], name: str, folder: Path) -> PlacedObject:
    """Return the object that a table describes; paths are relative to ``folder``."""
    table, solid = _solid(data, name, folder)
    motions: list[Any] = [_keyframes(table, name)]
    for kind, velocity, onset in (
        (Translation, "velocity_mm_s", "velocity_onset_ms"),
        (Spin, "spin_deg_s", "spin_onset_ms"),
    ):
        motions.append(_steady(kind, table, velocity, onset))
        if onset in data and velocity not in data:
            raise UsageError(f"{name} needs the key {velocity!r} beside {onset!r}.")
    motion = _only(motions, name, "a velocity, a spin or keyframes")
    return PlacedObject(solid, motion=motion, **table.si("position_mm", "rotation_deg", "friction"))


def _steady(kind: type[Any], table: Table, velocity: str, onset: str) -> Any:
    given = table.si(velocity=velocity, onset=onset)
    return kind(**given) if "velocity" in given else None


def _keyframes(table: _Moving, name: str) -> trajectories.Path | None:
    given = table.si(times="times_ms", displacements="path_mm", rotations="path_deg")
    if not given:
        return None
    if "times" not in given:
        raise UsageError(f"{name} needs the key 'times_ms' beside its path.")
    still = ((0.0, 0.0, 0.0),) * len(given["times"])
    return trajectories.Path(**{"displacements": still, "rotations": still, **given})


def _only(motions: Sequence[Any], name: str, choice: str) -> Any:
    given = [motion for motion in motions if motion is not None]
    if len(given) > 1:
        raise UsageError(f"{name} takes {choice}, not several; keyframes can do all of it.")
    return given[0] if given else Still()


def _solid(data: Mapping[str, Any], name: str, folder: Path) -> tuple[_Object, Solid]:
    """Return the table of an object, and the solid that it describes."""
    shape = str(data.get("shape", ""))
    if shape in _PRIMITIVES:
        make, kinds = _PRIMITIVES[shape]
        primitive: Any = msgspec.defstruct("Primitive", kinds, bases=(_Object,), kw_only=True)
        table = read_table(primitive, data, name)
        return table, make(**table.si(*(key for key, *_ in kinds)))
    kind = _Mesh if shape == "mesh" else _Family if shape.startswith(_FAMILY) else _Object
    table = read_table(kind, data, name)
    if not isinstance(table, _Surface):
        raise unknown_name("shape", shape, [*_PRIMITIVES, "mesh", f"{_FAMILY}NAME"])
    cut = DecompositionSettings(**table.si("method", "threshold", "most_pieces"))
    options = {**table.si("diagonal_mm", "collision"), "decomposition": cut}
    if isinstance(table, _Mesh):
        return table, mesh_solid(folder / table.path, unit=table.unit, **options)
    member = procedural.make(shape.removeprefix(_FAMILY), **table.si("seed", "detail"))
    return table, shape_solid(member, **options)
