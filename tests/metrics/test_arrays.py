"""Arrays are computed where they lie."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.metrics import rdm


def test_a_tensor_is_computed_where_it_lies_whatever_asks():
    patterns = torch.arange(12, dtype=torch.float32, requires_grad=True).reshape(3, 4) ** 2
    np.testing.assert_allclose(rdm(patterns), rdm(patterns.detach().numpy()), atol=1e-12)
    assert rdm(torch.arange(6).reshape(2, 3), method="sqeuclidean").tolist() == [9.0]
    assert rdm(torch.eye(3).bfloat16(), method="sqeuclidean") == pytest.approx([2 / 3] * 3)


def test_memory_that_must_not_be_written_is_read():
    patterns = np.random.default_rng(9).normal(size=(4, 6))
    patterns.setflags(write=False)
    np.testing.assert_allclose(rdm(patterns, device="cpu"), rdm(patterns), atol=1e-12)


def test_devices_that_cannot_be_used_are_named():
    with pytest.raises(UsageError, match="'gpu' is not a device"):
        rdm(np.eye(3), device="gpu")
    with pytest.raises(UsageError, match="no device 'cuda:99' here"):
        rdm(np.eye(3), device="cuda:99")
    with pytest.raises(UsageError, match="'mps' has no float64"):
        rdm(np.eye(3), device="mps")
