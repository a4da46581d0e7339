"""RDMs in files of ``rsatoolbox``: written of animals, read to be looked at and compared.

Such a file holds dissimilarities and no trials, so nothing in it says how reliable they are.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_labels
from brainbench.core.errors import DataError, listing, repeats
from brainbench.core.files import create_hdf5
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.datasets.hdf5 import as_ascii
from brainbench.datasets.sessions import decode, text

LABELS, NAMES = "stimulus", "subject"  # descriptors by which we call stimuli and RDMs


@dataclass(frozen=True)
class StoredRDMs:
    """Dissimilarities of the same stimuli, as of several animals."""

    values: NDArray[np.float64] = field(repr=False)
    """[R, P] upper triangles row by row; NaN where missing."""
    stimuli: tuple[str, ...]
    names: tuple[str, ...]
    """[R] one of each RDM."""
    measure: str = ""
    """Dissimilarity of two stimuli."""
    columns: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    """What else is known of each RDM: name → [R]."""
    about: Mapping[str, str] = field(default_factory=dict)
    """What is known of all of them."""
    note: str = ""
    """How the stimuli were named, where the file leaves a choice."""

    @property
    def contents(self) -> dict[str, str]:
        """What the file holds, in short."""
        lists = {"stimuli": self.stimuli, "RDMs": self.names, **self.columns}
        texts = {name: listing(map(str, values), limit=12, quoted=False) for name, values in lists.items()}
        return texts | {"! no trials": "noise cannot be estimated, so there is no score; recordings compare needs none"}


def is_rdms(file: h5py.File) -> bool:
    """Return whether an open HDF5 file holds RDMs of rsatoolbox."""
    return {"dissimilarities", "pattern_descriptors", "rdm_descriptors"} <= {*file}


class HoldsRDMsError(DataError):
    """A file where recordings were expected holds RDMs, ``rdms``."""

    rdms: StoredRDMs


def read_rdms(path: str | os.PathLike[str]) -> StoredRDMs | None:
    """Return the RDMs of a file; None of any other HDF5 file. ``stimulus`` names the stimuli, else the only text that
    differs for all of them, else their number.
    """
    with open_hdf5(path, "file of RDMs") as file:
        return rdms_of(file, path) if is_rdms(file) else None


def rdms_of(file: h5py.File, path: str | os.PathLike[str]) -> StoredRDMs:
    """Return the RDMs of an open file."""
    node: Any = file["dissimilarities"]
    values: Any = np.asarray(node[...]) if hasattr(node, "dtype") else np.zeros(0)
    if values.ndim != 2 or values.dtype.kind not in "fiu" or not values.size:
        raise DataError(f"{path} has dissimilarities of the shape {list(values.shape)}; expected [RDMs, pairs].")
    patterns, rdms = (_descriptors(file[f"{name}_descriptors"]) for name in ("pattern", "rdm"))
    about = _descriptors(file["descriptors"]) if "descriptors" in file else {}
    measure = text(file.attrs.get("dissimilarity_measure", ""))
    number = round((1 + np.sqrt(1 + 8 * values.shape[1])) / 2)
    if number * (number - 1) // 2 != values.shape[1] or number < 3:
        raise DataError(f"{path} has {values.shape[1]} dissimilarities in an RDM, which are no pairs of three or more.")
    for names, size, what in ((patterns, number, "stimuli"), (rdms, len(values), "RDMs")):
        for name, entries in names.items():
            if len(entries) != size:
                raise DataError(f"The descriptor {name!r} of {path} has {len(entries)} values for {size} {what}.")
    labels, note = _names(patterns, LABELS, number)
    names = _names(rdms, NAMES, len(values))[0]
    if repeats(animals := as_labels(rdms.get(NAMES, ())).tolist()):  # several sessions of an animal, say
        names = tuple(f"{name} ({animals[: place + 1].count(name)})" for place, name in enumerate(animals))
    columns = {name: entries for name, entries in rdms.items() if name not in ("index", NAMES)}
    parts = {name: np.ravel(entries).tolist() for name, entries in about.items()}
    stated = {
        name: listing(map(str, entries), limit=8, quoted=False) if entries else "" for name, entries in parts.items()
    }
    if np.isinf(values).any():
        raise DataError(f"{path} has infinite dissimilarities; NaN stands for a missing one.")
    return StoredRDMs(values.astype(np.float64), labels, names, measure, columns, stated, note)


def write_rdms(path: str | os.PathLike[str], rdms: StoredRDMs) -> Path:
    """Write RDMs as ``rsatoolbox.rdm.load_rdm`` reads them."""
    with create_hdf5(path) as file:
        file["dissimilarities"] = rdms.values
        file.attrs["dissimilarity_measure"] = rdms.measure
        groups = {
            "pattern_descriptors": {LABELS: rdms.stimuli, "index": range(len(rdms.stimuli))},
            "rdm_descriptors": {NAMES: rdms.names, **rdms.columns, "index": range(len(rdms.names))},
        }
        for place, columns in groups.items():
            group = file.create_group(place)
            for name, entries in columns.items():
                group[name] = as_ascii(entries, name, "a file of rsatoolbox")
        file.create_group("descriptors").attrs.update(rdms.about)
    return Path(path)


def _descriptors(group: Any) -> dict[str, list[Any]]:
    """Return the descriptors of a group, each a list; a text stands in an attribute, an uneven list in a group."""
    columns: dict[str, list[Any]] = {name: [text(value)] for name, value in group.attrs.items()}
    for name, node in group.items():
        parts = [node[str(place)] for place in range(len(node))] if hasattr(node, "keys") else [node]
        values = [decode(np.atleast_1d(part[...])).tolist() for part in parts if part.shape is not None]
        columns[name] = values[0] if len(parts) == 1 and values else [str(entry) for entry in values]
    return columns


def _names(columns: Mapping[str, list[Any]], wanted: str, number: int) -> tuple[tuple[str, ...], str]:
    """Return a name for each of so many, and a note where others would do."""
    flat = {name: np.array(values) for name, values in columns.items() if name != "index"}
    labels = {name: tuple(as_labels(values).tolist()) for name, values in flat.items() if values.ndim == 1}
    distinct = {name: texts for name, texts in labels.items() if all(texts) and not repeats(texts)}
    texts = [name for name in distinct if np.array(columns[name]).dtype.kind == "U"]
    chosen = wanted if wanted in distinct else next(iter(sorted(texts) or sorted(distinct)), None)
    if chosen is None:
        note = f"stimuli are numbered, since {listing(labels)} does not tell all of them apart" if labels else ""
        return tuple(map(str, range(1, number + 1))), note
    others = sorted({*texts} - {chosen})
    note = f"stimuli are called by {chosen!r} of {listing([chosen, *others])}" if others and chosen != wanted else ""
    if wanted in {*labels} - {*distinct}:
        note = f"stimuli are called by {chosen!r}, since {wanted!r} does not tell all of them apart"
    return distinct[chosen], note
