"""Numbers without their last digits are the same on every processor."""

import numpy as np
import pytest

from brainbench.core.files import BITS, content_hash, portable, without_last_digits


@pytest.mark.parametrize("start", [0.1, 0.25, 1.0, 0.029, 123.456, 3e9, 1.7e-5])
def test_neighbours_become_one_number(start):
    values = start * (1 + 2.0**-52 * np.arange(-4, 5))
    assert len(set(without_last_digits(values).tolist())) == 1
    assert without_last_digits(start) == pytest.approx(start, rel=2.0**-BITS)


def test_what_differs_in_the_ninth_digit_stays_different():
    assert without_last_digits(1.0) != without_last_digits(1 + 1e-9)


def test_what_a_quarter_turn_leaves_is_zero():
    assert without_last_digits(np.cos(np.pi / 2)) == 0
    assert np.signbit(without_last_digits(-0.0)).item() is False


def test_plain_values_keep_all_but_their_last_digits():
    value = {"name": "a", "count": 3, "part": [0.1 + 0.2, [1, 2.5], None, True], "missing": float("nan")}
    assert portable(value) == {"name": "a", "count": 3, "part": [portable(0.3), [1, 2.5], None, True], "missing": None}
    assert content_hash(portable([0.1 + 0.2])) == content_hash(portable([0.3]))
