"""Read base wrenches over time: CSV tables, HDF5 files and time series as of NWB, and our own stimulus sets."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError, brief, choose_name, listing
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.tables import read_columns
from brainbench.stimuli.tracks.contract import new_wrenches

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
TIMES = {"time": 1.0, "time_s": 1.0, "t": 1.0, "timestamps": 1.0, "time_ms": 1e-3, "time_us": 1e-6}
"""Names of a column of times, and their unit in s."""
_SCALES = {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9, "Nm": 1.0, "mNm": 1e-3, "uNm": 1e-6, "nNm": 1e-9, "Nmm": 1e-3,
           "mNmm": 1e-6, "uNmm": 1e-9}  # fmt: skip
# The micro sign and the Greek letter are two characters that look alike.
_UNIT = re.compile(r"(?<![A-Za-z])[mun]?N(?:[.·* ]?m{1,2})?(?![A-Za-z/])")
_WORDS = {"[µμ]": "u", "(?i)milli": "m", "(?i)micro": "u", "(?i)nano": "n", "(?i)newtons?": "N",
          "(?i)[- ·*]*met(?:er|re)s?": "m", "⋅": "·", "mmm": "mm"}  # fmt: skip
_COLUMN = re.compile(r"([FM][xyz])(?:[_ \[(]+([munµμ]?N(?:[.·* ]?m{1,2})?)[\])]?)?")


def read_wrenches(
    path: str | os.PathLike[str], *, whisker: str | None = None, stimulus: str | None = None
) -> xr.Dataset:
    """Read the forces and moments at the base of one whisker.

    Args:
        path: a table (``.csv``) with a column of times (``time`` or ``time_s``, ``time_ms``) and columns ``Fx`` …
        ``Mz``
            in N and N·m, or with a unit as in ``Fy_mN`` and ``Mz_uNm``; an HDF5 file with ``wrench`` [n, channel] and
            ``time``, or with a time series as NWB stores it (``data`` with ``timestamps``, or ``starting_time`` and its
            rate); or a stimulus set of ours.
        whisker, stimulus: which of a stimulus set; the only one when None.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        return _read_csv(path)
    if suffix not in (".h5", ".hdf5", ".nwb", ".nc"):
        raise UsageError(f"{brief(os.fspath(path))} is no file of wrenches; these end in .csv, .h5, .hdf5 or .nwb.")
    with open_hdf5(path, "file of wrenches") as file:
        ours = "wrench" in file and {"stimulus", "whisker", "channel"} <= set(file)
        if not ours:
            return _read_hdf5(file, path)
    return _read_stimulus_set(path, whisker, stimulus)


def _read_csv(path: str | os.PathLike[str]) -> xr.Dataset:
    names, table = read_columns(path, "table of wrenches", gaps=True)
    clock = next((name for name in names if name.lower() in TIMES), None)
    if clock is None:
        raise _no_times(path, names)
    times = table[:, names.index(clock)] * TIMES[clock.lower()]
    channels, columns = [], []
    for index, name in enumerate(names):
        if match := _COLUMN.fullmatch(name):
            unit = re.sub("[.·* ]", "", re.sub("[µμ]", "u", match[2] or ("N" if name[0] == "F" else "Nm")))
            if ("m" in unit.partition("N")[2]) != (name[0] == "M"):
                raise DataError(f"The column {name!r} of {brief(os.fspath(path))} has the unit of the other kind.")
            channels.append(match[1])
            columns.append(table[:, index] * _SCALES[unit])
    if not channels:
        raise DataError(
            f"{brief(os.fspath(path))} has no column of forces or moments; they are called Fx … Mz, or Fy_mN, Mz_uNm. "
            f"It has {listing(names)}."
        )
    # Other columns may stand beside a channel that is read, such as Fx_raw beside Fx.
    unread = [name for name in names if re.match(r"[FM][xyz](?![a-z])", name, re.IGNORECASE)]
    if unread := [name for name in unread if name[:2].capitalize() not in channels]:
        raise DataError(
            f"The columns {listing(unread)} of {brief(os.fspath(path))} have a name or a unit that is not known; "
            f"forces and moments are called Fx … Mz, with a unit as in Fy_mN or Mz_uNm: {', '.join(_SCALES)}."
        )
    return new_wrenches(times, np.stack(columns, axis=1), channels, source=os.fspath(path))


def _read_hdf5(file: Any, path: str | os.PathLike[str]) -> xr.Dataset:
    series = _find_series(file)
    if series is None:
        raise DataError(
            f"{brief(os.fspath(path))} holds no wrenches: neither 'wrench' [n, channel] nor a time series whose "
            "'data' has six columns."
        )
    data, group = series
    values = np.asarray(data[()], dtype=float)
    stated = data.attrs.get("channels")
    channels = [one.decode() if isinstance(one, bytes) else str(one) for one in stated] if stated is not None else []
    if not channels:
        if values.shape[1] != len(CHANNELS):
            raise DataError(
                f"The wrenches of {brief(os.fspath(path))} have {values.shape[1]} columns; name them in the attribute "
                "'channels', or give all six (Fx, Fy, Fz, Mx, My, Mz)."
            )
        channels = list(CHANNELS)
    # A time series of NWB: the values are data · conversion + offset, in its unit.
    values = values * float(data.attrs.get("conversion", 1.0)) + float(data.attrs.get("offset", 0.0))
    factor = _factors(data.attrs.get("unit", data.attrs.get("units")), channels, path)
    for name in ("time", "timestamps", "time_s"):
        if name in group:
            times = np.asarray(group[name][()], dtype=float)
            break
    else:
        start = group.get("starting_time")
        if start is None or "rate" not in start.attrs:
            raise _no_times(path, list(group))
        times = float(start[()]) + np.arange(len(values)) / float(start.attrs["rate"])
    return new_wrenches(times, values * factor, channels, source=os.fspath(path))


def _factors(unit: Any, channels: Sequence[str], path: str | os.PathLike[str]) -> Array:
    """Return the factors [channel] from a unit in words, such as "mN, mN·mm" or "newtons", to N and N·m."""
    text = unit.decode() if isinstance(unit, bytes) else "N" if unit is None else str(unit)
    short = text
    for words, sign in _WORDS.items():
        short = re.sub(words, sign, short)
    units = [re.sub("[.·* ]", "", one) for one in _UNIT.findall(short)]
    kinds = {"FM"["m" in one.partition("N")[2]]: _SCALES[one] for one in units}
    if kinds == {"F": 1.0}:  # the unit of the forces alone, and moments in the same system
        kinds["M"] = 1.0
    if len(kinds) < len(units) or not {name[0] for name in channels} <= set(kinds):
        raise DataError(
            f"The wrenches of {brief(os.fspath(path))} have the unit {brief(text)}, which does not tell forces and "
            f"moments; write the units of both, as in 'mN, mN·mm': {', '.join(_SCALES)}."
        )
    return np.array([kinds[name[0]] for name in channels])


def _find_series(file: Any) -> tuple[Any, Any] | None:
    """Return the data set of wrenches and the group that holds its times."""
    if "wrench" in file:
        return file["wrench"], file
    series: list[Any] = []

    def look(name: str, node: Any) -> None:
        six = getattr(node, "ndim", 0) == 2 and (node.shape[1] == len(CHANNELS) or "channels" in node.attrs)
        if name.rpartition("/")[2] == "data" and six:
            series.append(node)

    file.visititems(look)
    # Six columns may be anything; those that name their channels are wrenches.
    series = [item for item in series if "channels" in item.attrs] or series
    if len(series) > 1:
        raise DataError(
            f"{brief(file.filename)} has several time series that may be wrenches, "
            f"{listing(item.parent.name for item in series)}; keep one, or name the channels of one in the attribute "
            "'channels' of its data."
        )
    return (series[0], series[0].parent) if series else None


def _read_stimulus_set(path: str | os.PathLike[str], whisker: str | None, stimulus: str | None) -> xr.Dataset:
    from brainbench.stimuli.stimulus_set import read_stimulus_set, to_axes

    dataset, chosen = to_axes(read_stimulus_set(path), "world"), {}
    if (readout := dataset.attrs.get("readout", "instantaneous")) != "instantaneous":
        raise DataError(
            f"A frame of {brief(os.fspath(path))} is no reading ({readout}), and a fit compares readings; simulate the "
            "scenes with instantaneous frames (average = 1, no low-pass)."
        )
    for kind, name in (("whisker", whisker), ("stimulus", stimulus)):
        present = [str(one) for one in dataset[kind].values]
        chosen[kind] = present.index(choose_name(f"{kind} of {brief(os.fspath(path))}", name, present))
    wrench = dataset["wrench"].isel(chosen)
    return new_wrenches(dataset["time"].values, wrench.values, source=os.fspath(path))


def _no_times(path: str | os.PathLike[str], names: list[str]) -> DataError:
    return DataError(
        f"The wrenches of {brief(os.fspath(path))} have no time stamps; add a column or data set 'time' (s), or "
        f"'time_ms'. There are {listing(names)}."
    )
