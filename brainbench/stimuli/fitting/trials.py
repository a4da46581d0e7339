"""Trials of a fit: what moved and what was touched, what was measured, and how far a simulation is from it.

Letters: n instant, k traced point, c channel of a wrench, d = 1 or 2 directions across a shape.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError, brief, check_name, check_number, choose_name, listing
from brainbench.core.limits import Limit, limited
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.tables import read_columns
from brainbench.core.rotations import Vector
from brainbench.stimuli.fitting.contacts import normal_offsets
from brainbench.stimuli.fitting.parameters import Condition
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle, Trace
from brainbench.stimuli.tracks.contract import AXES, check_length, new_wrenches
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.stimuli.scenes.scene import Scene

SETTLING = 4.0
"""Time for which a plucked whisker is held, in decay times 1/(ζ ω) of its first mode; it is held in a way that hardly
swings."""

RARE = 10.0  # periods of the first mode between two readings from which the clock is wrong
SHORT = 0.02
"""Share of a period of the first mode that the readings last from which the clock or the whisker is wrong."""
FEWEST_FRAMES = 3
SPENT = 25.0  # decay times of the first mode after which nothing is left of a swing: e⁻²⁵


@limited(of="The {} of a held whisker")
class Pluck:
    """A whisker held aside and let go at t = 0."""

    deflection: Annotated[float, Limit(above=0, unit="m")]
    """Deflection of the held point before the release [m]."""
    arc: Annotated[float, Limit(above=0, unit="m")]
    """Arc length of the held point [m]."""
    direction: Vector = (0.0, 1.0, 0.0)
    """Direction of the deflection, in the frame of the job; its length does not matter."""

    def __post_init__(self) -> None:
        check_number("The length of the direction of a held whisker", math.hypot(*self.direction), above=0)

    def loads(self, condition: Condition, start: float) -> tuple[Load, Load]:
        """Return the loads that hold the whisker aside from ``start`` (s) to the release.

        A load that comes at once makes the first mode swing. Half a period at 1/(1 + K) of it, with the mode's decay K
        in that time, carries the mode to its rest under the whole load (input shaping, Singer & Seering 1990, J. Dyn.
        Syst. Meas. Control 112, 76).
        """
        whisker = condition.whisker
        arc = min(self.arc, whisker.arc_length)
        # The small-bending closed form is that of the straight whisker; curvature changes it by second order.
        straight = replace(whisker, curvature=0.0, bends=())
        force = condition["deflection"] / references.point_load_deflection(straight, 1.0, arc)
        whole = force * np.asarray(self.direction, dtype=float) / math.hypot(*self.direction)
        ratio, omega = min(whisker.damping_ratio, 0.9), build_chain(whisker, 16).first_frequency
        damped = math.sqrt(1 - ratio**2)
        decay = math.exp(-math.pi * ratio / damped)
        part = -whole * decay / (1 + decay)
        x, y, z = whole.tolist()
        a, b, c = part.tolist()
        return Load(arc, (x, y, z), stop=0.0), Load(arc, (a, b, c), stop=start + math.pi / (omega * damped))


@dataclass(frozen=True, eq=False)
class Trial:
    """One recording of one whisker, with the motion and the objects that belong to it."""

    job: Job
    """Whisker, motion of its base, objects; it is read at the times of the measurement."""
    measured: xr.Dataset
    """``wrench`` [time, channel] or ``shape`` [time, point, axis], see :mod:`brainbench.stimuli.tracks`."""
    pluck: Pluck | None = None

    def __post_init__(self) -> None:
        count = self.measured.sizes["time"]
        if count < FEWEST_FRAMES:
            raise DataError(f"The measurement has {count} frames; a fit over time needs at least {FEWEST_FRAMES}.")
        if "noise" in self.measured and not (self.measured["noise"].values > 0).all():
            raise DataError(
                f"The noise of a measurement is above 0; received {self.measured['noise'].values.tolist()}."
            )
        if self.of_shapes:
            check_length(self.measured, self.job.whisker.arc_length)

    @classmethod
    def of_scene(cls, scene: Scene, measured: xr.Dataset, whisker: str, *, start: Whisker | None = None) -> Trial:
        """Return the trial of one whisker of a scene, whose base motion and objects are known.

        Args:
            scene: what was done; its frames do not matter.
            measured: wrenches or shapes in world axes; its times count from the scene's t = 0.
            whisker: a whisker of the scene, such as ``C2``.
            start: the whisker that the fit starts from; that of the scene when None.
        """
        check_name("whisker of the scene", whisker, scene.names)
        which = scene.names.index(whisker)
        job, axes = scene.jobs()[which], scene.axes[which]
        times = measured["time"].values.astype(float)
        local = to_frame(measured, axes, scene.origins[which])
        return cls(replace(job, whisker=start or job.whisker, times=times), local)

    @classmethod
    def ringdown(
        cls,
        whisker: Whisker,
        measured: xr.Dataset,
        deflection: float,
        *,
        arc: float | None = None,
        direction: Vector = (0.0, 1.0, 0.0),
    ) -> Trial:
        """Return the trial of a whisker on a still base that is held aside and let go at t = 0.

        Args:
            whisker: the whisker that the fit starts from; its base is the origin and it leaves along +x.
            measured: wrenches or shapes; times count from the release. A reading at 0 itself is left out: there the
                force jumps, and what a sensor shows depends on how fast it is.
            deflection: deflection of the held point (m), roughly; the parameter ``deflection`` refines it.
            arc: arc length of the held point (m); near the tip when None.
            direction: direction of the deflection.
        """
        arc = 0.95 * whisker.arc_length if arc is None else arc
        check_number("The arc length (m) of the held point", arc, above=0, most=whisker.arc_length)
        times = measured["time"].values.astype(float)
        if times[0] < 0:
            raise UsageError(
                f"The times of a ring-down count from the release; the first is {times[0]:g} s: cut the frames before."
            )
        if times[0] == 0:
            measured, times = measured.isel(time=slice(1, None)), times[1:]
        frequency = float(references.natural_frequencies(whisker, 1)[0])
        if len(times) > 1:
            check_clock(times, frequency, whisker.damping_ratio)
        # Long enough for the shaped loads to act and for what they stir up to decay.
        omega = 2 * math.pi * frequency
        settling = SETTLING / (max(whisker.damping_ratio, 0.05) * omega) + math.pi / omega
        job = Job(whisker, StillFollicle(), (), times, start=-settling)
        return cls(job, measured, Pluck(deflection, arc, direction))

    @property
    def of_shapes(self) -> bool:
        """True when shapes were measured, False for wrenches."""
        return "shape" in self.measured

    @property
    def condition(self) -> Condition:
        """What the trial states, unchanged."""
        return Condition(self.job.whisker, {"deflection": self.pluck.deflection} if self.pluck else {})

    @property
    def channels(self) -> tuple[str, ...]:
        """Name of each noise group: the channels of a wrench, or ``shape``."""
        return ("shape",) if self.of_shapes else tuple(str(name) for name in self.measured["channel"].values)

    def job_of(self, condition: Condition) -> Job:
        """Return the job that simulates the trial under a condition."""
        job = condition.job(self.job)
        if self.pluck is None:
            return job
        return replace(job, loads=(*job.loads, *self.pluck.loads(condition, job.start)))

    def residuals(self, trace: Trace, whisker: Whisker) -> NDArray[np.float64]:
        """Return predicted minus measured: [n, c] (N, N·m), or [n, k, d] (m) across the predicted shape; NaN: missing.

        Points of a shape have no names along the whisker, so only their distance across it counts.
        """
        if not self.of_shapes:
            columns = [CHANNELS.index(name) for name in self.channels]
            return trace.wrench[:, columns] - self.measured["wrench"].values
        assert trace.link_positions is not None
        nodes = build_chain(whisker, trace.link_positions.shape[1] - 1).nodes
        return normal_offsets(nodes, trace.link_positions, self.measured["shape"].values)


def check_clock(times: NDArray[np.float64], frequency: float, damping_ratio: float) -> None:
    """Refuse times [n] (s) at which a whisker of this frequency (Hz) cannot be followed as it rings down."""
    gap, period = float(np.median(np.diff(times))), 1 / frequency
    if gap > RARE * period:
        raise DataError(
            f"Readings are {gap:.3g} s apart, and this whisker swings with a period of {period:.3g} s; times are in "
            "seconds: call a column of milliseconds time_ms, or correct the frame rate."
        )
    if times[-1] < SHORT * period:
        raise DataError(
            f"The readings end {times[-1]:.3g} s after the release, and this whisker swings with a period of "
            f"{period:.3g} s; times are in seconds and properties of the whisker in SI units (lengths in m)."
        )
    spent = SPENT / (2 * math.pi * frequency * max(damping_ratio, 0.02))
    if times[0] > spent:
        raise DataError(
            f"The first reading is {times[0]:.3g} s after the release, and nothing is left of the swing after "
            f"{spent:.2g} s; times count from the release: subtract its time, or give --zero-frame."
        )


def to_frame(measured: xr.Dataset, axes: NDArray[np.float64], origin: NDArray[np.float64]) -> xr.Dataset:
    """Return a measurement in the frame of a job, whose axes [3, 3] (columns, world) and origin [3] (m) are given."""
    if np.allclose(axes, np.eye(3)) and not origin.any():
        return measured
    name, along, needed = ("shape", "axis", AXES) if "shape" in measured else ("wrench", "channel", CHANNELS)
    if missing := sorted(set(needed) - set(measured[along].values.tolist())):
        raise UsageError(
            f"The head of this scene is turned or displaced, which needs all axes of what was measured; {missing[0]} "
            "is missing."
        )
    if name == "shape":
        return measured.assign(shape=(measured["shape"].dims, (measured["shape"].values - origin) @ axes))
    # Columns come in any order; three are turned together.
    measured = measured.sel(channel=list(CHANNELS))
    wrench = (measured["wrench"].values.reshape(-1, 2, 3) @ axes).reshape(-1, 6)
    turned = measured.assign(wrench=(measured["wrench"].dims, wrench))
    if "noise" not in measured:
        return turned
    noise = np.sqrt((measured["noise"].values ** 2).reshape(2, 3) @ axes**2).reshape(6)
    return turned.assign(noise=(measured["noise"].dims, noise))


Array = NDArray[np.float64]
TIMES = {"time": 1.0, "time_s": 1.0, "t": 1.0, "timestamps": 1.0, "time_ms": 1e-3, "time_us": 1e-6}
"""Names of a column of times, and their unit in s."""
_SCALES = {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "nN": 1e-9, "Nm": 1.0, "mNm": 1e-3, "uNm": 1e-6, "nNm": 1e-9, "Nmm": 1e-3,
           "mNmm": 1e-6, "uNmm": 1e-9, "nNmm": 1e-12}  # fmt: skip
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

    def _look(name: str, node: Any) -> None:
        six = getattr(node, "ndim", 0) == 2 and (node.shape[1] == len(CHANNELS) or "channels" in node.attrs)
        if name.rpartition("/")[2] == "data" and six:
            series.append(node)

    file.visititems(_look)
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
