"""Drag of moving air on a whisker, a slender cylinder, and the range in which it holds.

Per length a force ½ ρ C_d d u² along the part u of the flow (against the whisker) that is normal to it: the
cross-flow principle (Hoerner, Fluid-Dynamic Drag, 1965). Friction along the whisker is left out. The coefficient is the
fit of Sucker & Brauer (1975, Wärme- und Stoffübertragung 8:149) to measured cylinders,
C_d = 1.18 + 6.8 Re^−.89 + 1.96 Re^−.5 − .0004 Re/(1 + 3.64e-7 Re²), Re = u d/ν. Below Re = .5 it lies within 16 % of
the solution of Oseen's equations (Lamb 1911). Above Re = 47 vortices leave the whisker in turn (Williamson 1996, Annu.
Rev. Fluid Mech. 28:477): the mean force holds, the alternating one across the flow is left out.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.whiskers.whisker import Whisker

VISCOSITY = 1.81e-5
"""Of dry air at 20 °C [Pa·s], as is its density [kg/m³]."""
DENSITY = 1.204
LARGEST_REYNOLDS = 180.0
"""Above it the wake of a cylinder is no longer laminar and two-dimensional (Williamson 1996)."""


def drag_coefficient(reynolds: ArrayLike) -> NDArray[np.float64]:
    """Return C_d (1) of a long cylinder across the flow for each Re; at Re = 0 it is infinite and the force zero."""
    number = np.asarray(reynolds, dtype=float)
    slow = 6.8 * number**-0.89 + 1.96 * number**-0.5
    return 1.18 + slow - 0.0004 * number / (1 + 3.64e-7 * number**2)


def drag_per_length(diameter: ArrayLike, speed: ArrayLike) -> NDArray[np.float64]:
    """Return the drag [N/m] of a whisker of this diameter [m] across a flow of this speed [m/s], above 0 both."""
    wide = np.asarray(diameter, dtype=float)
    return DENSITY / 2 * drag_coefficient(DENSITY / VISCOSITY * np.multiply(speed, wide)) * wide * np.square(speed)


def small_deflection(whisker: Whisker, speed: float) -> float:
    """Return how far [m] a flow across a whisker pushes its tip, by the theory of small bending."""
    s = np.linspace(0.0, whisker.arc_length, 400)
    beyond = np.maximum(s - s[:, None], 0.0)
    moment = np.trapezoid(drag_per_length(2 * whisker.radius(s), speed) * beyond, s, axis=1)
    return float(np.trapezoid(moment / whisker.bending_stiffness(s) * (whisker.arc_length - s), s))


def check_air(jobs: Iterable[Job]) -> None:
    """Refuse a flow beyond what is known of the drag, and one that no whisker stands against."""
    for whisker, flow in dict.fromkeys((job.whisker, job.air_flow) for job in jobs if job.air_flow is not None):
        speed = float(np.linalg.norm(flow))
        if (number := DENSITY / VISCOSITY * 2 * whisker.thickest * speed) > LARGEST_REYNOLDS:
            raise UsageError(
                f"An air flow of {speed:g} m/s has the Reynolds number {number:.0f} at a whisker that is"
                f" {2e3 * whisker.thickest:.2g} mm thick; drag is known up to {LARGEST_REYNOLDS:g}, so up to"
                f" {speed * LARGEST_REYNOLDS / number:.3g} m/s."
            )
        if speed and (share := small_deflection(whisker, speed) / whisker.arc_length) > 1:
            raise UsageError(
                f"An air flow of {speed:g} m/s lifts a whisker of {1e3 * whisker.arc_length:.3g} mm off whatever it"
                f" touches: its tip would give way by {share:.2g} lengths (small bending), and up to 1 is allowed;"
                " choose a slower flow."
            )
