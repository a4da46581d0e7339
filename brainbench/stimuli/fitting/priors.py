"""Priors of whisker parameters from published measurements: normal laws, of logarithms where a parameter is "
"positive."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from brainbench.stimuli.fitting.parameters import PARAMETERS
from brainbench.stimuli.whiskers.whisker import Whisker


@dataclass(frozen=True)
class Prior:
    """What is known of a parameter before a fit."""

    mean: float
    """Mean, in the parameter's unit; of the logarithm for positive parameters (then the median)."""
    spread: float
    """Standard deviation; relative for positive parameters."""
    source: str

    def row(self, name: str, start: float, whisker: Whisker) -> tuple[float, float]:
        """Return the mean and the standard deviation of the coordinate u of a fit that began at ``start``."""
        parameter = PARAMETERS[name]
        spread = self.spread if parameter.kind == "log" else self.spread / parameter.unit_of(whisker)
        return parameter.coordinate(start, self.mean, whisker), spread


def _log_spread(mean: float, deviation: float) -> float:
    """Return the standard deviation of the logarithm of a log-normal law with this mean and standard deviation."""
    return math.sqrt(math.log1p((deviation / mean) ** 2))


PUBLISHED: Mapping[str, Prior] = {
    "young_modulus": Prior(
        3.34e9, _log_spread(3.34, 1.48), "Quist et al. (2011), J. Biomech. 44, 2775-2781: 3.34 ± 1.48 GPa"
    ),
    "density": Prior(
        1260.0,
        0.15,
        "Yang, Belli & Hartmann (2019), J. Neurophysiol. 121, 1879-1895: 1260 (base) to 1690 kg/m³ (tip); "
        "the spread is half of that range",
    ),
    "damping_ratio": Prior(
        math.sqrt(0.11 * 0.17),
        math.log(0.17 / 0.11) / 2,
        "isolated whiskers ring with .11 to .17, taken as ± 1 "
        "standard deviation; a whisker in its follicle may be damped more",
    ),
    "friction": Prior(
        0.48, 0.15, "rat whisker on stainless steel, IEEE Trans. Haptics (2017), PMC5753595: .48; the spread is ours"
    ),
}
"""Priors by parameter; others have none."""
