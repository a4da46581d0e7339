"""A scored network as tactile front end."""

from __future__ import annotations

import pytest
import torch

from brainbench import load_model
from brainbench.core.errors import DataError, UsageError
from brainbench.models.network import FORCE_SCALE, MOMENT_SCALE, Normaliser
from robotics_bridge.policies.encoders.arms import EncoderConfig
from robotics_bridge.policies.encoders.front_end import FrontEnd, HandCalibration, Resampler
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid


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


GRID = TaxelGrid("xhand1", placement="tips", resolution="low")
NAME = "zhuang-intersection-ln-small"


def _touch(batch: int, steps: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(steps, batch, 5, GRID.items, 6, generator=generator) * torch.tensor([0.2] * 3 + [2e-3] * 3)


def _stream(front: FrontEnd, touch: torch.Tensor) -> torch.Tensor:
    h, found = front.init_state(touch.shape[1]), []
    for x in touch:
        features, h = front(x, h)
        found.append(features)
    return torch.stack(found)


def test_the_stream_equals_the_networks_own_answer_to_the_whole_sweep() -> None:
    front = FrontEnd(NAME, GRID)
    touch = _touch(2, 8)
    features = _stream(front, touch)
    sweep = torch.stack([front.stimulus(x) for x in touch], 1)
    with torch.no_grad():
        expected = load_model(NAME).encode(sweep)
    torch.testing.assert_close(features, expected.transpose(0, 1), atol=1e-5, rtol=1e-4)


def test_a_reset_row_starts_anew_and_its_neighbour_does_not_notice() -> None:
    front = FrontEnd("zhuang-small", GRID, time="resampled")
    touch = _touch(2, 12)
    unbroken = _stream(front, touch)
    h = front.init_state(2)
    for step, x in enumerate(touch):
        if step == 5:
            h = h.clone()
            h[0] = 0
        features, h = front(x, h)
        torch.testing.assert_close(features[1], unbroken[step, 1])
    fresh = _stream(front, touch[5:, :1])
    torch.testing.assert_close(features[0], fresh[-1, 0])


def test_resampled_features_are_those_of_the_sweep_at_the_encoders_own_rate() -> None:
    front = FrontEnd("s4-small", GRID, time="resampled")
    touch = _touch(1, 18)
    features = _stream(front, touch)
    # Ten steps of 45 ms end in 18 control steps; interpolate the whole recording at once.
    stimulus = torch.stack([front.stimulus(x) for x in touch], 1).view(1, 90, 6, 5, 7)
    stimulus = torch.cat((torch.zeros(1, 1, 6, 5, 7), stimulus), 1)
    place = torch.arange(1, 51, dtype=torch.float64) * 9 / 5
    low = place.floor().long()
    share = (place - low).float().view(1, -1, 1, 1, 1)
    high = (low + 1).clamp(max=90)
    sampled = stimulus[:, low] * (1 - share) + stimulus[:, high] * share
    with torch.no_grad():
        expected = load_model("s4-small").encode(sampled.reshape(1, 10, 30, 5, 7))[0]
    assert not features[0].any()  # nothing complete yet: 45 ms take two control steps
    done = torch.arange(1, 19) * 5 // 9
    for tick in range(1, 18):
        torch.testing.assert_close(features[tick, 0], expected[done[tick] - 1], atol=1e-4, rtol=1e-3)


def test_forces_of_the_calibration_reach_the_network_as_ones() -> None:
    calibration = HandCalibration(force=0.3, moment=4e-3)
    front = FrontEnd("zhuang-small", GRID, calibration=calibration)
    seen = front.stimulus(torch.zeros(1, 5, GRID.items, 6))
    assert not seen.any()
    image = GRID(_touch(1, 1)[0])
    normalised = front.step.model.normaliser(front.stimulus(_touch(1, 1)[0])).view(5, 6, 5, 7)
    torch.testing.assert_close(normalised[:, :3], image.view(5, 6, 5, 7)[:, :3] / 0.3)
    torch.testing.assert_close(normalised[:, 3:], image.view(5, 6, 5, 7)[:, 3:] / 4e-3)


def test_the_networks_own_normaliser_acts_per_channel() -> None:
    network = load_model("zhuang-small")
    scale = [FORCE_SCALE * (1 + i) for i in range(30)]
    network.normaliser = Normaliser(scale)
    front = FrontEnd(network, GRID)
    plain = FrontEnd("zhuang-small", GRID)
    touch = _touch(1, 1)[0]
    ours, theirs = (f.step.model.normaliser(f.stimulus(touch)) for f in (front, plain))
    ratio = torch.tensor(Normaliser.physical().scale.flatten().tolist()) / torch.tensor(scale)
    torch.testing.assert_close(ours, theirs * ratio.view(-1, 1, 1))


def test_a_fitted_calibration_gives_touched_sites_unit_size() -> None:
    generator = torch.Generator().manual_seed(0)
    grid = torch.randn(200, 30, 5, 7, generator=generator).view(200, 5, 6, 5, 7)
    grid[:, :, :3] *= 0.7
    grid[:, :, 3:] *= 0.004
    grid[..., 3:] = 0  # sites that nothing touches do not count
    found = HandCalibration.fit(grid.flatten(1, 2))
    assert found.force == pytest.approx(0.7, rel=0.02)
    assert found.moment == pytest.approx(0.004, rel=0.02)
    gains = found.gains(5)
    assert gains[0] == pytest.approx(FORCE_SCALE / found.force)
    assert gains[29] == pytest.approx(MOMENT_SCALE / found.moment)
    with pytest.raises(DataError, match="Nothing touches"):
        HandCalibration.fit(torch.zeros(3, 30, 5, 7))
    with pytest.raises(DataError, match="not finite"):
        HandCalibration.fit(torch.full((3, 30, 5, 7), torch.nan))
    with pytest.raises(UsageError, match=r"force .*received -1"):
        HandCalibration(force=-1)
    with pytest.raises(UsageError, match=r"calibration 'mass'.*'force', 'moment'"):
        EncoderConfig.of({"name": NAME, "calibration": {"mass": 1}})


def test_a_frozen_network_learns_nothing_and_a_finetuned_one_does() -> None:
    frozen, tuned = FrontEnd("zhuang-small", GRID), FrontEnd("zhuang-small", GRID, learning="finetuned")
    touch = _touch(1, 5)
    assert not _stream(frozen, touch).requires_grad
    assert not frozen.train().step.training
    assert tuned.train().step.training
    _stream(tuned, touch)[-1].sum().backward()
    moved = [name for name, p in tuned.named_parameters() if p.grad is not None and p.grad.any()]
    assert any("conv1" in name for name in moved)
    assert not any("decoder" in name for name in moved)


def test_seeds_make_random_encoders_and_nothing_else_does() -> None:
    touch = _touch(1, 5)
    first, same, other = (_stream(FrontEnd(NAME, GRID, seed=seed), touch)[-1] for seed in (3, 3, 4))
    torch.testing.assert_close(first, same, rtol=0, atol=0)
    assert (first - other).abs().max() > 1e-3


def test_unsuited_networks_and_names_are_refused() -> None:
    with pytest.raises(UsageError, match=r"32 steps.*'gpt'"):
        FrontEnd("zhuang-small+gpt", GRID)
    with pytest.raises(UsageError, match="did you mean 'frozen'"):
        FrontEnd("zhuang-small", GRID, learning="froze")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="did you mean 'resampled'"):
        FrontEnd("zhuang-small", GRID, time="resample")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="received 'Linear'"):
        FrontEnd(torch.nn.Linear(3, 3), GRID)
    with pytest.raises(UsageError, match="5 sub-steps; received 4"):
        FrontEnd("zhuang-small", GRID).stimulus(torch.zeros(1, 4, GRID.items, 6))
