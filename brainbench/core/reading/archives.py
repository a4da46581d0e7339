"""Archives of arrays: ``.npz`` and safetensors. Nothing in them is ever executed."""

from __future__ import annotations

import math
import os
import zipfile
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, listing, shown
from brainbench.core.reading.hdf5_worker import MOST_EXPANSION, MOST_MEMORY
from brainbench.core.reading.regular import check_file, readable

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray


def read_npz(path: str | os.PathLike[str], kind: str = ".npz file") -> dict[str, NDArray[np.generic]]:
    """Read all arrays of a NumPy archive.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it is no archive, is encrypted or damaged, holds objects, or unpacks to far more than is stored.
    """
    import numpy as np

    found = check_file(path, kind)
    name = shown(os.fspath(path))
    with readable(path, kind):
        with zipfile.ZipFile(found) as archive:
            members = archive.infolist()
            if locked := [item.filename for item in members if item.flag_bits & 1]:
                raise DataError(f"{name} is encrypted ({listing(locked, limit=3)}); save it without a password.")
            unpacked = sum(item.file_size for item in members)
            if unpacked > MOST_MEMORY + MOST_EXPANSION * found.stat().st_size:
                raise DataError(f"{name} unpacks to {unpacked:,} bytes; it is damaged or no {kind}.")
            for item in members:
                _check_header(archive, item, name)
        with np.load(found, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}


def _check_header(archive: zipfile.ZipFile, item: zipfile.ZipInfo, name: str) -> None:
    """Compare the shape that an array declares with the bytes behind it, before memory is taken for it."""
    from numpy.lib import format as npy

    with archive.open(item) as stream:
        version = npy.read_magic(stream)
        shape, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > item.file_size:
        raise DataError(
            f"{shown(item.filename)} in {name} declares {list(shape)} of {dtype}, which its {item.file_size:,} bytes "
            "do not hold as plain numbers; the file is damaged or was made by another program."
        )


def read_tensors(path: str | os.PathLike[str], kind: str = "safetensors file") -> dict[str, torch.Tensor]:
    """Read all tensors of a safetensors file; a weight that is not finite is refused.

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it is damaged, of another format, or holds NaN or infinity.
    """
    from safetensors.torch import load_file

    found = check_file(path, kind)
    with readable(path, kind):
        tensors: dict[str, torch.Tensor] = load_file(found)
    check_finite(tensors, os.fspath(path))
    return tensors


def check_finite(arrays: dict[str, Any], name: str) -> None:
    """Refuse floating-point arrays or tensors with NaN or infinity; the :class:`DataError` names the first."""
    import numpy as np

    for key, values in arrays.items():
        array = values.detach().float().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            bad = int((~np.isfinite(array)).sum())
            raise DataError(f"{shown(key)} in {shown(name)} has {bad:,} of {array.size:,} values that are not finite.")
