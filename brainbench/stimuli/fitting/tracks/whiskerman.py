"""Tracks of WhiskerMan (Petersen et al. 2020, PLoS Comput. Biol. 16, e1007402): ``.tr4``, ``.tr4_2D`` and ``.mat``.

The struct array ``whisker`` holds, for each whisker, the control points of a Bézier curve in every frame, ``r3all``
[frame, 3, control point], whether it was ``tracked``, and its follicle ``fp3_all`` [frame, 3] (pixels). Read are
MATLAB's formats up to 7, and 7.3, which is HDF5. As many points are taken of a curve as it has control points: more
would repeat the same numbers.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, choose_name, shown
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import MOST_TABLE, check_file, readable
from brainbench.stimuli.fitting.tracks.options import TrackOptions

Array = NDArray[np.float64]
_FIELDS = ("r3all", "tracked", "fp3_all")


def read_whiskerman(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frame numbers [n] and points [n, k, 2 or 3] (pixels) of one whisker."""
    name = shown(os.fspath(path))
    whiskers = _read(path)
    if not whiskers:
        raise DataError(f"{name} holds no whisker.")
    numbers = [str(number) for number in range(1, len(whiskers) + 1)]
    wanted = choose_name(f"whisker of {name}", options.track, numbers, how="as track")
    fields = whiskers[int(wanted) - 1]
    control = np.asarray(fields["r3all"], dtype=float)
    if control.ndim != 3 or control.shape[1] != 3:
        raise DataError(f"'r3all' of {name} has the shape {control.shape}; [frame, 3, control point] is needed.")
    tracked = np.asarray(fields["tracked"], dtype=bool).ravel()
    if len(tracked) != len(control) or not tracked.any():
        raise DataError(f"{name} has no tracked frame of whisker {wanted}.")
    # Without a second view there is no third axis.
    axes = 3 if np.nan_to_num(control[tracked, 2]).any() else 2
    points = bezier(control, control.shape[2])[..., :axes]
    follicle = np.asarray(fields["fp3_all"], dtype=float).reshape(len(control), -1)[:, :axes]
    far = np.linalg.norm(points[:, [0, -1]] - follicle[:, None], axis=-1)
    backward = far[:, 1] < far[:, 0]
    points[backward] = points[backward, ::-1]
    points[~tracked] = np.nan
    frames = np.flatnonzero(tracked)
    kept = slice(frames[0], frames[-1] + 1)
    return np.arange(len(control))[kept], points[kept]


def bezier(control: Array, count: int) -> Array:
    """Return points [n, count, 3] evenly spaced in the parameter of Bézier curves of control points [n, 3, c]."""
    degree = control.shape[2] - 1
    t = np.linspace(0, 1, count)
    weights = np.stack([math.comb(degree, i) * t**i * (1 - t) ** (degree - i) for i in range(degree + 1)], axis=1)
    return np.einsum("nac,kc->nka", control, weights)


def _read(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    found = check_file(path, "track of WhiskerMan", most=4 * MOST_TABLE)
    with found.open("rb") as stream:
        head = stream.read(520)
    if b"\x89HDF\r\n" in head:  # MATLAB 7.3
        return _read_hdf5(path)
    from scipy.io import loadmat

    with readable(path, "track of WhiskerMan (MATLAB file)"):
        data = loadmat(found, variable_names=["whisker"], struct_as_record=True, appendmat=False)
    if "whisker" not in data or data["whisker"].dtype.names is None:
        raise DataError(f"{shown(os.fspath(path))} is no track of WhiskerMan: the struct 'whisker' is missing.")
    _need(data["whisker"].dtype.names, path)
    return [{name: one[name] for name in _FIELDS} for one in data["whisker"].ravel()]


def _read_hdf5(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    import h5py

    with open_hdf5(path, "track of WhiskerMan") as file:
        group = file.get("whisker")
        if not isinstance(group, h5py.Group):
            raise DataError(f"{shown(os.fspath(path))} is no track of WhiskerMan: the struct 'whisker' is missing.")
        _need(tuple(group), path)
        columns: dict[str, list[Any]] = {}
        for name in _FIELDS:
            dataset: Any = group[name]
            # A struct array of several elements stores references; MATLAB's axes stand in reverse order.
            cells: list[Any] = (
                [file[one] for one in dataset[()].ravel()] if dataset.dtype == h5py.ref_dtype else [dataset]
            )
            columns[name] = [np.asarray(cell[()]).T for cell in cells]
    counts = {len(cells) for cells in columns.values()}
    if len(counts) > 1:
        raise DataError(f"The fields of 'whisker' in {shown(os.fspath(path))} differ in length.")
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _need(names: tuple[str, ...], path: str | os.PathLike[str]) -> None:
    if missing := [name for name in _FIELDS if name not in names]:
        raise DataError(f"'whisker' of {shown(os.fspath(path))} has no field {missing[0]!r}, which WhiskerMan writes.")
