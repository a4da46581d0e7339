"""Stiffness of kinematic taxels from the material of the skin that they lie below."""

from __future__ import annotations

from dataclasses import dataclass

from brainbench.core.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class Skin:
    """A thin elastic layer bonded to a rigid base, thin beside the contact (Johnson 1985, Contact Mechanics, 5.8).

    It cannot widen, so a pressure p presses it in by δ = p t / M with the constrained modulus
    M = E (1 − ν) / ((1 + ν) (1 − 2ν)), and shear gives way by G = E / (2 (1 + ν)). Taxels are placed on the base.

    Raises:
        UsageError: a number lies outside its range; the layer's stiffness has no end as ν nears ½.
    """

    thickness: float
    """t (m)."""
    modulus: float
    """Young's modulus E (Pa)."""
    poisson: float = 0.45
    """ν."""

    def __post_init__(self) -> None:
        if not (self.thickness > 0 and self.modulus > 0 and 0 <= self.poisson <= 0.49):
            raise UsageError(
                "A skin has a positive thickness (m) and modulus (Pa) and a Poisson ratio of 0 to 0.49; received "
                f"thickness={self.thickness!r}, modulus={self.modulus!r} and poisson={self.poisson!r}."
            )

    def law(self, area: float) -> dict[str, float]:
        """Return the settings of ``KinematicTaxel`` for taxels that take up an area (m²) each.

        Example::

            skin = Skin(thickness=2e-3, modulus=1e5)
            base = Probes.grid(8, 8, size=(0.014, 0.014), center=(0, 0, -skin.thickness), radius=skin.thickness)
            KinematicTaxel(link="tip", probes=base, **skin.law(0.002**2))
        """
        if not area > 0:
            raise UsageError(f"The area of a taxel is positive (m²); received {area!r}.")
        ratio = (1 - 2 * self.poisson) / (2 * (1 - self.poisson))
        constrained = self.modulus / (2 * (1 + self.poisson) * ratio)
        return {"stiffness": constrained * area / self.thickness, "exponent": 1.0, "damping": 0.0, "grip": ratio}
