"""Options of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, Positive, Share, limited
from brainbench.core.statistics import check_level
from brainbench.stimuli.engines.fidelity import MOST_LINKS


@dataclass(frozen=True)
@limited
class FitOptions:
    """How a fit simulates, weighs and judges; a value outside its range is a :class:`UsageError`."""

    priors: Literal["none", "published"] = "none"
    """Prior of the parameters: none, or published (means and spreads of measured whiskers)."""
    intervals: Literal["laplace", "profile"] = "laplace"
    """Confidence intervals: laplace (curvature of the likelihood at the best fit), or profile (takes longer)."""
    level: float = 0.95
    """Coverage of the confidence intervals."""
    loss: Literal["linear", "soft_l1", "huber", "cauchy"] = "linear"
    """Loss of a residual: linear (least squares), or soft_l1, huber or cauchy, which outliers pull less."""
    most_iterations: Count = 50
    """Iterations after which a fit counts as not converged."""
    links: Annotated[int, Limit(least=2, most=MOST_LINKS)] = 20
    """Links of each simulated whisker."""
    steps_per_period: Annotated[float, Limit(least=4)] = 400.0
    """Time steps in one period of the whisker's first mode at the start of the fit. Few steps damp higher modes, which
    biases stiffness and taper by more than the noise of a good sensor."""
    time_step: Annotated[float, Limit(above=0, unit="s")] = 1e-4
    """Longest time step (s)."""
    solver: Literal["dynamic", "quasistatic"] = "dynamic"
    """quasistatic leaves out inertia and damping, for slow contact."""
    twist: bool = True
    """Whether whiskers may twist."""

    def __post_init__(self) -> None:
        if self.intervals == "profile" and self.loss != "linear":
            raise UsageError(
                f"Profile intervals follow the squares of the residuals, and the loss {self.loss!r} is another; "
                "use intervals = 'laplace', or the loss 'linear'."
            )
        check_level(self.level)


@dataclass(frozen=True)
@limited
class TrackOptions:
    """Scale, frame rate and identity of a track; a value that cannot be is a :class:`UsageError`."""

    metres_per_pixel: Positive | None = None
    """Length of a pixel (or of the unit of the file) in m."""
    frame_rate: Positive | None = None
    """Frames per second of the video (Hz)."""
    track: str | None = None
    """Which whisker of the file: a label of whisk, a number of WhiskerMan (from 1), or an individual of DeepLabCut."""
    layout: Literal["auto", "deeplabcut", "points", "whisk", "whiskerman"] = "auto"
    """Kind of table: auto, deeplabcut, points, whisk or whiskerman."""
    zero_frame: int = 0
    """Frame at which time is 0: the start of the scene, or the release of a plucked whisker."""
    identities: str | None = None
    """Table of whisk's measurements (CSV) that says which trace is which whisker and where its follicle is."""
    parts: tuple[str, ...] = ()
    """Body parts of DeepLabCut from the base to the tip; in the order of the file when empty."""
    least_likelihood: Share = 0.6
    """Likelihood of DeepLabCut from which a point is used."""
    points: Annotated[int, Limit(least=2)] = 30
    """Most points of a frame that are kept of whisk's traces."""
    rows_down: bool = True
    """True for image coordinates, whose y runs down; it is turned, so that left stays left."""

    def __post_init__(self) -> None:
        for name, what in (
            ("metres_per_pixel", "the scale: metres per pixel (5e-5 for 50 µm)"),
            ("frame_rate", "the frames per second of the video"),
        ):
            value = getattr(self, name)
            if value is None:
                raise UsageError(f"A track holds pixels and frame numbers; give {what} as {name}.")
        if not 1e-8 <= float(self.metres_per_pixel or math.nan) <= 1e-2:
            raise UsageError(
                f"metres_per_pixel is {self.metres_per_pixel:g} m; a pixel of a whisker video is between 1e-8 and "
                "1e-2 m (50 µm = 5e-5)."
            )
        if not 10 <= float(self.frame_rate or math.nan) <= 1e6:
            raise UsageError(
                f"frame_rate is {self.frame_rate:g} Hz; videos of whiskers have 10 to 1e6 frames per second: give "
                "frames per second, not the time of a frame."
            )
