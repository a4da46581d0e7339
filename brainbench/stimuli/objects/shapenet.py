"""Objects from a local ShapeNet tree: ``<synset>/<model>/models/model_normalized.obj`` under one folder.

ShapeNet itself must be obtained from its makers (https://shapenet.org). Its meshes carry no unit and many are open or
inside out: each is repaired as far as possible when it is loaded, and scaled to the diagonal that is asked for.
"""

from __future__ import annotations

import functools
import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, brief, listing, repeats
from brainbench.core.reading.tables import read_rows
from brainbench.core.reading.texts import read_json, read_text
from brainbench.stimuli.objects.mesh_solids import mesh_solid
from brainbench.stimuli.objects.solid import Solid

_LOG = logging.getLogger(__name__)

MESHES = ("models/model_normalized.obj", "model.obj")
"""Paths of a model's mesh below its folder: in ShapeNetCore version 2, and in version 1."""

SYNSETS: dict[str, str] = json.loads(
    resources.files("brainbench.stimuli").joinpath("data", "shapenet_synsets.json").read_text(encoding="utf-8")
)
"""The 55 categories of ShapeNetCore: WordNet 3.0 noun offset and what it means."""


@dataclass(frozen=True)
class ShapeNetModel:
    """One model of the tree."""

    name: str
    """``synset/model``."""
    label: str
    """Class label from the category map."""
    path: Path

    def solid(self, *, diagonal: float = 0.04, **options: Any) -> Solid:
        """Load and repair the mesh; options and errors are those of :func:`~.mesh_solids.mesh_solid`."""
        # The unit cannot matter: the diagonal is set.
        return replace(mesh_solid(self.path, unit="m", diagonal=diagonal, **options), name=self.name)


@dataclass(frozen=True)
class ShapeNet:
    """The models that were asked for and found, and the names of those that were not."""

    root: Path
    models: tuple[ShapeNetModel, ...]
    """In the order of the id list; sorted by name without one."""
    missing: tuple[str, ...] = ()
    """Names of the id list that the tree does not hold."""

    def __iter__(self) -> Iterator[ShapeNetModel]:
        return iter(self.models)

    def __len__(self) -> int:
        return len(self.models)

    @property
    def labels(self) -> tuple[str, ...]:
        """The class labels that occur, sorted."""
        return tuple(sorted({model.label for model in self.models}))

    @property
    def counts(self) -> dict[str, int]:
        """Number of models of each label."""
        return dict(sorted(Counter(model.label for model in self.models).items()))

    def solids(self, **options: Any) -> dict[str, Callable[[], Solid]]:
        """Return, by name, functions that load each model when it is needed, as sweeps take them.

        ``options`` are those of :meth:`ShapeNetModel.solid`.
        """
        return {model.name: functools.partial(model.solid, **options) for model in self.models}


def load_shapenet(
    root: str | os.PathLike[str],
    *,
    ids: str | os.PathLike[str] | Iterable[str] | None = None,
    categories: str | os.PathLike[str] | Mapping[str, str] | None = None,
) -> ShapeNet:
    """Find models in the tree of a folder of synset folders; no mesh is read yet.

    Args:
        root: the folder.
        ids: names ``synset/model`` or a file of them, one a line; every model of the tree when None. Names
            that the tree lacks are listed in :attr:`ShapeNet.missing` and logged.
        categories: class labels by ``synset/model`` (first choice) or by synset, or a file of them (see
            :func:`read_categories`); :data:`SYNSETS` when None. Unlisted synsets are their own labels.
    """
    folder = Path(root)
    if not folder.is_dir():
        raise DataFileNotFoundError(f"There is no ShapeNet folder {os.fspath(root)!r}.")
    if isinstance(ids, (str, os.PathLike)):
        names = read_ids(ids)
    else:
        names = _everything(folder) if ids is None else _checked(ids, "the ids")
    given = read_categories(categories) if isinstance(categories, (str, os.PathLike)) else categories
    labels = SYNSETS if given is None else given
    models, missing = [], []
    for name in names:
        path = next((file for mesh in MESHES if (file := folder / name / mesh).is_file()), None)
        synset = name.partition("/")[0]
        if path is None:
            missing.append(name)
        else:
            models.append(ShapeNetModel(name, labels.get(name, labels.get(synset, synset)), path))
    if not models:
        raise DataError(
            f"{os.fspath(root)!r} holds none of the {len(names)} models asked for, as SYNSET/MODEL/{MESHES[0]};"
            " name the folder that has the synset folders (such as 02691156) in it."
        )
    if missing:
        _LOG.warning("%d of %d ShapeNet models are missing: %s", len(missing), len(names), listing(missing, limit=4))
    return ShapeNet(folder, tuple(models), tuple(missing))


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


def _everything(folder: Path) -> tuple[str, ...]:
    places = {path.relative_to(folder).parts[:2] for mesh in MESHES for path in folder.glob(f"*/*/{mesh}")}
    return tuple("/".join(parts) for parts in sorted(places))


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
