"""What a hand's file names and declares: files in its folder, includes in place, sizes within bounds.

MuJoCo opens whatever a file names and allocates whatever it declares; this looks through the XML first.
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from xml.etree import ElementTree

from brainbench.core.errors import DataError, brief
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
