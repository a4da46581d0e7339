"""Files of hands: what MuJoCo reads of a URDF or MJCF file, mended where authors leave something open.

MuJoCo opens whatever a file names and allocates whatever it declares, so the XML is looked through first: files in its
folder, includes in place, sizes within bounds.
"""

from __future__ import annotations

import logging
import math
import os
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError, brief, listing
from brainbench.core.reading.regular import part_of, readable
from brainbench.core.reading.texts import read_text

KIND = "hand file (URDF or MJCF)"
_NAMES = {"name", "class", "childclass", "joint", "body", "link", "geom", "site", "mesh", "material", "file"}
"""Attributes of URDF and MJCF that hold words."""
_LARGEST = 1e15  # magnitude of numbers in a hand's file that no hand has
_DEEPEST = 32  # includes within one another
_FOLDERS = ("meshdir", "texturedir", "assetdir")
MOST_SAMPLES = 1 << 24  # samples of a height field or picture
MOST_COPIES = 10_000
"""Copies of an element, within one another together; also points of a flexible body and entries of tables."""
MOST_ARENA = 1 << 30  # bytes that a file may ask for contacts and constraints
_SUFFIXES = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40, "P": 1 << 50, "E": 1 << 60}
_COUNTED = ("replicate", "composite", "flexcomp", "grid")
_TABLES = re.compile(r"n(user|key|uspare|user_\w+)?(data)?")


def checked_xml(path: Path, route: tuple[Path, ...] = ()) -> ElementTree.Element:
    """Return the root element of a hand's file with included files in place.

    Files that it names are regular ones of its folder or the one above, numbers are finite, sizes within bounds; what
    is not is a :class:`DataError`, as is a file that includes itself; ``route`` holds those that led to it.
    """
    root = _included(path, path.parent, route)
    with readable(path, KIND):
        folders = {path.parent}
        for compiler in root.iter("compiler"):
            folders |= {path.parent / compiler.get(name, "") for name in _FOLDERS}
        for element in root.iter():
            for key, name in element.attrib.items():
                if key.startswith("file") and name:
                    _check_named(path, name, folders, element.tag)
            model = path.parent / element.get("file", "")
            if element.tag == "model" and model.is_file():
                checked_xml(model, (*route, path.resolve()))
        _check_sizes(root, path, 1)
    return root


def _included(path: Path, folder: Path, route: tuple[Path, ...]) -> ElementTree.Element:
    """Return the root element of a file with included ones in place; numbers that no hand has are refused."""
    if path.resolve() in route or len(route) > _DEEPEST:
        raise DataError(f"{brief(str(path))} includes itself, or files more than {_DEEPEST} deep.")
    text = read_text(path, KIND)
    with readable(path, KIND):
        root = ElementTree.fromstring(text)
        for parent in [*root.iter()]:
            for place, element in reversed([*enumerate(parent)]):
                if element.tag == "include":
                    # From the folder of the main file, else from that of the file which includes it.
                    name = element.get("file", "")
                    place_of = part_of(folder if os.path.lexists(folder / name) else path.parent, name, KIND)
                    parent[place : place + 1] = list(_included(place_of, folder, (*route, path.resolve())))
            for key, value in parent.items():
                for word in value.split() if key not in _NAMES else ():
                    if _is_absurd(word):
                        raise DataError(
                            f"{key!r} of <{brief(parent.tag, quoted=False)}> in {brief(str(path))} is {brief(value)}; "
                            f"finite numbers of at most {_LARGEST:g} are needed."
                        )
    return root


def _check_named(path: Path, name: str, folders: set[Path], tag: str) -> None:
    """Refuse a file that is named if any place that it may be looked for has no regular file; a missing one passes."""
    # ROS names the package first; MuJoCo drops folders on request.
    plain = re.sub(r"^\w+://[^/]*/?", "", name)
    for folder in folders:
        for wanted in {name, plain, Path(plain).name}:
            if os.path.lexists(folder / wanted):
                inner = os.path.relpath(folder / wanted, path.parent) if not Path(wanted).is_absolute() else wanted
                part_of(path.parent, inner, f"file of <{brief(tag, quoted=False)}>")


def _check_sizes(element: ElementTree.Element, path: Path, copies: int) -> None:
    """Refuse sizes that a file declares beyond what any hand has, before they are allocated."""
    sides = {name: _whole(element.get(name, "")) for name in ("nrow", "ncol", "width", "height")}
    samples = max(math.prod(sides[name] for name in pair) for pair in (("nrow", "ncol"), ("width", "height")))
    count = math.prod(map(_whole, element.get("count", "1").split())) if element.tag in _COUNTED else 1
    copies *= count
    tables = max((_whole(value) for key, value in element.items() if _TABLES.fullmatch(key)), default=1)
    limits = ((samples, MOST_SAMPLES, "samples"), (copies, MOST_COPIES, "copies"), (tables, MOST_ARENA >> 8, "entries"))
    memory = re.fullmatch(r"(\d+)([KMGTPE]?)", element.get("memory", "").strip(), re.IGNORECASE)
    if memory is not None:
        limits += ((int(memory[1][:20]) * _SUFFIXES[memory[2].upper()], MOST_ARENA, "bytes"),)
    for size, most, what in limits:
        if size > most:
            where = f"<{brief(element.tag, quoted=False)}> in {brief(str(path))}"
            raise DataError(f"{where} declares {min(size, 10**18):,} {what}; at most {most:,} are read.")
    for child in element:
        _check_sizes(child, path, copies)


def _whole(text: str) -> int:
    """Return a count in a text; 1 for anything else, which MuJoCo refuses."""
    try:
        return max(1, min(int(float(text)), 10**18))
    except (ValueError, OverflowError):
        return 1


def _is_absurd(word: str) -> bool:
    try:
        return not abs(float(word)) <= _LARGEST
    except ValueError:
        return False


_log = logging.getLogger(__name__)

_DEFAULTED = ("geom", "joint", "site", "actuator", "tendon", "equality", "pair")
"""Elements that a scene may add to a hand."""
_IDENTITY = {"classname", "compiler", "default", "frame", "id", "info", "name", "parent", "path", "plugin", "signature"}
"""Attributes of an element that say which one it is, not what it is like."""


def read_mjspec(path: Path) -> Any:
    """Read a URDF or MJCF file.

    Meshes for display only are dropped (their files are often absent), degenerate and unbalanced inertias are
    corrected, mesh paths given from the file's own folder are found too, bodies and joints without a name are numbered,
    a hand that floats is fixed, and the file's defaults hold for its own elements alone.
    """
    mujoco = mujoco_module()
    folder, root = path.parent, checked_xml(path)
    with readable(path, "URDF or MJCF file"):
        if path.suffix not in (".urdf", ".xml"):
            # MuJoCo chooses how to read a file by its ending, and has no reader for .mjcf, .URDF and .XML.
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
            spec.modelfiledir = str(folder)
        else:
            spec = mujoco.MjSpec.from_file(str(path))
        files = [mesh.file for mesh in spec.meshes if mesh.file]
    if any(not (folder / spec.meshdir / name).exists() and (folder / name).exists() for name in files):
        spec.meshdir = ""
    if path.suffix.lower() == ".urdf":
        spec.compiler.discardvisual = True
        # Fixed links join their parents, as their solids should; a sensor keeps the palm from joining the world.
        if (base := spec.worldbody.first_body()) is None:
            raise DataError(f"{str(path)!r} holds no hand: it has no links.")
        kinds = {"type": mujoco.mjtSensor.mjSENS_FRAMEPOS, "objtype": mujoco.mjtObj.mjOBJ_BODY}
        spec.add_sensor(name="palm_pose", objname=base.name, **kinds)
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        # A hand that floats in its file is held by what it is put on; its keyframes would have other sizes.
        if len(joint.parent.find_all(mujoco.mjtObj.mjOBJ_JOINT)) > 1:
            for element in (joint, *spec.keys):
                spec.delete(element)
    for kind, elements in (("link", spec.bodies), ("joint", spec.joints)):
        for number, element in enumerate(elements):
            element.name = element.name or f"{kind}{number}"
    spec.compiler.boundmass = max(spec.compiler.boundmass, 1e-6)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, 1e-9)
    _balance_inertias(spec, path)
    clear_defaults(spec)
    return spec


def clear_defaults(spec: Any) -> None:
    """Reset the main ``<default>`` of a ``mujoco.MjSpec``, so that what is added later is as it is written.

    Elements took their defaults when they were read; without this, a default of a hand's file (such as ``contype=0`` or
    ``gear=3``) would also change the drives and objects that a scene adds to it.
    """
    plain = mujoco_module().MjSpec()
    for kind in _DEFAULTED:
        target, source = getattr(spec.default, kind), getattr(plain.default, kind)
        for name in (name for name in dir(source) if not name.startswith("_") and name not in _IDENTITY):
            value = getattr(source, name)
            if not callable(value):
                setattr(target, name, value)


def _balance_inertias(spec: Any, path: Path) -> None:
    """Let the compiler balance inertias that no body can have, and name their links."""
    unbalanced = []
    for body in (body for body in spec.bodies if body.explicitinertial):
        xx, yy, zz, xy, xz, yz = body.fullinertia
        full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = np.sort(body.inertia if np.isnan(full).any() else np.linalg.eigvalsh(full))
        if moments[0] < -1e-9 * abs(moments[2]):
            raise DataError(
                f"The inertia of link {brief(body.name)} in {brief(str(path))} has the principal moments "
                f"{', '.join(f'{moment:.3g}' for moment in moments)} kg·m²; none may be below 0."
            )
        # Of any distribution of mass, two principal moments together reach the third.
        if moments[0] + moments[1] < moments[2] * (1 - 1e-9):
            unbalanced.append(body.name)
    if unbalanced:
        spec.compiler.balanceinertia = True
        _log.warning(
            "Hand %s has inertias that no body can have (two principal moments together are less than the third) on %s;"
            " each is replaced by its mean.", brief(path.stem), listing(unbalanced),
        )  # fmt: skip


def stated_speeds(path: Path) -> dict[str, float]:
    """Return joint → largest speed (rad/s or m/s) of a URDF file, which MuJoCo does not keep; 0 states none."""
    if path.suffix.lower() != ".urdf":
        return {}
    with readable(path, "URDF or MJCF file"):
        root = ElementTree.fromstring(read_text(path, KIND))
        limits = {joint.get("name", ""): joint.find("limit") for joint in root.iter("joint")}
        speeds = {name: float(limit.get("velocity", 0)) for name, limit in limits.items() if limit is not None}
    return {name: speed for name, speed in speeds.items() if speed > 0}
