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

from brainbench.core.errors import DataError
from brainbench.core.files import atomic_path
from brainbench.datasets.hdf5 import write_array
from brainbench.datasets.nwb import STIMULI
from brainbench.datasets.sessions import SPIKES, Series, Session, SessionTable, as_labels

if TYPE_CHECKING:
    import h5py

NWB_VERSION = "2.7.0"
_NO_START = "1970-01-01T00:00:00+00:00"
_SPACE = uuid.UUID("7d8f2c5e-0b58-5c0e-9b0a-3a8d1f0f6c11")


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
    """
    import h5py

    if session.units is None:
        raise DataError(f"{session.source} has no units table; there are no spikes to write.")
    session.units.rows(SPIKES)  # what no reader takes is not written
    made = "SYNTHETIC: " if session.synthetic else ""
    identifier, start = session.identifier or f"{session.subject}-{session.session}", session.start or _NO_START
    stated = {"session_id": session.session, "keywords": ["synthetic"] * session.synthetic + ["brainbench"]}
    stated |= {"stimulus": STIMULI + session.stimuli} if session.stimuli else {}
    texts: dict[str, Any] = {"file_create_date": [start], "identifier": identifier}
    texts |= {"session_description": f"{made}{description}"}
    texts |= dict.fromkeys(("session_start_time", "timestamps_reference_time"), start)
    texts |= {f"general/{name}": value for name, value in {**stated, **(general or {})}.items()}
    about = {"subject_id": session.subject, **(subject or {})}
    texts |= {f"general/subject/{name}": value for name, value in about.items()}
    meanings = _DESCRIPTIONS | dict(columns or {})
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        _describe(file, "core", "NWBFile")
        file.attrs["nwb_version"] = NWB_VERSION
        for name in ("acquisition", "analysis", "processing", "stimulus/presentation", "stimulus/templates"):
            file.create_group(name)
        _describe(file.create_group("general/subject"), "core", "Subject")
        for name, value in texts.items():
            file.create_dataset(name, data=value, dtype=h5py.string_dtype())
        _write_table(_group(file, "units", "Units", f"{made}Units with their spike times."), session.units, meanings)
        for name, table in session.tables.items():
            for column in ("start_time", "stop_time"):
                if column not in table:
                    raise DataError(f"{table.label} has no {column}, which NWB needs; export to .h5 instead.")
            place = f"processing/{name}" if "/" in name else f"intervals/{name}"
            _write_table(_group(file, place, "TimeIntervals", f"{made}Table {name}."), table, meanings)
        for name, series in session.series.items():
            if series.timestamps is not None:
                _write_events(_group(file, name, "TimeSeries", f"{made}Events {name}."), series)
        # Every object has an identifier; the file itself is visited by no walk through it.
        file.visititems(lambda _, item: _identify(item, identifier))
        _identify(file, identifier)
    return Path(path)


def _write_table(group: h5py.Group, table: SessionTable, meanings: Mapping[str, str]) -> None:
    """Write the columns of a table; ragged ones of a table without rows are left out."""
    import h5py

    names = [name for name in table.columns if f"{name}_index" not in table.data or len(table)]
    group.attrs.create("colnames", names, dtype=h5py.string_dtype())
    try:
        ids = as_labels(table.ids()).astype(np.int64)
    except ValueError as error:
        raise DataError(f"{table.label} has ids that are no integers, which NWB needs; export to .h5.") from error
    _describe(group.create_dataset("id", data=ids), "hdmf-common", "ElementIdentifiers")
    for name in names:
        values = write_array(group, name, np.asarray(table.data[name]))
        _describe(values, "hdmf-common", "VectorData", meanings.get(name, name))
        if f"{name}_index" in table.data:
            # The schema asks for unsigned row ends.
            index = group.create_dataset(f"{name}_index", data=table.ends(name).astype(np.uint32))
            _describe(index, "hdmf-common", "VectorIndex", f"Index for VectorData '{name}'")
            index.attrs["target"] = values.ref


def _write_events(group: h5py.Group, series: Series) -> None:
    """Write a series of coded events at its timestamps (s)."""
    group.attrs["comments"] = "no comments"
    data = group.create_dataset("data", data=series.data)
    data.attrs.update({"conversion": np.float32(1), "resolution": np.float32(-1), "unit": "code"})
    stamps = write_array(group, "timestamps", series.timestamps)
    stamps.attrs.update({"interval": np.int32(1), "unit": "seconds"})


def _group(file: h5py.File, path: str, kind: str, description: str) -> h5py.Group:
    """Make a group, and the processing module around it if it is the first there."""
    root, _, rest = path.partition("/")
    module = rest.partition("/")[0]
    if root == "processing" and f"{root}/{module}" not in file:
        _describe(file.create_group(f"{root}/{module}"), "core", "ProcessingModule", f"Module {module}.")
    group = file.create_group(path)
    _describe(group, "core", kind, description)
    return group


def _describe(item: h5py.Group | h5py.Dataset, namespace: str, kind: str, description: str = "") -> None:
    item.attrs.update({"namespace": namespace, "neurodata_type": kind})
    if description:
        item.attrs["description"] = description


def _identify(item: h5py.Group | h5py.Dataset, identifier: str) -> None:
    """Derive the identifier of an NWB object from that of the file and the object's path."""
    if "neurodata_type" in item.attrs:
        item.attrs["object_id"] = str(uuid.uuid5(_SPACE, f"{identifier}{item.name}"))
