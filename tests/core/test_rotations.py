"""Rotations of batches, against SciPy."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainbench.core import rotations as r


def _draw(seed: int, count: int = 5) -> tuple[torch.Tensor, Rotation]:
    turn = Rotation.random(count, random_state=np.random.default_rng(seed))
    return torch.as_tensor(turn.as_quat(scalar_first=True)), turn


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_products_and_turned_vectors_agree_with_scipy(seed: int) -> None:
    a, turn_a = _draw(seed)
    b, turn_b = _draw(seed + 1)
    v = torch.as_tensor(np.random.default_rng(seed).normal(size=(5, 3)))
    product = Rotation.from_quat(r.multiply(a, b).numpy(), scalar_first=True)
    assert (product * (turn_a * turn_b).inv()).magnitude().max() < 1e-12
    np.testing.assert_allclose(r.rotate(a, v).numpy(), turn_a.apply(v.numpy()), atol=1e-12)
    np.testing.assert_allclose(r.rotate(r.conjugate(a), r.rotate(a, v)).numpy(), v.numpy(), atol=1e-12)
    np.testing.assert_allclose(r.angle_of(a).numpy(), turn_a.magnitude(), atol=1e-9)
    np.testing.assert_allclose(
        r.six_numbers(a).numpy(), turn_a.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(5, 6), atol=1e-12
    )


@settings(max_examples=20)
@given(st.floats(-3.0, 3.0), st.floats(0.0, 1.5), st.floats(0.0, 6.28))
def test_a_turn_splits_into_the_twist_and_swing_it_was_made_of(twist: float, swing: float, where: float) -> None:
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    aside = torch.tensor([np.cos(where), np.sin(where), 0.0], dtype=torch.float64)
    made = r.multiply(
        r.about(aside, torch.tensor(swing, dtype=torch.float64)),
        r.about(axis, torch.tensor(twist, dtype=torch.float64)),
    )
    found_twist, found_swing = r.twist_and_swing(made, axis)
    assert abs(float(found_twist) - twist) < 1e-6
    assert abs(float(found_swing) - swing) < 1e-6


def test_tilting_turns_about_x_first_then_about_the_fixed_y() -> None:
    x, y = torch.tensor([0.3]), torch.tensor([-0.5])
    expected = Rotation.from_euler("xy", [0.3, -0.5]).as_matrix()
    found = Rotation.from_quat(r.tilted(x, y).double().numpy(), scalar_first=True).as_matrix()[0]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_twist_of_a_turn_is_what_lies_about_an_axis() -> None:
    generator = torch.Generator().manual_seed(1)
    q = torch.nn.functional.normalize(torch.randn(200, 4, generator=generator), dim=1)
    axis = torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=1)
    twist = r.twist_of(q, axis)
    angle, swing = r.twist_and_swing(q, axis)
    torch.testing.assert_close(r.rotate(twist, axis), axis, atol=1e-5, rtol=0)
    torch.testing.assert_close(r.angle_of(twist), angle.abs(), atol=1e-3, rtol=0)
    # The rest is the swing, and no other turn about the axis leaves less.
    rest = r.angle_of(r.multiply(q, r.conjugate(twist)))
    torch.testing.assert_close(rest, swing, atol=2e-3, rtol=0)
    for more in (-0.2, 0.2):
        other = r.multiply(twist, r.about(axis, torch.full((200,), more)))
        assert bool((r.angle_of(r.multiply(q, r.conjugate(other))) > rest - 1e-4).all())
    # Without an axis, and for a half turn across it, there is none.
    still = torch.tensor([1.0, 0.0, 0.0, 0.0])
    assert torch.equal(r.twist_of(q, torch.zeros(200, 3)), still.expand(200, 4))
    assert torch.equal(r.twist_of(torch.tensor([0.0, 1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])), still)
