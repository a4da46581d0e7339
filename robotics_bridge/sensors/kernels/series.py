"""Logarithm, exponential and power as short series, the same on every device and cheaper than its library's.

Coefficients are minimax fits of ours in float32; relative errors stay below 3e-7.
"""

from brainbench.core.devices import warp

wp = warp()


@wp.func
def split_log(x: float) -> wp.vec2:
    """Return (e, ln f) with x = f 2^e and f in [√½, √2), for positive normal numbers."""
    # Subtracting the bits of √½ before the shift puts f in [√½, √2): ln f stays small and the polynomial in f − 1
    # short.
    bits = wp.cast(x, wp.int32)
    e = (bits - wp.int32(0x3F3504F3)) >> wp.int32(23)
    s = wp.cast(bits - (e << wp.int32(23)), wp.float32) - float(1.0)
    inner = float(0.118881621) + s * (float(-0.116756515) + s * float(0.0674664))
    inner = float(-0.166679964) + s * (float(0.142195523) + s * (float(-0.124055892) + s * inner))
    inner = float(0.333333135) + s * (float(-0.250000089) + s * (float(0.200021192) + s * inner))
    # The leading terms s − s²/2 are added last, when the rest is already small: less rounding than plain Horner.
    q = s * s
    return wp.vec2(float(e), s + q * (s * inner - float(0.5)))


@wp.func
def power_of_two(whole: float, rest: float) -> float:
    """Return 2^(whole + rest), 0 or infinity where that is beyond the range."""
    n = wp.clamp(wp.rint(whole + rest), float(-250.0), float(250.0))
    # The integer part is removed first, which is exact; 2^r is then a polynomial on [−½, ½].
    r = (whole - n) + rest
    inner = float(0.009618004) + r * (float(0.001340027) + r * float(0.000154763))
    inner = float(0.69314718) + r * (float(0.240226507) + r * (float(0.055503279) + r * inner))
    # Two factors reach further than one.
    half = int(n) >> 1
    first = wp.cast((half + 127) << 23, wp.float32)
    second = wp.cast((int(n) - half + 127) << 23, wp.float32)
    return (float(1.0) + r * inner) * first * second


@wp.func
def power(x: float, exponent: float) -> float:
    """Return x^exponent of a positive number."""
    if exponent == float(1.0):
        return x
    split = split_log(x)
    # The leading bits of the exponent times a small integer are exact.
    leading = wp.cast(wp.cast(exponent, wp.int32) & wp.int32(-4096), wp.float32)
    rest = (exponent - leading) * split[0] + exponent * (split[1] * float(1.4426950408889634))
    return power_of_two(leading * split[0], rest)
