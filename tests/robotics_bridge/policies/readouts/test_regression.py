"""Read-outs: what is linear in features is found on environments left out, what is not there is not."""

from __future__ import annotations

import numpy as np
import torch

from robotics_bridge.policies.readouts.regression import Readout, read_targets


def _made(seed: int = 0, steps: int = 40, envs: int = 20) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    wanted = torch.randn(steps, envs, 12, generator=generator)
    return torch.randn(steps, envs, 4, generator=generator), wanted, torch.ones(steps, envs, dtype=torch.bool)


def _readout(features: torch.Tensor, proprio: torch.Tensor, wanted: torch.Tensor, valid: torch.Tensor) -> Readout:
    errors, spread = read_targets(proprio, features, wanted, valid)
    return Readout("made", features.shape[-1], errors[None], spread)


def test_what_features_hold_is_read_and_what_they_do_not_hold_is_not() -> None:
    proprio, wanted, valid = _made()
    mixed = wanted[..., :6] @ torch.randn(6, 9, generator=torch.Generator().manual_seed(1)) * 1e-4
    found = _readout(mixed, proprio, wanted, valid)
    # Nine mixtures of position and velocity, however small, hold these two and nothing else.
    assert found.r2("position") > 0.99
    assert found.r2("velocity") > 0.99
    assert abs(found.r2("spin")) < 0.05
    assert abs(found.r2("contact")) < 0.05
    low, high = found.interval("position")
    assert low <= found.r2("position") <= high


def test_knowing_the_environment_does_not_help_on_others() -> None:
    proprio, wanted, valid = _made()
    wanted = wanted + 5 * torch.randn(wanted.shape[1], 12, generator=torch.Generator().manual_seed(2))
    place = torch.eye(wanted.shape[1]).expand(len(wanted), -1, -1)
    assert _readout(place, proprio, wanted, valid).r2("position") < 0.05


def test_steps_that_do_not_count_change_nothing() -> None:
    proprio, wanted, valid = _made()
    features = wanted + 0.5 * torch.randn(wanted.shape, generator=torch.Generator().manual_seed(3))
    valid[:10] = False
    first = _readout(features, proprio, wanted, valid)
    spoilt = wanted.clone()
    spoilt[:10] = 1e6
    second = _readout(features, proprio, spoilt, valid)
    np.testing.assert_array_equal(first.errors, second.errors)


def test_an_arm_differs_from_itself_by_nothing_and_draws_widen_the_interval() -> None:
    proprio, wanted, valid = _made()
    one = _readout(wanted + 0.5, proprio, wanted, valid)
    assert one.interval("spin", less=one) == (0.0, 0.0)
    other = _readout(torch.zeros_like(wanted), proprio, wanted, valid)
    both = Readout("both", 12, np.concatenate([one.errors, other.errors]), one.spread)
    low, high = both.interval("spin")
    assert high - low > 0.4
    assert both.per_draw("spin")[0] > 0.99 > 0.1 > both.per_draw("spin")[1]
