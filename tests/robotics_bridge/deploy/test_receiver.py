"""Each number counts once, whatever the order, also where numbers begin anew."""

from __future__ import annotations

import numpy as np
import pytest

from robotics_bridge.deploy.frames import COMMAND, Frame
from robotics_bridge.deploy.receiver import Receiver, SequenceWindow


@pytest.mark.parametrize("first", [0, 1, 5000, (1 << 32) - 300, (1 << 32) - 1])
def test_numbers_are_judged_as_a_list_of_all_of_them_would(first) -> None:
    random = np.random.default_rng(first % 97)
    window, seen, newest, lost, gaps = SequenceWindow(), set(), None, 0, []
    for _ in range(3000):
        # Without wrap-around, and with a memory of everything: what the window must agree with.
        number = (newest if newest is not None else first) + int(random.integers(-1200, 30))
        number = max(number, first)
        if newest is None or number > newest:
            expected = "new"
            gaps.append(0 if newest is None else number - newest - 1)
        elif newest - number >= SequenceWindow.SIZE:
            expected = "stale"
        else:
            expected = "replayed" if number in seen else "late"
        verdict, skipped = window.judge(number % (1 << 32))
        assert verdict == expected
        lost += skipped
        seen.add(number)
        newest = number if newest is None else max(newest, number)
    assert lost == sum(gaps)


def test_a_jump_by_half_of_all_numbers_takes_no_memory_and_no_number_from_behind() -> None:
    window = SequenceWindow()
    window.judge(0)
    assert window.judge((1 << 31) - 1) == ("new", (1 << 31) - 2)
    assert window.judge(0)[0] == "stale"
    assert window.judge((1 << 31) - 1)[0] == "replayed"
    assert window.judge((1 << 31) - 2)[0] == "late"


def test_old_frames_are_stale_although_their_number_is_new() -> None:
    receiver = Receiver(b"")

    def judge(number, sent, arrived):
        return receiver.judge(Frame(COMMAND, 1, 0, number, sent), arrived)[0]

    assert judge(1, 10.0, 500.0) == "new"
    assert judge(2, 10.1, 500.2) == "new"
    assert judge(3, 10.2, 500.5) == "stale"
    assert judge(4, 10.6, 500.6) == "new"
    # All numbers were used once: one that comes back is new again by number, and old by time.
    for number in (0x5000_0000, 0xA000_0000, 0xF000_0000, 1):
        verdict = judge(number, 10.61 if number == 1 else 10.6, 500.6 if number != 1 else 900.0)
    assert verdict == "stale"
