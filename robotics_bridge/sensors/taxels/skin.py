"""Stiffness of kinematic taxels from the material of the skin that they lie below."""

from __future__ import annotations

from dataclasses import dataclass

from brainbench.core.reading.ranges import check_fields, check_number


@dataclass(frozen=True, kw_only=True)
class Skin:
    """A thin elastic layer bonded to a rigid base, thin beside the contact (Johnson 1985, Contact Mechanics, 5.8).

    It cannot widen, so a pressure p presses it in by δ = p t / M with the constrained modulus
    M = E (1 − ν) / ((1 + ν) (1 − 2ν)), and shear gives way by G = E / (2 (1 + ν)). Taxels are placed on the base.
    """

    thickness: float
    """t (m)."""
    modulus: float
    """Young's modulus E (Pa)."""
    poisson: float = 0.45
    """ν."""

    def __post_init__(self) -> None:
        check_fields(self, "thickness", "modulus", above=0)
        check_fields(self, "poisson", least=0, most=0.49)

    def law(self, area: float) -> dict[str, float]:
        """Return the settings of ``KinematicTaxel`` for taxels that take up an area (m²) each.

        Example::

            skin = Skin(thickness=2e-3, modulus=1e5)
            base = Probes.grid(8, 8, size=(0.014, 0.014), center=(0, 0, -skin.thickness), radius=skin.thickness)
            KinematicTaxel(link="tip", probes=base, **skin.law(0.002**2))
        """
        check_number("area (m²)", area, above=0)
        ratio = (1 - 2 * self.poisson) / (2 * (1 - self.poisson))
        constrained = self.modulus / (2 * (1 + self.poisson) * ratio)
        return {"stiffness": constrained * area / self.thickness, "exponent": 1.0, "damping": 0.0, "grip": ratio}
