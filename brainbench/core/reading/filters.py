"""Filters of HDF5 that compress arrays: one that this installation lacks is named with the package that brings it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, brief

if TYPE_CHECKING:
    import h5py

NAMES = {32001: "Blosc", 32004: "LZ4", 32008: "bitshuffle", 32013: "ZFP", 32015: "Zstandard", 32026: "Blosc2"}
"""Registered filters that laboratories use."""


class MissingFilterError(DataError):
    """An array is compressed by a filter that this installation lacks."""


@contextlib.contextmanager
def naming_filters(file: h5py.File, path: str | os.PathLike[str]) -> Iterator[None]:
    """Say which filter is missing where an array of an open file cannot be unpacked inside the block."""
    try:
        yield
    except OSError as error:
        if (need := file.visititems(_need)) is None:
            raise
        raise MissingFilterError(f"{brief(os.fspath(path))} {need}: pip install hdf5plugin.") from error


def _need(name: str, node: Any) -> str | None:
    from h5py import Dataset, h5z  # pyright: ignore[reportAttributeAccessIssue]

    create = node.id.get_create_plist() if isinstance(node, Dataset) else None
    codes = [create.get_filter(place)[0] for place in range(create.get_nfilters())] if create else []
    lacking = [code for code in codes if not h5z.filter_avail(code)]
    title = f" ({NAMES[lacking[0]]})" if lacking and lacking[0] in NAMES else ""
    return f"needs the HDF5 filter {lacking[0]}{title} to read {brief(name)}" if lacking else None
