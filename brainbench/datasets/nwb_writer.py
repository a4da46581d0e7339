"""Write sessions as valid NWB 2.x files through h5py alone, byte for byte repeatable.

Object identifiers are derived from the file's identifier and the object's path, and no time of writing
is stored, so the same content always gives the same file.
"""

from __future__ import annotations

import os
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError
from brainbench.core.files import atomic_path
from brainbench.datasets.nwb import STIMULI
from brainbench.datasets.sessions import SPIKES, Session, SessionTable, as_labels

if TYPE_CHECKING:
    import h5py

NWB_VERSION = "2.7.0"
_NO_START = "1970-01-01T00:00:00+00:00"
_SPACE = uuid.UUID("7d8f2c5e-0b58-5c0e-9b0a-3a8d1f0f6c11")

Columns = Mapping[str, tuple[str, Any]]
"""Column name → (description, values); values are an array, or a list of arrays for a ragged column."""

_DESCRIPTIONS = {
    "start_time": "Begin, s.",
    "stop_time": "End, s.",
    "spike_times": "Spike times, s.",
    "obs_intervals": "Recorded spans of each unit, s.",
    "depth": "Depth below the pia, µm.",
    "layer": "Cortical layer.",
    "inhibitory": "Narrow-spiking, putatively inhibitory.",
}
"""Columns that mean the same in every session."""


def write_nwb(
    path: str | os.PathLike[str],
    session: Session,
    *,
    description: str = "Session copied by brainbench: spike times and tables without raw data.",
    general: Mapping[str, str | Sequence[str]] | None = None,
    subject: Mapping[str, str] | None = None,
    columns: Mapping[str, str] | None = None,
) -> Path:
    """Write one session as NWB 2.x, atomically: units, interval tables, and signals that have timestamps.

    That it is synthetic is said in the descriptions and keywords. ``general`` and ``subject`` are further texts under
    ``/general`` and ``/general/subject``; ``columns`` says what columns mean, by name.

    Raises:
        DataError: a spike time is not finite, ids are no integers, or a table has no ``stop_time``, which NWB needs.
    """
    import h5py

    if session.units is None:
        raise DataError(f"{session.source} has no units table; there are no spikes to write.")
    session.units.rows(SPIKES)  # what no reader takes is not written
    made = "SYNTHETIC: " if session.synthetic else ""
    keywords = ["synthetic"] * session.synthetic + ["brainbench"]
    stimuli = {"stimulus": STIMULI + session.stimuli} if session.stimuli else {}
    meanings = _DESCRIPTIONS | dict(columns or {})
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        writer = NwbWriter(
            file,
            identifier=session.identifier or f"{session.subject}-{session.session}",
            description=f"{made}{description}",
            start=session.start or _NO_START,
            general={"session_id": session.session, "keywords": keywords, **stimuli, **(general or {})},
            subject={"subject_id": session.subject, **(subject or {})},
        )
        units = "Units with their spike times."
        writer.table("units", "Units", f"{made}{units}", _ids(session.units), _columns(session.units, meanings))
        for name, table in session.tables.items():
            for column in ("start_time", "stop_time"):
                if column not in table:
                    raise DataError(f"{table.label} has no {column}, which NWB needs; export to .h5 instead.")
            place = f"processing/{name}" if "/" in name else f"intervals/{name}"
            writer.table(place, "TimeIntervals", f"{made}Table {name}.", _ids(table), _columns(table, meanings))
        for name, series in session.series.items():
            if series.timestamps is not None:
                writer.events(name, f"{made}Events {name}.", series.timestamps, series.data)
    return Path(path)


def _columns(table: SessionTable, meanings: Mapping[str, str]) -> Columns:
    columns: dict[str, tuple[str, Any]] = {}
    for name in table.columns:
        values, meaning = np.asarray(table.data[name]), meanings.get(name, name)
        if f"{name}_index" not in table.data:
            columns[name] = (meaning, values)
        elif len(table):
            columns[name] = (meaning, np.split(values, table.ends(name)[:-1]))
    return columns


def _ids(table: SessionTable) -> NDArray[np.int64]:
    ids = as_labels(table.ids())
    try:
        return ids.astype(np.int64)
    except ValueError as error:
        raise DataError(f"{table.label} has ids that are no integers, which NWB needs; export to .h5.") from error


class NwbWriter:
    """Fills an open, empty HDF5 file with one NWB session.

    ``identifier`` is unique among files and ``start`` is ISO 8601 with time zone; ``general`` and ``subject`` are texts
    (or lists of texts) under ``/general`` and ``/general/subject``, such as experimenter, lab, keywords.
    """

    def __init__(
        self,
        file: h5py.File,
        *,
        identifier: str,
        description: str,
        start: str,
        general: Mapping[str, str | Sequence[str]],
        subject: Mapping[str, str],
    ) -> None:
        self.file, self.identifier = file, identifier
        self._describe(file, "core", "NWBFile")
        file.attrs["nwb_version"] = NWB_VERSION
        for name in ("acquisition", "analysis", "processing", "stimulus/presentation", "stimulus/templates"):
            file.create_group(name)
        texts: dict[str, Any] = {"file_create_date": [start], "identifier": identifier}
        texts |= {"session_description": description, "session_start_time": start, "timestamps_reference_time": start}
        texts |= {f"general/{name}": value for name, value in general.items()}
        for name, value in texts.items():
            self._texts(name, value)
        self._describe(file.create_group("general/subject"), "core", "Subject")
        for name, value in subject.items():
            self._texts(f"general/subject/{name}", value)

    def table(self, path: str, kind: str, description: str, ids: NDArray[np.int64], columns: Columns) -> None:
        """Add a table, such as ``Units`` or ``TimeIntervals``."""
        group = self._group(path)
        self._describe(group, "core", kind, description)
        group.attrs.create("colnames", list(columns), dtype=_text_type())
        self._describe(group.create_dataset("id", data=ids), "hdmf-common", "ElementIdentifiers")
        for name, (meaning, values) in columns.items():
            ragged = isinstance(values, list)
            dataset = self._array(f"{path}/{name}", np.concatenate(values) if ragged else values)
            self._describe(dataset, "hdmf-common", "VectorData", meaning)
            if ragged:
                # The schema asks for unsigned row ends.
                ends = np.cumsum([len(row) for row in values], dtype=np.uint32)
                index = group.create_dataset(f"{name}_index", data=ends)
                self._describe(index, "hdmf-common", "VectorIndex", f"Index for VectorData '{name}'")
                index.attrs["target"] = dataset.ref

    def events(self, path: str, description: str, times: NDArray[np.float64], values: NDArray[Any]) -> None:
        """Add a time series of coded events at ``times`` (s)."""
        group = self._group(path)
        self._describe(group, "core", "TimeSeries", description)
        group.attrs["comments"] = "no comments"
        data = group.create_dataset("data", data=values)
        data.attrs.update({"conversion": np.float32(1), "resolution": np.float32(-1), "unit": "code"})
        stamps = self._array(f"{path}/timestamps", times)
        stamps.attrs.update({"interval": np.int32(1), "unit": "seconds"})

    def _group(self, path: str) -> h5py.Group:
        """Make a group, and the processing module around it if it is the first there."""
        root, _, rest = path.partition("/")
        module = rest.partition("/")[0]
        if root == "processing" and f"{root}/{module}" not in self.file:
            made = self.file.create_group(f"{root}/{module}")
            self._describe(made, "core", "ProcessingModule", f"Module {module}.")
        return self.file.create_group(path)

    def _array(self, path: str, values: NDArray[Any]) -> h5py.Dataset:
        if values.dtype.kind in "UO":
            return self.file.create_dataset(path, data=values.astype(object), dtype=_text_type())
        packed = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if values.size > 1000 else {}
        return self.file.create_dataset(path, data=values, **packed)

    def _describe(self, item: h5py.Group | h5py.Dataset, namespace: str, kind: str, description: str = "") -> None:
        item.attrs.update({"namespace": namespace, "neurodata_type": kind})
        item.attrs["object_id"] = str(uuid.uuid5(_SPACE, f"{self.identifier}{item.name}"))
        if description:
            item.attrs["description"] = description

    def _texts(self, path: str, value: str | Sequence[str]) -> None:
        self.file.create_dataset(path, data=value if isinstance(value, str) else list(value), dtype=_text_type())


def _text_type() -> Any:
    import h5py

    return h5py.string_dtype()
