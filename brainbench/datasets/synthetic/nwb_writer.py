"""Write valid NWB 2.x files through h5py alone: what the demo recordings need, byte for byte repeatable.

Object identifiers are derived from the file's identifier and the object's path, and no time of writing
is stored, so the same content always gives the same file.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import h5py

NWB_VERSION = "2.7.0"
_SPACE = uuid.UUID("7d8f2c5e-0b58-5c0e-9b0a-3a8d1f0f6c11")

Columns = Mapping[str, tuple[str, Any]]
"""Column name → (description, values); values are an array, or a list of arrays for a ragged column."""


class NwbWriter:
    """Fills an open, empty HDF5 file with one NWB session.

    Args:
        file: file opened for writing.
        identifier: name of the session, unique among files.
        description: session description.
        start: session start, ISO 8601 with time zone.
        general: texts (or lists of texts) under ``/general``, such as experimenter, lab, keywords.
        subject: texts under ``/general/subject``.
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
        self._texts("file_create_date", [start])
        for name, value in (
            ("identifier", identifier),
            ("session_description", description),
            ("session_start_time", start),
            ("timestamps_reference_time", start),
        ):
            self._texts(name, value)
        for name, value in general.items():
            self._texts(f"general/{name}", value)
        self._describe(file.create_group("general/subject"), "core", "Subject")
        for name, value in subject.items():
            self._texts(f"general/subject/{name}", value)

    def module(self, name: str, description: str) -> None:
        """Add an empty processing module."""
        group = self.file.create_group(f"processing/{name}")
        self._describe(group, "core", "ProcessingModule")
        group.attrs["description"] = description

    def table(self, path: str, kind: str, description: str, ids: NDArray[np.int64], columns: Columns) -> None:
        """Add a table, such as ``Units`` or ``TimeIntervals``."""
        group = self.file.create_group(path)
        self._describe(group, "core", kind)
        group.attrs["description"] = description
        group.attrs.create("colnames", list(columns), dtype=_text_type())
        self._describe(group.create_dataset("id", data=ids), "hdmf-common", "ElementIdentifiers")
        for name, (meaning, values) in columns.items():
            ragged = isinstance(values, list)
            dataset = self._array(f"{path}/{name}", np.concatenate(values) if ragged else values)
            self._column(dataset, "VectorData", meaning)
            if ragged:
                # The schema asks for unsigned row ends.
                ends = np.cumsum([len(row) for row in values], dtype=np.uint32)
                index = group.create_dataset(f"{name}_index", data=ends)
                self._column(index, "VectorIndex", f"Index for VectorData '{name}'")
                index.attrs["target"] = dataset.ref

    def events(self, path: str, description: str, times: NDArray[np.float64], values: NDArray[Any]) -> None:
        """Add a time series of coded events at ``times`` (s)."""
        group = self.file.create_group(path)
        self._describe(group, "core", "TimeSeries")
        group.attrs.update({"description": description, "comments": "no comments"})
        data = group.create_dataset("data", data=values)
        data.attrs.update({"conversion": np.float32(1), "resolution": np.float32(-1), "unit": "code"})
        stamps = self._array(f"{path}/timestamps", times)
        stamps.attrs.update({"interval": np.int32(1), "unit": "seconds"})

    def _array(self, path: str, values: NDArray[Any]) -> h5py.Dataset:
        if values.dtype.kind in "UO":
            return self.file.create_dataset(path, data=values.astype(object), dtype=_text_type())
        packed = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if values.size > 1000 else {}
        return self.file.create_dataset(path, data=values, **packed)

    def _column(self, dataset: h5py.Dataset, kind: str, description: str) -> None:
        self._describe(dataset, "hdmf-common", kind)
        dataset.attrs["description"] = description

    def _describe(self, item: h5py.Group | h5py.Dataset, namespace: str, kind: str) -> None:
        item.attrs.update({"namespace": namespace, "neurodata_type": kind})
        item.attrs["object_id"] = str(uuid.uuid5(_SPACE, f"{self.identifier}{item.name}"))

    def _texts(self, path: str, value: str | Sequence[str]) -> None:
        self.file.create_dataset(path, data=value if isinstance(value, str) else list(value), dtype=_text_type())


def _text_type() -> Any:
    import h5py

    return h5py.string_dtype()
