"""Features computed elsewhere: an HDF5 file of activations that can be scored like a model.

Layout, version 1: a dataset ``labels`` [K] of stimulus labels (strings) and a group ``activations``
with one dataset per layer, [K, F] or [K, T, F], of real numbers; whole ones below 2⁵³. Layers are read in the order of
their creation when the file tracks it, else by name.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.errors import DataError, brief, listing, repeats
from brainbench.core.files import create_hdf5
from brainbench.core.lazy import lazy_module
from brainbench.core.reading.hdf5 import open_hdf5

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray
else:
    h5py = lazy_module("h5py")


@dataclass(frozen=True)
class Features:
    """Activations with the labels of their stimuli."""

    labels: tuple[str, ...]
    activations: Mapping[str, NDArray[np.floating]]
    """Layer name → float [K, T, F]; T = 1 for features without a time axis."""


def write_features(path: str | Path, labels: Sequence[str], activations: Mapping[str, NDArray[np.floating]]) -> Path:
    """Write activations ([K, F] or [K, T, F] per layer) in the layout above, atomically."""
    for layer, values in activations.items():
        _check_shape(layer, np.shape(values), len(labels), str(path))
    with create_hdf5(path) as file:
        file.attrs["brainbench_features"] = 1
        file.create_dataset("labels", data=[str(label) for label in labels], dtype=h5py.string_dtype())
        group = file.create_group("activations", track_order=True)
        for layer, values in activations.items():
            # A slash would make a sub-group; layer names keep it as a look-alike on disk only.
            group.create_dataset(layer.replace("/", "\N{DIVISION SLASH}"), data=np.asarray(values))
    return Path(path)


def read_features(path: str | Path) -> Features:
    """Read a file in the layout above."""
    path = Path(path)
    with open_hdf5(path, "file of activations") as file:
        labels, group = file.get("labels"), file.get("activations")
        if not isinstance(labels, h5py.Dataset) or not isinstance(group, h5py.Group):
            raise DataError(
                f"{str(path)!r} holds {listing(file)}; a file of activations needs a dataset 'labels' [K] and a "
                "group 'activations' with one dataset [K, F] or [K, T, F] per layer."
            )
        labels = tuple(label.decode() if isinstance(label, bytes) else str(label) for label in np.ravel(labels[()]))
        if twice := repeats(labels):
            raise DataError(f"{str(path)!r} has the label {twice[0]!r} more than once; labels must be unique.")
        layers = _layers(group, len(labels), str(path))
    if not layers:
        raise DataError(f"{str(path)!r} has no layer in its group 'activations'.")
    return Features(labels, layers)


def _layers(group: h5py.Group, rows: int, path: str) -> dict[str, NDArray[np.floating]]:
    layers: dict[str, NDArray[np.floating]] = {}

    # Not ``visititems``, which passes over soft links.
    for name, node in _arrays(group, path):
        _check_shape(name, node.shape, rows, path)
        whole = np.issubdtype(node.dtype, np.integer)
        if not whole and not np.issubdtype(node.dtype, np.floating):
            raise DataError(f"Layer {name!r} of {path!r} has type {node.dtype}; activations must be real numbers.")
        # Single precision where it holds every value of the type.
        single = np.result_type(node.dtype, np.float32) == np.float32
        values = node.astype(np.float32 if single else np.float64)[()]
        if whole and (np.abs(values) >= 2**53).any():
            raise DataError(
                f"Layer {brief(name)} of {brief(path)} has whole numbers of 2**53 or more, which floating point "
                "rounds; scale them or write them as floating point."
            )
        if infinite := int(np.isinf(values).sum()):
            raise DataError(f"Layer {brief(name)} of {brief(path)} has {infinite:,} infinite values; use NaN for none.")
        # NaN is a missing value: the layer is scored on the rest, or its score is undefined and says so.
        layers[name.replace("\N{DIVISION SLASH}", "/")] = values[:, None, :] if values.ndim == 2 else values
    return layers


def _arrays(group: h5py.Group, path: str, prefix: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield the arrays of a group and of those in it, by their paths in it."""
    if prefix.count("/") > 32:
        raise DataError(f"{brief(path)} nests its layers more than 32 deep, or in a circle.")
    for name, node in group.items():
        if isinstance(node, h5py.Group):
            yield from _arrays(node, path, f"{prefix}{name}/")
        elif isinstance(node, h5py.Dataset):
            yield prefix + name, node


def _check_shape(layer: str, shape: tuple[int, ...], rows: int, path: str) -> None:
    if len(shape) not in (2, 3) or shape[0] != rows:
        raise DataError(f"Layer {layer!r} of {path!r} is {list(shape)}; expected [{rows}, F] or [{rows}, T, F].")
    if 0 in shape[1:]:
        raise DataError(f"Layer {layer!r} of {path!r} has shape {list(shape)}; expected at least one feature.")
