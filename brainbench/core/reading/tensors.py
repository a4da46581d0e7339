"""Arrays (``.npz``) and weights: safetensors, and the files of PyTorch without the code that they may hold.

Archives that are encrypted, declare more than they store or hold objects are refused; weights are finite.
"""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, brief, listing, repeats
from brainbench.core.reading.hdf5_worker import MOST_EXPANSION, MOST_MEMORY
from brainbench.core.reading.regular import check_file, readable

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import NDArray


def read_npz(path: str | os.PathLike[str], kind: str = ".npz file") -> dict[str, NDArray[np.generic]]:
    """Read all arrays of a NumPy archive."""
    import numpy as np

    file = check_file(path, kind)
    with readable(path, kind):
        with file.open("rb") as stream:
            head = stream.read(2)
        if not zipfile.is_zipfile(file):
            why = "empty" if not head else "truncated; copy it again" if head == b"PK" else "no zip archive"
            raise DataError(f"{brief(os.fspath(path))} is not an .npz file, which a {kind} is: it is {why}.")
        with zipfile.ZipFile(file) as archive:
            check_archive(archive, path, kind)
        with np.load(file, allow_pickle=False) as stored:
            return {key: _array(stored, key, f"{os.fspath(path)}:{key}") for key in stored.files}


def _array(stored: Mapping[str, Any], key: str, name: str) -> NDArray[np.generic]:
    """Return an array of an archive; NumPy itself refuses objects, and more than is stored."""
    with readable(name, "array"):
        try:
            array = stored[key]
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
            raise DataError(
                f"{brief(name)} holds Python objects, which are never loaded: they could run code."
            ) from error
    if not hasattr(array, "dtype"):
        raise DataError(f"{brief(name)} is no array, or it is damaged.")
    return array


def check_archive(archive: zipfile.ZipFile, path: str | os.PathLike[str], kind: str) -> None:
    """Refuse what is encrypted, what has a name twice, and what unpacks to far more than is stored."""
    members, name = archive.infolist(), brief(os.fspath(path))
    if twice := repeats(item.filename for item in members):
        raise DataError(f"{name} holds {listing(twice, limit=3)} twice, of which one would be read; write it again.")
    unpacked = sum(item.file_size for item in members)
    if unpacked > MOST_MEMORY + MOST_EXPANSION * Path(path).stat().st_size:
        raise DataError(f"{name} unpacks to {unpacked:,} bytes; it is damaged or no {kind}.")


CUT = "It may be cut short: get it again."


def read_tensors(path: str | os.PathLike[str], kind: str = "safetensors file") -> dict[str, torch.Tensor]:
    """Read all tensors of a safetensors file; a weight that is not finite is refused."""
    from safetensors.torch import load_file

    file = check_file(path, kind)
    with readable(path, kind, CUT):
        tensors: dict[str, torch.Tensor] = load_file(file)
    check_finite(tensors, os.fspath(path))
    return tensors


def read_checkpoint(path: str | os.PathLike[str], kind: str = "PyTorch file") -> Mapping[str, Any]:
    """Read the mapping that ``torch.save`` wrote; nothing in it is executed, and every weight is stored and finite."""
    import torch

    file, name = check_file(path, kind), brief(os.fspath(path))
    with readable(path, kind, CUT):
        sound = zipfile.is_zipfile(file)
        if sound:
            with zipfile.ZipFile(file) as archive:
                check_archive(archive, path, kind)
        try:
            content = torch.load(file, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError as error:
            # PyTorch writes zip archives; only in a sound one is an object in the way, and not a torn file.
            if not sound:
                raise
            raise DataError(
                f"{name} holds objects that only pickle could load, which may run code; save its 'state_dict' alone "
                "with torch.save, or as safetensors."
            ) from error
    return content if isinstance(content, Mapping) else {}


def check_stored(tensors: Mapping[str, torch.Tensor], name: str) -> None:
    """Refuse tensors that stand for more numbers than are stored, or that are not finite."""
    import torch

    for key, value in tensors.items():
        # A view may repeat one stored number without end; only its use would take the memory.
        plain = value.layout == torch.strided and value.device.type == "cpu" and not value.is_complex()
        if not plain or value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise DataError(f"{brief(key)} in {brief(name)} is no plain tensor with all of its numbers.")
    check_finite(tensors, name)


def check_finite(arrays: Mapping[str, Any], name: str) -> None:
    """Refuse floating-point arrays or tensors with NaN or infinity; the :class:`DataError` names the first."""
    import numpy as np

    for key, values in arrays.items():
        array = values.detach().float().cpu().numpy() if hasattr(values, "detach") else np.asarray(values)
        if array.dtype.kind in "fc" and not np.isfinite(array).all():
            bad = int((~np.isfinite(array)).sum())
            raise DataError(f"{brief(key)} in {brief(name)} has {bad:,} of {array.size:,} values that are not finite.")
