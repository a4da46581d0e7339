"""Elastic materials and the modes of struck solids: frequency, decay and gain of each (thesis 4.33)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.reading.ranges import check_fields, check_number


@dataclass(frozen=True)
class ElasticMaterial:
    """An isotropic solid with Rayleigh damping C = α M + β K."""

    young_modulus: float
    """E [Pa]."""
    poisson_ratio: float
    density: float
    """[kg/m³]."""
    alpha: float
    """Damping of the mass [1/s]."""
    beta: float
    """Damping of the stiffness [s]."""

    def __post_init__(self) -> None:
        check_fields(self, "young_modulus", "density", above=0)
        check_fields(self, "poisson_ratio", above=-1, below=0.49)
        check_fields(self, "alpha", "beta", least=0)

    def decay(self, frequency: float) -> float:
        """Return the decay rate d = (α + β ω²) / 2 [1/s] of a mode [Hz]."""
        return (self.alpha + self.beta * (2 * math.pi * frequency) ** 2) / 2


ELASTIC_MATERIALS: dict[str, ElasticMaterial] = {
    "wood": ElasticMaterial(1.1e10, 0.25, 750.0, 60.0, 2e-6),
    "steel": ElasticMaterial(2.0e11, 0.29, 7850.0, 5.0, 3e-8),
    "iron": ElasticMaterial(2.1e11, 0.28, 8000.0, 5.0, 1e-7),
    "aluminium": ElasticMaterial(6.9e10, 0.33, 2700.0, 4.0, 5e-8),
    "glass": ElasticMaterial(6.2e10, 0.20, 2600.0, 1.0, 1e-7),
    "ceramic": ElasticMaterial(7.2e10, 0.19, 2700.0, 6.0, 1e-7),
    "plastic": ElasticMaterial(1.4e9, 0.35, 1070.0, 30.0, 1e-6),
    "polycarbonate": ElasticMaterial(2.4e9, 0.37, 1190.0, 0.5, 4e-7),
}
"""Values in use for modal sound (Wang & James, KleinPAT, 2019; aluminium: handbook, damping of its class)."""


def elastic_material(name: str | ElasticMaterial) -> ElasticMaterial:
    """Return a material by name of :data:`ELASTIC_MATERIALS` (``metal`` is steel); a material passes through."""
    if isinstance(name, ElasticMaterial):
        return name
    chosen = "steel" if name == "metal" else name
    if chosen not in ELASTIC_MATERIALS:
        raise unknown_name("elastic material", name, ELASTIC_MATERIALS)
    return ELASTIC_MATERIALS[chosen]


@dataclass(frozen=True)
class Modes:
    """Damped modes of a solid."""

    frequency: tuple[float, ...]
    """[Hz]."""
    decay: tuple[float, ...]
    """Amplitude decay rate [1/s]."""
    gain: tuple[float, ...]
    """Velocity of the surface per impulse [1/kg]: the mode's normal components where it is struck and heard."""

    def __post_init__(self) -> None:
        if not len(self.frequency) == len(self.decay) == len(self.gain) or not self.frequency:
            raise UsageError(
                f"Modes need as many frequencies as decays and gains; received {len(self.frequency)}, "
                f"{len(self.decay)} and {len(self.gain)}."
            )
        for frequency, decay, gain in self.rows():
            check_number("frequency of a mode", frequency, above=0)
            check_number("decay of a mode", decay, least=0)
            check_number("gain of a mode", gain)

    def rows(self) -> Sequence[tuple[float, float, float]]:
        """Return (frequency, decay, gain) of each mode."""
        return list(zip(self.frequency, self.decay, self.gain, strict=True))


def preset_modes(material: str | ElasticMaterial, lowest: float, count: int = 16) -> Modes:
    """Return hand-made modes for a body of a material that is known by ear only.

    The frequencies are those of a free bar, (2n + 1)² / 9 times the lowest one, up to 20 kHz; decays follow the
    material's damping, gains fall with 1/n and are 1/kg at first.
    """
    chosen = elastic_material(material)
    check_number("lowest frequency of a body that is heard (Hz)", lowest, least=20, below=20_000)
    check_number("number of modes", count, least=1, whole=True)
    # Free bar: wave numbers near (2n + 1) π / 2L, and frequencies with their square.
    every = (lowest * (2 * n + 1) ** 2 / 9 for n in range(1, count + 1))
    frequency = tuple(value for value in every if value <= 20_000)
    gain = tuple(1 / n for n in range(1, len(frequency) + 1))
    return Modes(frequency, tuple(chosen.decay(value) for value in frequency), gain)
