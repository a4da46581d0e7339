"""Scene files: one TOML file describes one or several labelled scenes. Units stand in the keys.

::

    description = "A pole in front of two whiskers"
    twist = true                 # optional: false computes whiskers that bend but do not twist, as of old

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
    friction = 0.3               # optional
    velocity_mm_s = [0, -30, 0]  # optional; or spin_deg_s = [0, 0, 90] about its position; or keyframes as for the head

``[[object]]`` at the top level stands in every scene. Other shapes: ``sphere`` (``radius_mm``), ``box``
(``size_mm``), ``capsule`` (``radius_mm``, ``length_mm``), ``rodgers`` (``diagonal_mm``, ``segments``) and
``mesh`` (``path`` relative to the file, ``unit``, ``diagonal_mm``, ``collision`` = "hull" | "exact" | "pieces" |
"decomposition") and ``family:NAME`` for a procedural shape (``seed``, ``diagonal_mm``, ``detail``, ``collision``;
names: ``brainbench stimuli objects``). A decomposition takes ``method`` = "coacd" | "vhacd", ``threshold`` and
``most_pieces``.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from brainbench.core.errors import BrainbenchError, UsageError, repeats
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_toml
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.scenes.motion_tables import read_head_motion, read_whisking
from brainbench.stimuli.scenes.object_tables import PLACE, read_object
from brainbench.stimuli.scenes.scene import Animal, Head, Scene
from brainbench.stimuli.scenes.toml_tables import MILLI, Keys, TomlTable, boolean, mapping, number, tables, text, whole
from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes
from brainbench.stimuli.whiskers.array import WhiskerArray

_NOTHING: Mapping[str, Any] = {}
_FRAMES: Keys = {
    "first": ("first_ms", number(MILLI)),
    "count": ("count", whole),
    "average": ("average", whole),
    "lowpass": ("lowpass_hz", number()),
    "phase": ("phase", text),
    "axes": ("axes", text),
    "clip": ("clip_newton", number()),
}


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
    """
    path = Path(path)
    data = read_toml(path, "scene file")
    try:
        with readable(path, "scene file"):
            return _recipe(path, data, whiskers)
    except BrainbenchError as error:
        raise type(error)(f"{os.fspath(path)}: {error}") from error


def _recipe(path: Path, data: dict[str, Any], whiskers: str) -> Recipe:
    top = TomlTable("the scene file", data)
    description = top.take("description", text, "")
    array = _array(top.table("array"))
    twist = top.take("twist", boolean, True)
    others = tuple(_animal(TomlTable("[[animal]]", item), path.parent) for item in top.take("animal", tables, []))
    shared = {name: top.take(name, mapping, _NOTHING) for name in ("head", "whisking", "frames")}
    common = top.take("object", tables, [])
    entries = top.take("scene", tables, [])
    top.finish()
    if not entries:
        raise UsageError("the file has no [[scene]].")
    whole = [_scene(entry, array, others, shared, common, path.parent) for entry in entries]
    scenes = [replace(scene, twist=twist).select(whiskers) for scene in whole]
    if twice := repeats(scene.label for scene in scenes):
        raise UsageError(f"several scenes have the label {twice[0]!r}; labels must differ.")
    return Recipe(path.stem, description, tuple(scenes))


def _scene(
    entry: Mapping[str, Any],
    array: WhiskerArray,
    others: tuple[Animal, ...],
    shared: Mapping[str, Mapping[str, Any]],
    common: list[Mapping[str, Any]],
    folder: Path,
) -> Scene:
    table = TomlTable("[[scene]]", entry)
    label = table.take("label", text)
    merged = {name: {**shared[name], **table.take(name, mapping, _NOTHING)} for name in ("head", "whisking")}
    objects = [*common, *table.take("object", tables, [])]
    table.finish()
    return Scene(
        label=label,
        array=array,
        objects=tuple(read_object(TomlTable(f"[[object]] of scene {label!r}", item), folder) for item in objects),
        whisking=read_whisking(TomlTable("[whisking]", merged["whisking"]), folder),
        head=_head(TomlTable("[head]", merged["head"])),
        frames=_frames(TomlTable("[frames]", shared["frames"])),
        others=others,
    )


def _animal(table: TomlTable, folder: Path) -> Animal:
    animal = Animal(
        name=table.take("name", text),
        array=_array(table.table("array")),
        whisking=read_whisking(table.table("whisking"), folder),
        head=_head(table.table("head")),
    )
    table.finish()
    return animal


def _array(table: TomlTable) -> WhiskerArray:
    array = table.build(WhiskerArray.of, {"species": ("species", text), "side": ("side", text)})
    for pattern, changes in table.take("replace", mapping, _NOTHING).items():
        array = array.replace(pattern, **mapping(changes))
    array = array.select(table.take("whiskers", text, "all"))
    table.finish()
    return array


def _head(table: TomlTable) -> Head:
    head = table.build(Head, PLACE, motion=read_head_motion(table))
    table.finish()
    return head


def _frames(table: TomlTable) -> Frames:
    given = table.read({"interval": ("interval_ms", number(MILLI)), "rate": ("rate_hz", number())})
    if len(given) > 1:
        raise UsageError("[frames] takes interval_ms or rate_hz, not both.")
    if "rate" in given:
        rate = given.pop("rate")
        if rate <= 0:
            raise UsageError(f"'rate_hz' of [frames] must be positive; received {rate:g}.")
        given["interval"] = 1 / rate
    frames = table.build(Frames, _FRAMES, **given)
    table.finish()
    return frames
