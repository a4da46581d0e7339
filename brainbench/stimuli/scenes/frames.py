"""Reading of forces from a simulation: frames, averaging, anti-alias filter, axes and clipping."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, limited

Axes = Literal["world", "follicle"]
"""``world``: axes of the world. ``follicle``: the whisker's base frame, which turns with it: x along the whisker
at its base, x-y the plane of its curvature."""
Phase = Literal["zero", "causal"]
"""``zero``: the filter runs forwards and backwards, so that nothing is delayed and frames know a little of the
future. ``causal``: it runs forwards, as a sensor would, and delays."""

READINGS_PER_CUTOFF = 4  # readings per period of the cut-off that a filter needs at least
# Periods of the cut-off that are read behind the last frame for the backward pass; order of the filter.
_EDGE = 2.0
_ORDER = 4


@dataclass(frozen=True)
@limited(of="{} of the frames")
class Frames:
    """Times at which forces are read, and the rule that makes a frame of readings.

    The default reads 110 instantaneous frames, 9 ms apart, the first at 1 ms, as the published pipeline does. Whatever
    vibrates above 1/(2·interval) = 56 Hz then aliases, and a sliding tip does: the RDM of the six Rodgers stimuli at
    the presets ``balanced`` and ``accurate`` correlates by .90, with ``average`` = 18 by .995. A mean still lets some
    aliases through; ``lowpass`` stops them with a Butterworth filter.
    """

    first: Annotated[float, Limit(least=0, unit="s")] = 0.001
    """Time of the first frame [s]; the whiskers start at rest at t = 0."""
    interval: Annotated[float, Limit(above=0, unit="s")] = 0.009
    """Time between frames [s]."""
    count: Count = 110
    average: Count = 1
    """Readings, evenly spread over the interval that begins at the frame's time, whose mean a frame is; the
    readings per frame that a filter works on, when ``lowpass`` is given."""
    lowpass: Annotated[float, Limit(above=0, unit="Hz")] | None = None
    """Cut-off [Hz] of a fourth-order Butterworth filter on the readings (−3 dB; −6 dB with phase ``zero``, which
    applies it twice); a frame is then the filtered force at its time. None for no filter."""
    phase: Phase = "zero"
    """Direction of the filter."""
    axes: Axes = "world"
    """Axes of force and moment, turned by the follicle's pose at the time of each frame."""
    clip: Annotated[float, Limit(above=0, unit="N")] | None = None
    """Largest force component [N] that a frame reports; moments are clipped at ``clip`` × 1 mm, which is the same
    number in the published units mN and mN·mm (there 1000: ``clip`` = 1). None for no clipping."""

    def __post_init__(self) -> None:
        if self.lowpass is not None:
            self._check_filter(self.lowpass)

    @property
    def times(self) -> NDArray[np.float64]:
        """Frame times [count] (s)."""
        return np.asarray(self.first + self.interval * np.arange(self.count), dtype=np.float64)

    @property
    def readings(self) -> NDArray[np.float64]:
        """Times [n] (s) at which the simulation is read; for a filter also before and after the frames."""
        if self.lowpass is None:
            within = self.interval / self.average * np.arange(self.average)
            return (self.times[:, None] + within).reshape(-1)
        steps = np.arange(-self._lead, (self.count - 1) * self.average + self._tail + 1)
        return np.maximum(self.first + self.interval / self.average * steps, 0.0)

    def reduce(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Make frames [count, …] of readings [n, …]: their means, or the filtered values at the frame times."""
        if self.lowpass is None:
            return self.split(values).mean(axis=1)
        rate = self.average / self.interval
        return low_pass(values, rate, self.lowpass, phase=self.phase)[self._lead :: self.average][: self.count]

    def split(self, values: NDArray[Any]) -> NDArray[Any]:
        """Cut readings [n, …] into those of each frame's interval [count, average, …]."""
        within = values[self._lead : self._lead + self.count * self.average]
        return within.reshape(self.count, self.average, *values.shape[1:])

    def config(self) -> dict[str, Any]:
        """Return plain values for hashing and display; what was added later appears only where it is used."""
        config = {"first": self.first, "interval": self.interval, "count": self.count, "average": self.average}
        if self.lowpass is not None:
            config |= {"lowpass": self.lowpass, "phase": self.phase}
        if self.axes != "world":
            config["axes"] = self.axes
        return config if self.clip is None else config | {"clip": self.clip}

    def describe(self) -> str:
        """Say in words what a frame is."""
        readings = f"{self.average} readings, {self.interval / self.average * 1e3:g} ms apart"
        if self.lowpass is not None:
            kind = "run forwards and backwards" if self.phase == "zero" else "causal"
            return f"Butterworth low-pass of order {_ORDER} at {self.lowpass:g} Hz, {kind}, on {readings}"
        return "instantaneous" if self.average == 1 else f"mean of {readings}"

    @property
    def _lead(self) -> int:
        """Readings before the first frame: the filter starts when the whisker does."""
        return 0 if self.lowpass is None else math.floor(self.first / self.interval * self.average + 1e-6)

    @property
    def _tail(self) -> int:
        """Readings after the last frame: its own interval, and what the filter needs to run backwards."""
        if self.lowpass is None or self.phase == "causal":
            return self.average - 1
        return max(self.average - 1, math.ceil(_EDGE / self.lowpass / self.interval * self.average))

    def _check_filter(self, cutoff: float) -> None:
        if cutoff * self.interval >= 0.5:
            raise UsageError(
                f"A low-pass at {cutoff:g} Hz lets aliases through: frames {self.interval * 1e3:g} ms apart show "
                f"nothing above {0.5 / self.interval:.4g} Hz; choose a lower cut-off or more frames."
            )
        needed = math.ceil(READINGS_PER_CUTOFF * cutoff * self.interval - 1e-9)
        if self.average < max(needed, 2):
            raise UsageError(
                f"A low-pass at {cutoff:g} Hz needs at least {max(needed, 2)} readings per frame; average is "
                f"{self.average}: the readings themselves must not alias."
            )


def low_pass(values: NDArray[np.float64], rate: float, cutoff: float, *, phase: Phase = "zero") -> NDArray[np.float64]:
    """Filter signals [n, …] sampled at ``rate`` (Hz) by a fourth-order Butterworth low-pass at ``cutoff`` (Hz).

    From the first value of a signal that is not finite on, it is NaN; before, it is filtered as if it ended there.
    """
    from scipy.signal import butter, sosfilt, sosfiltfilt

    # Second-order sections: the coefficients of one polynomial lose digits at low cut-offs.
    sections = butter(_ORDER, cutoff, fs=rate, output="sos")
    flat = np.asarray(values, dtype=float).reshape(len(values), -1)
    # Readings before the first one that is not finite; signals with as many are filtered together.
    lengths = np.where(np.isfinite(flat).all(axis=0), len(flat), np.argmin(np.isfinite(flat), axis=0))
    result = np.full_like(flat, np.nan)
    for end in np.unique(lengths[lengths > 0]).tolist():
        columns = lengths == end
        signal = flat[:end, columns]
        if phase == "causal":
            result[:end, columns] = sosfilt(sections, signal, axis=0)
        else:
            edge = min(end - 1, math.ceil(_EDGE * rate / cutoff))
            result[:end, columns] = sosfiltfilt(sections, signal, axis=0, padlen=edge)
    return result.reshape(np.shape(values))


def clip_wrenches(wrench: NDArray[np.floating], limit: float) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Clip wrenches [..., 6] to ±``limit`` (N) and ±``limit`` × 1 mm (N·m); also say what was clipped [..., 6].

    What is not finite stays so and does not count.
    """
    most = np.repeat([limit, limit * 1e-3], 3).astype(wrench.dtype)
    return np.clip(wrench, -most, most), np.abs(wrench) > most
