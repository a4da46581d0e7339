"""The short series of the sensor kernels, against numpy in double precision."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

TINY, HUGE = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)
NORMAL = st.floats(TINY, HUGE, width=32)
EXPONENTS = (0.5, 1.0, 1.2, 1.5, 2.0, 3.0)


@cache
def _kernels() -> SimpleNamespace:
    from brainbench.core.devices import warp
    from robotics_bridge.sensors.kernels.noise import decay, normals, power, power_of_two, split_log

    wp = warp()

    @wp.kernel(module="unique", enable_backward=False)
    def split(x: wp.array(dtype=float), out: wp.array(dtype=wp.vec2)):
        i = wp.tid()
        out[i] = split_log(x[i])

    @wp.kernel(module="unique", enable_backward=False)
    def two(whole: wp.array(dtype=float), rest: wp.array(dtype=float), out: wp.array(dtype=float)):
        i = wp.tid()
        out[i] = power_of_two(whole[i], rest[i])

    @wp.kernel(module="unique", enable_backward=False)
    def raised(x: wp.array(dtype=float), exponent: wp.array(dtype=float), out: wp.array(dtype=float)):
        i = wp.tid()
        out[i] = power(x[i], exponent[i])

    @wp.kernel(module="unique", enable_backward=False)
    def faded(t: wp.array(dtype=float), out: wp.array(dtype=float)):
        i = wp.tid()
        out[i] = decay(t[i])

    @wp.kernel(module="unique", enable_backward=False)
    def drawn(first: wp.array(dtype=wp.uint32), second: wp.array(dtype=wp.uint32), out: wp.array(dtype=wp.vec2)):
        i = wp.tid()
        out[i] = normals(first[i], second[i])

    return SimpleNamespace(split=split, two=two, raised=raised, faded=faded, drawn=drawn)


def _run(name: str, *values: np.ndarray, pairs: bool = False) -> np.ndarray:
    from brainbench.core.devices import warp

    wp = warp()
    inputs = [wp.array(np.atleast_1d(value), device="cpu") for value in values]
    out = wp.zeros(len(inputs[0]), dtype=wp.vec2 if pairs else float, device="cpu")
    wp.launch(getattr(_kernels(), name), dim=len(inputs[0]), inputs=[*inputs, out], device="cpu")
    return out.numpy().astype(float)


def _all_scales(count: int = 2000) -> np.ndarray:
    """Normal positive numbers of every binary order of magnitude."""
    mantissa = np.random.default_rng(0).integers(0, 1 << 23, (254, count), dtype=np.uint32)
    mantissa[:, :3] = 0, 1, (1 << 23) - 1
    return (mantissa | (np.arange(1, 255, dtype=np.uint32)[:, None] << 23)).ravel().view(np.float32)


def test_logarithms_are_right_over_the_whole_range() -> None:
    x = _all_scales()
    e, rest = _run("split", x, pairs=True).T
    assert np.all(np.abs(rest) <= 0.5 * np.log(2) + 1e-6)
    exact = np.log(np.ldexp(x.astype(float), -e.astype(int)))
    np.testing.assert_allclose(rest, exact, rtol=3e-7, atol=1e-12)


@given(NORMAL)
@settings(max_examples=200)
def test_the_logarithm_of_any_normal_number_is_right(x: float) -> None:
    e, rest = _run("split", np.float32(x), pairs=True)[0]
    assert e * np.log(2) + rest == pytest.approx(np.log(x), rel=3e-7, abs=1e-12)


def test_powers_of_two_are_right_over_the_whole_range_and_end_in_zero_and_infinity() -> None:
    rng = np.random.default_rng(0)
    whole = np.repeat(np.arange(-126, 127), 500).astype(np.float32)
    rest = rng.uniform(-0.5, 0.5, whole.size).astype(np.float32)
    exact = np.exp2(whole.astype(float) + rest)
    kept = exact >= TINY
    np.testing.assert_allclose(_run("two", whole, rest)[kept], exact[kept], rtol=3e-7)
    np.testing.assert_array_equal(_run("two", whole, 0 * rest), np.exp2(whole.astype(float)))
    ends = np.array([-1000, -300, -151, 129, 300, 1000], np.float32)
    np.testing.assert_array_equal(_run("two", ends, 0 * ends), [0, 0, 0, np.inf, np.inf, np.inf])


def test_powers_are_right_over_the_whole_range() -> None:
    x = _all_scales(600)
    for exponent in EXPONENTS:
        exact = x.astype(float) ** float(np.float32(exponent))
        kept = (exact >= TINY) & (exact <= HUGE)
        found = _run("raised", x, np.full_like(x, exponent))
        np.testing.assert_allclose(found[kept], exact[kept], rtol=3e-7, err_msg=str(exponent))
        assert not found[exact < 1e-46].any()
        assert np.isinf(found[exact > 2.0**129]).all()


@given(NORMAL, st.floats(0.25, 4.0, width=32))
@settings(max_examples=200)
def test_any_power_of_any_normal_number_is_right(x: float, exponent: float) -> None:
    exact = float(np.exp(min(exponent * np.log(x), 200.0)))
    if TINY <= exact <= HUGE:
        assert _run("raised", np.float32(x), np.float32(exponent))[0] == pytest.approx(exact, rel=3e-7)


def test_the_first_power_changes_no_bit() -> None:
    x = _all_scales(50)
    np.testing.assert_array_equal(_run("raised", x, np.ones_like(x)), x)


def test_memories_fade_exponentially() -> None:
    t = np.concatenate([np.linspace(0, 80, 100_001), [0, 1e3, 1e30]]).astype(np.float32)
    found = _run("faded", t)
    np.testing.assert_allclose(found[:-2], np.exp(-t[:-2].astype(float)), rtol=6e-6)
    assert found[-3] == 1
    np.testing.assert_array_equal(found[-2:], 0)


def test_normal_numbers_are_those_of_box_and_muller() -> None:
    words = np.random.default_rng(0).integers(0, 1 << 32, (2, 200_000), dtype=np.uint32)
    words[0, :4] = 0, 1, (1 << 32) - 1, 1 << 31
    found = _run("drawn", *words, pairs=True)
    # The uniform number is rounded to single precision first.
    length = np.sqrt(-2 * np.log((words[0] | 1).astype(np.float32).astype(float) / 2.0**32))
    within = ((words[1] >> 7 & 0x7FFFFF) - 4194303.5) * np.pi / 2**24
    angle = within + (words[1] >> 30) * np.pi / 2
    exact = np.stack([length * np.cos(angle), length * np.sin(angle)], axis=1)
    np.testing.assert_allclose(found, exact, atol=2e-6)
