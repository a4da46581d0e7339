"""HDF5 files that are written as a whole or not at all; what is wrong is told in one sentence."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, brief
from brainbench.core.files import atomic_path

if TYPE_CHECKING:
    import h5py


class _Disk(io.FileIO):
    """A file that notes why it cannot be written and says nothing: the library prints and crashes over a full disk."""

    fault: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while len(rest) and self.fault is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.fault = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.fault = self.fault or error
            return size or 0


@contextlib.contextmanager
def create_hdf5(path: str | os.PathLike[str], **options: Any) -> Iterator[h5py.File]:
    """Yield a new HDF5 file that replaces ``path`` when the block ends; ``options`` are those of ``h5py.File``.

    Raises:
        FileWriteError: the folder cannot be written, or the disk is full.
    """
    import h5py

    with atomic_path(path) as temporary, _Disk(temporary, "r+") as disk:
        try:
            with h5py.File(disk, "w", **options) as file:
                yield file
        except ValueError as error:
            if "embedded NULL" not in str(error):
                raise
            name = brief(os.fspath(path))
            raise DataError(f"{name} cannot hold a text with the character NUL; take it out of the names.") from error
        finally:
            if disk.fault is not None:
                raise disk.fault
