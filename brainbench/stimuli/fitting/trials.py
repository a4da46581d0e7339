"""Trials of a fit: what moved and what was touched, what was measured, and how far a simulation is from it.

Letters: n instant, k traced point, c channel of a wrench, d = 1 or 2 directions across a shape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError, check_name
from brainbench.core.limits import Limit, limited
from brainbench.core.reading.ranges import check_number
from brainbench.core.rotations import Vector
from brainbench.stimuli.fitting.curves import normal_offsets
from brainbench.stimuli.fitting.parameters import Condition
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle, Trace
from brainbench.stimuli.tracks.contract import AXES, check_length
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.chain import build_chain
from brainbench.stimuli.whiskers.whisker import Whisker

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.stimuli.scenes.scene import Scene


SETTLING = 4.0
"""Time for which a plucked whisker is held, in decay times 1/(ζ ω) of its first mode; it is held in a way that hardly
swings."""

RARE = 10.0
"""Periods of the first mode between two readings from which the clock is wrong."""
SHORT = 0.02
"""Share of a period of the first mode that the readings last from which the clock or the whisker is wrong."""
FEWEST_FRAMES = 3
SPENT = 25.0
"""Decay times of the first mode after which nothing is left of a swing: e⁻²⁵."""


@dataclass(frozen=True)
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
        straight = replace(whisker, curvature=0.0)
        force = condition["deflection"] / references.point_load_deflection(straight, 1.0, arc)
        whole = force * np.asarray(self.direction, dtype=float) / math.hypot(*self.direction)
        ratio, omega = min(whisker.damping_ratio, 0.9), float(build_chain(whisker, 16).frequencies()[0])
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
            raise DataError(_few(count))
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
        if len(times) < FEWEST_FRAMES:
            raise DataError(_few(len(times)))
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


def _few(count: int) -> str:
    return f"The measurement has {count} frames; a fit over time needs at least {FEWEST_FRAMES}."


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
