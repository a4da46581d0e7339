"""One whisker: a tapered, intrinsically curved elastic rod.

The base frame has its origin at the base point; the whisker leaves along +x and curves in the x-y
plane with its concave side towards +y. Arc length s runs from 0 at the base to L at the tip. SI units.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.core.limits import Limit, NotNegative, limited
from brainbench.core.rotations import Length

SOFTEST = 1e3
"""Young's modulus [Pa] below which a number looks like gigapascals."""
LIGHTEST = 10.0
"""Density [kg/m³] below which a number looks like grams per cubic centimetre."""

_Density = Annotated[float, Limit(least=LIGHTEST, unit="kg/m³")]


@dataclass(frozen=True)
@limited(of="{} of a whisker")
class Whisker:
    """Geometry and material of one whisker.

    Radius and density vary linearly with arc length; the cross-section is a solid circle. The rest
    shape is the parabola y = A x² (A = ``curvature``), measured along its arc.
    """

    arc_length: Length
    """Length along the centre line L [m]."""
    base_radius: Length
    """Radius at the base [m]."""
    tip_radius: Length
    """Radius at the tip [m]; positive, because a real tip is cut or worn and a point has no stiffness."""
    young_modulus: Annotated[float, Limit(least=SOFTEST, unit="Pa")]
    """Young's modulus E [Pa]."""
    density: _Density | tuple[_Density, _Density]
    """Mass density [kg/m³], one number or (base, tip)."""
    damping_ratio: NotNegative
    """Fraction of critical damping of the first bending mode (stiffness-proportional damping)."""
    curvature: Annotated[float, Limit(unit="1/m")] = 0.0
    """Coefficient A of the rest shape y = A x² [1/m]; negative bends towards −y."""
    friction: NotNegative = 0.48
    """Coulomb coefficient against objects that bring none of their own; .48 was measured on steel."""
    poisson_ratio: Annotated[float, Limit(above=-1, most=0.5)] = field(default=0.4, metadata={"later": True})
    """Poisson's ratio ν, above −1 and at most .5: the shear modulus is G = E/(2 (1 + ν)). Not measured on whiskers; .4
    is usual for polymers. Along its axis human hair twists more easily still: E = 3.9, G = .9 GPa (Robbins 2012)."""

    def __post_init__(self) -> None:
        if isinstance(self.density, (tuple, list)):
            object.__setattr__(self, "density", (float(self.density[0]), float(self.density[1])))
        thickest = max(self.base_radius, self.tip_radius)
        if thickest > self.arc_length / 5:
            raise UsageError(
                f"A whisker of arc length {self.arc_length:g} m with radius {thickest:g} m"
                " is no slender rod (radius above a fifth of the length); all lengths are in metres."
            )

    @property
    def densities(self) -> tuple[float, float]:
        """Density at base and tip [kg/m³]."""
        return self.density if isinstance(self.density, tuple) else (float(self.density), float(self.density))

    @property
    def mass(self) -> float:
        """Mass of the whole whisker [kg], the integral of ρ π r² (exact)."""
        (low, high), slope = self.densities, self.tip_radius - self.base_radius
        # In powers of s/L.
        area = Polynomial([np.pi * self.base_radius**2, 2 * np.pi * self.base_radius * slope, np.pi * slope**2])
        return float((area * Polynomial([low, high - low])).integ()(1.0)) * self.arc_length

    def radius(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the radius [m] at arc length ``s`` [m]."""
        return self.base_radius + (self.tip_radius - self.base_radius) * self._fraction(s)

    def bending_stiffness(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the flexural rigidity E I [N·m²] at arc length ``s`` [m], with the second moment I = π r⁴/4."""
        return self.young_modulus * (np.pi * self.radius(s) ** 4 / 4)

    @property
    def torsion_ratio(self) -> float:
        """Torsional over flexural rigidity, G J/(E I) = 1/(1 + ν): J = π r⁴/2 is twice the second moment I."""
        return 1 / (1 + self.poisson_ratio)

    def torsional_stiffness(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the torsional rigidity G J [N·m²] at arc length ``s`` [m]."""
        return self.torsion_ratio * self.bending_stiffness(s)

    def linear_density(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the mass per length ρ π r² [kg/m] at arc length ``s`` [m]."""
        base, tip = self.densities
        return (base + (tip - base) * self._fraction(s)) * np.pi * self.radius(s) ** 2

    def centre_line(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the rest positions (x, y) [..., 2] in the base frame [m] at arc length ``s`` [m]."""
        x = self._abscissa(s)
        return np.stack([x, self.curvature * x**2], axis=-1)

    def tangent_angle(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the angle of the rest centre line against +x [rad] at arc length ``s`` [m]."""
        return np.arctan(2 * self.curvature * self._abscissa(s))

    def _abscissa(self, s: ArrayLike) -> NDArray[np.float64]:
        """Invert s(x) = (u √(1+u²) + asinh u)/(4A), u = 2 A x, by Newton's method."""
        s = np.asarray(s, dtype=float)
        target = 4 * self.curvature * s
        # So nearly straight, arc and abscissa are equal to rounding, and the end of this function would divide by 0.
        if abs(self.curvature) * self.arc_length < 1e-9:
            return s.copy()
        # Both bounds lie beyond the root of this convex function, so Newton's method descends to it.
        u = np.sign(target) * np.minimum(np.abs(target) / 2, np.sqrt(np.abs(target)))
        for _ in range(50):
            root = np.sqrt(1 + u**2)
            step = (u * root + np.arcsinh(u) - target) / (2 * root)
            u = u - step
            if np.all(np.abs(step) <= 1e-15 * (1 + np.abs(u))):
                break
        return u / (2 * self.curvature)

    def _fraction(self, s: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(s, dtype=float) / self.arc_length
