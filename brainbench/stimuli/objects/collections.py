"""Named, labelled objects that are built when they are needed: what ``--objects`` of a sweep names."""

from __future__ import annotations

import functools
import glob
import itertools
import json
import logging
import math
import os
import re
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import numpy as np

from brainbench.core.errors import (
    DataError,
    DataFileNotFoundError,
    UsageError,
    brief,
    check_number,
    listing,
    repeats,
    unknown_name,
)
from brainbench.core.files import file_hash
from brainbench.core.reading.regular import readable
from brainbench.core.reading.tables import read_rows
from brainbench.core.reading.texts import read_json, read_text
from brainbench.geometry import Mesh
from brainbench.stimuli.objects.procedural import DETAIL, describe_family, list_families, make
from brainbench.stimuli.objects.solid import Solid, mesh_solid, shape_solid

_LOG = logging.getLogger(__name__)

MESHES = ("models/model_normalized.obj", "model.obj")
"""Paths of a model's mesh below its folder: in ShapeNetCore version 2, and in version 1."""

SYNSETS: dict[str, str] = json.loads(
    resources.files("brainbench.stimuli").joinpath("data", "shapenet_synsets.json").read_text(encoding="utf-8")
)
"""The 55 categories of ShapeNetCore: WordNet 3.0 noun offset and what it means."""


DIAGONAL = 0.04  # size [m] at which objects are built; each sweep scales them to its own


@dataclass(frozen=True)
class NamedObject:
    """One object of a collection; it can be sent to another process and is built there."""

    name: str
    label: str
    """Class label."""
    source: str
    """Description of what it is made from: equal sources make equal objects."""
    load: Callable[[], Solid]


def load_shapenet(
    root: str | os.PathLike[str],
    *,
    ids: str | os.PathLike[str] | Iterable[str] | None = None,
    categories: str | os.PathLike[str] | Mapping[str, str] | None = None,
    collision: str = "hull",
) -> dict[str, NamedObject]:
    """Return, by name, the models in the tree of a folder of synset folders; no mesh is read yet.

    Args:
        root: the folder.
        ids: names ``synset/model`` or a file of them, one a line, in their order; every model of the tree, sorted by
            name, when None. Names that the tree lacks are logged.
        categories: class labels by ``synset/model`` (first choice) or by synset, or a file of them (see
            :func:`read_categories`); :data:`SYNSETS` when None. Unlisted synsets are their own labels.
        collision: as for :func:`brainbench.stimuli.objects.solid.mesh_solid`.
    """
    folder = Path(root)
    if not folder.is_dir():
        raise DataFileNotFoundError(f"There is no ShapeNet folder {os.fspath(root)!r}.")
    if isinstance(ids, (str, os.PathLike)):
        names = read_ids(ids)
    elif ids is None:
        places = {path.relative_to(folder).parts[:2] for mesh in MESHES for path in folder.glob(f"*/*/{mesh}")}
        names = tuple("/".join(parts) for parts in sorted(places))
    else:
        names = _checked(ids, "the ids")
    given = read_categories(categories) if isinstance(categories, (str, os.PathLike)) else categories
    labels = SYNSETS if given is None else given
    models: dict[str, NamedObject] = {}
    missing = []
    for name in names:
        path = next((file for mesh in MESHES if (file := folder / name / mesh).is_file()), None)
        synset = name.partition("/")[0]
        if path is None:
            missing.append(name)
        else:
            load = functools.partial(_load_model, name, path, collision)
            label = labels.get(name, labels.get(synset, synset))
            models[name] = NamedObject(name, label, f"shapenet {name}, {collision}", load)
    if not models:
        raise DataError(
            f"{os.fspath(root)!r} holds none of the {len(names)} models asked for, as SYNSET/MODEL/{MESHES[0]};"
            " name the folder that has the synset folders (such as 02691156) in it."
        )
    if missing:
        _LOG.warning("%d of %d ShapeNet models are missing: %s", len(missing), len(names), listing(missing, limit=4))
    return models


def _load_model(name: str, path: Path, collision: str) -> Solid:
    # The unit cannot matter: the diagonal is set.
    return replace(mesh_solid(path, unit="m", diagonal=DIAGONAL, collision=collision), name=name)


def read_ids(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Read names ``synset/model``, one a line; empty lines and lines from ``#`` on are skipped."""
    lines = [line.partition("#")[0].strip() for line in read_text(path).splitlines()]
    return _checked((line for line in lines if line), repr(os.fspath(path)))


def read_categories(path: str | os.PathLike[str]) -> dict[str, str]:
    """Read class labels by synset or by ``synset/model``.

    A ``.json`` file holds one object of texts; any other file is CSV with two columns, name and label, a
    header line being allowed.
    """
    if Path(path).suffix == ".json":
        data = read_json(path)
        if not isinstance(data, dict) or not all(isinstance(label, str) for label in data.values()):
            raise DataError(f"{os.fspath(path)!r} must be one JSON object from names to labels (texts).")
        return data
    rows = read_rows(path, "table of categories")
    for number, row in enumerate(rows, start=1):
        if len(row) != 2:
            raise DataError(
                f"Row {number} of {os.fspath(path)!r} must be a name and a label; it is {brief(','.join(row))}."
            )
    return {name: label for name, label in rows if _is_name(name.partition("/")[0])}


def _checked(names: Iterable[str], where: str) -> tuple[str, ...]:
    checked = tuple(names)
    for name in checked:
        synset, slash, model = name.partition("/")
        if not (slash and _is_name(synset) and model) or "/" in model or model in (".", ".."):
            raise UsageError(
                f"A ShapeNet model is named SYNSET/MODEL, such as 02691156/1a04e3; {where} has {brief(name)}."
            )
    if twice := repeats(checked):
        raise UsageError(f"ShapeNet models occur twice in {where}: {listing(twice, limit=4)}.")
    return checked


def _is_name(synset: str) -> bool:
    return len(synset) == 8 and synset.isdigit()


PROCEDURAL_24 = (
    "arch", "basket", "bolt", "bottle", "bowl", "brick", "chair", "cone", "cross", "cylinder", "dumbbell", "ellipsoid",
    "gear", "hammer", "horseshoe", "house", "jack", "mug", "mushroom", "pyramid", "spring", "stairs", "table", "torus",
)  # fmt: skip
"""The 24 families of the collection ``procedural-24``: everyday and elementary shapes that differ at first touch."""

COLLECTIONS = {"procedural-24": PROCEDURAL_24, "procedural": list_families()}
"""Named collections of shape families; ``procedural-24:40`` is 40 members of each of its 24 families."""

MOST_CHARACTERS = 4096  # most characters of the name of an object: as many as a path may have
MOST_MEMBERS = 1_000_000  # most members of a family in one data set
SURFACE = "surface"
"""Stands for ``surfaces`` where shape families are built; other kinds of objects have their default then."""


def resolve_objects(
    texts: Iterable[str], *, unit: str | None = None, collision: str | None = None, surfaces: bool = False
) -> dict[str, NamedObject]:
    """Return, by name, the objects that some words name. Nothing is built and no mesh is read.

    Args:
        texts: each one of: a shape family (``torus``), a member of it (``torus-3``) or its first members
            (``torus:20``, seeds 0 to 19); a collection (``procedural-24:40``: so many members of each family, of
            2,000 to 20,000 triangles); ``shapenet:FOLDER`` or ``shapenet:FOLDER:100`` (the first 100 models of a
            ShapeNet tree); a mesh file, or a pattern of mesh files (``meshes/*.obj``). A file's class is its
            folder's name when its pattern spans several folders, otherwise its own name.
        unit, collision: as for :func:`brainbench.stimuli.objects.solid.mesh_solid`; each kind of object has a
            collision geometry by default.
        surfaces: build shape families as their exact surface alone, without convex parts, which takes tens of
            milliseconds instead of a second; for engines that collide meshes. Not with ``collision``.
    """
    named_objects: dict[str, NamedObject] = {}
    collision = SURFACE if surfaces and collision is None else collision
    for text in texts:
        for body in _resolve(text, unit, collision):
            if body.name in named_objects:
                raise UsageError(f"Several objects have the same name, {body.name!r}; name each object once.")
            named_objects[body.name] = body
    if not named_objects:
        raise UsageError("There is no object; name a family (torus), a collection (procedural-24:40) or a mesh file.")
    return named_objects


def _resolve(text: str, unit: str | None, collision: str | None) -> Iterator[NamedObject]:
    of_meshes = "hull" if collision in (None, SURFACE) else collision
    if text.startswith("shapenet:"):
        yield from _shapenet(text.removeprefix("shapenet:"), of_meshes)
        return
    if len(text) > MOST_CHARACTERS:
        raise UsageError(f"An object is named in at most {MOST_CHARACTERS:,} characters; received {brief(text)}.")
    if _is_file(text) or glob.has_magic(text):
        yield from _files(text, unit, of_meshes)
        return
    name, _, number = text.partition(":")
    if number and not (number.isdecimal() and 0 < int(number) <= MOST_MEMBERS):
        raise UsageError(
            f"The number of members in {brief(text)} is a whole number from 1 to {MOST_MEMBERS:,}, as in torus:20."
        )
    count = int(number or 1)
    if name in COLLECTIONS:
        for family in COLLECTIONS[name]:
            yield from (_member(family, seed, _detail(family, seed), collision) for seed in range(count))
        return
    family, seed = (hit[1], int(hit[2])) if (hit := re.fullmatch(r"(.+)-(\d+)", name)) else (name, None)
    if family not in list_families():
        hint = "Or a mesh file, a pattern of files in quotes, or shapenet:FOLDER."
        raise unknown_name("object", name, [*list_families(), *COLLECTIONS], hint=hint)
    if seed is not None and number:
        raise UsageError(
            f"{text!r} names one member and a number of members; write {family}-{seed} or {family}:{count}."
        )
    for chosen in range(count) if seed is None else (seed,):
        yield _member(family, chosen, 4_000, collision)


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except (OSError, ValueError):  # longer than a name may be, or no name at all
        return False


def _member(family: str, seed: int, detail: int, collision: str | None) -> NamedObject:
    describe_family(family)
    source = f"shape {family} {seed}, {detail} triangles, {collision or 'default'}"
    return NamedObject(f"{family}-{seed}", family, source, functools.partial(_make, family, seed, detail, collision))


def _make(family: str, seed: int, detail: int, collision: str | None) -> Solid:
    shape = make(family, seed, detail=detail)
    if collision != SURFACE:
        return shape_solid(shape, diagonal=DIAGONAL, collision=collision)
    mesh = Mesh(shape.mesh.vertices, shape.mesh.faces, f"{family}-{seed}")
    return Solid(mesh.name, (), mesh, (), {"mesh": mesh.content_hash}, mesh).to_diagonal(DIAGONAL)


def _detail(family: str, seed: int) -> int:
    """Return the triangles of a member, drawn evenly on a logarithmic scale within the range that shapes allow."""
    generator = np.random.default_rng([zlib.crc32(b"detail"), zlib.crc32(family.encode()), seed])
    low, high = DETAIL
    return int(math.exp(generator.uniform(math.log(low), math.log(high))))


def _files(pattern: str, unit: str | None, collision: str) -> Iterator[NamedObject]:
    given = Path(pattern)
    # In alphabetical order; ``**`` stands for any number of folders.
    with readable(pattern, "pattern of mesh files"):
        below = str(given.relative_to(given.anchor))
        matches = [given] if _is_file(pattern) else sorted(Path(given.anchor or ".").glob(below))
        paths = [path for path in matches if path.is_file()]
    if not paths:
        raise DataFileNotFoundError(f"No mesh file matches {brief(pattern)}.")
    if unit is None:
        raise UsageError(f"The length unit of {brief(pattern)} is not in the file; say it with --unit (m, cm, mm, …).")
    several = len({path.parent for path in paths}) > 1
    for path in paths:
        label = path.parent.name if several else path.stem
        source = f"mesh {file_hash(path)} in {unit}, {collision}"
        load = functools.partial(mesh_solid, path.absolute(), unit=unit, collision=collision)
        yield NamedObject(f"{label}/{path.stem}" if several else path.stem, label, source, load)


def _shapenet(text: str, collision: str) -> Iterator[NamedObject]:
    folder, _, number = text.rpartition(":") if re.search(r":\d+$", text) else (text, "", "")
    models = load_shapenet(Path(folder).absolute(), collision=collision).values()
    check_number(f"The number of models of {folder!r}", int(number or 0), most=len(models), whole=True)
    yield from itertools.islice(models, int(number) if number else None)
