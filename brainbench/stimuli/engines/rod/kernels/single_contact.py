"""One contact alone: its normal force and friction, given how it moves without them."""

from functools import cache
from typing import Any


@cache
def contact_alone(real: type) -> Any:
    """Return ``at_contact(own6, bn, b1, b2, p0, q0, mu, tries)`` of a precision.

    ``own6`` is the compliance of the contact to its own forces (normal and two tangents: nn, n1, n2, 11, 12, 22).
    """
    import warp as wp

    vec3: Any = wp.types.vector(3, real)
    vec6: Any = wp.types.vector(6, real)

    @wp.func
    def at_contact(own6: vec6, bn: real, b1: real, b2: real, p0: real, q0: real, mu: real, tries: int) -> vec3:
        """Forces of one contact alone (normal, two tangents), given the rates without it and its last slip."""
        zero = real(0.0)
        one = real(1.0)
        nn = own6[0]
        n1 = own6[1]
        n2 = own6[2]
        c11 = own6[3]
        c12 = own6[4]
        c22 = own6[5]
        fn = zero
        f1 = zero
        f2 = zero
        if bn < zero:
            fn = -bn / nn
            if mu > zero:
                # Sticking: solve for all three, tangents eliminated first.
                det = c11 * c22 - c12 * c12
                stuck = int(0)
                if det > real(1e-9) * c11 * c22:
                    tb1 = -(c22 * b1 - c12 * b2) / det
                    tb2 = -(c11 * b2 - c12 * b1) / det
                    ta1 = -(c22 * n1 - c12 * n2) / det
                    ta2 = -(c11 * n2 - c12 * n1) / det
                    stiff = nn + n1 * ta1 + n2 * ta2
                    if stiff > real(1e-6) * nn:
                        tn = -(bn + n1 * tb1 + n2 * tb2) / stiff
                        tf1 = tb1 + ta1 * tn
                        tf2 = tb2 + ta2 * tn
                        if tn >= zero and tf1 * tf1 + tf2 * tf2 <= mu * mu * tn * tn:
                            fn = tn
                            f1 = tf1
                            f2 = tf2
                            stuck = 1
                if stuck == 0:
                    # Sliding: find the direction of slip by a fixed point.
                    f1 = p0
                    f2 = q0
                    pace = one / (c11 + c22)
                    for _ in range(tries):
                        fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
                        s1_ = f1 - pace * (b1 + n1 * fn + c11 * f1 + c12 * f2)
                        s2_ = f2 - pace * (b2 + n2 * fn + c12 * f1 + c22 * f2)
                        size = wp.sqrt(s1_ * s1_ + s2_ * s2_)
                        bound = mu * fn
                        if size > bound:
                            s1_ = s1_ * (bound / size)
                            s2_ = s2_ * (bound / size)
                        moved_by = wp.abs(f1 - s1_) + wp.abs(f2 - s2_)
                        f1 = s1_
                        f2 = s2_
                        if moved_by <= real(1e-4) * bound:
                            break
                    fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
        # Two contacts at one point may leave nothing to divide by.
        if not (fn + wp.abs(f1) + wp.abs(f2) < real(1e6)):
            fn = zero
            f1 = zero
            f2 = zero
        return vec3(fn, f1, f2)

    return at_contact
