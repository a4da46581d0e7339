"""The encoder's clock against that of control."""

from __future__ import annotations

import pytest
import torch

from robotics_bridge.policies.encoders.timing import Resampler


def _run(resampler: Resampler, signal, ticks: int) -> list[tuple[int, torch.Tensor]]:
    """Feed signal(t) [V]; return (tick, step [S, V]) of every completed step."""
    state = torch.zeros(1, resampler.state_size)
    found = []
    for tick in range(1, ticks + 1):
        times = 0.005 * torch.arange(5 * (tick - 1) + 1, 5 * tick + 1)
        step, new, state = resampler(signal(times)[None], state)
        if bool(new):
            found.append((tick, step[0]))
    return found


def test_a_ramp_is_read_exactly_at_the_encoders_own_times() -> None:
    found = _run(Resampler(2), lambda t: torch.stack([t, 3 * t], 1), 90)
    # 45 ms take 1.8 control steps: five steps end in every nine.
    assert [tick for tick, _ in found] == [-(-9 * m // 5) for m in range(1, 51)]
    for number, (_, step) in enumerate(found):
        times = 0.045 * number + 0.009 * torch.arange(1, 6)
        torch.testing.assert_close(step, torch.stack([times, 3 * times], 1), atol=1e-5, rtol=1e-5)


def test_before_the_reset_nothing_touched() -> None:
    (_, step), *_rest = _run(Resampler(1), lambda t: torch.ones_like(t)[:, None], 2)
    torch.testing.assert_close(step, torch.ones(5, 1))  # from 9 ms on; the first reading is that of 5 ms


@pytest.mark.parametrize("frequency", [2.0, 8.0])
def test_waves_are_kept_within_the_error_of_linear_interpolation(frequency) -> None:
    omega = 2 * torch.pi * frequency
    found = _run(Resampler(1), lambda t: torch.sin(omega * t)[:, None], 45)
    times = 0.009 * torch.arange(1, 5 * len(found) + 1)
    error = (torch.cat([step for _, step in found])[:, 0] - torch.sin(omega * times)).abs().max()
    assert error <= (omega * 0.005) ** 2 / 8 + 1e-5


def test_rows_keep_their_own_clock() -> None:
    resampler = Resampler(1)
    state = torch.zeros(2, resampler.state_size)
    for _ in range(3):
        _, _, state = resampler(torch.ones(2, 5, 1), state)
    state[1] = 0  # the reset of one environment
    after = [resampler(torch.ones(2, 5, 1), state)[1]]
    assert after[0].tolist() == [[True], [False]]
