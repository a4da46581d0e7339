"""Probes are shared between threads: all are taken once."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotics_bridge.sensors import Noise
from robotics_bridge.sensors.context import ReadoutSlice
from robotics_bridge.sensors.kernels.readout import CLEAN, FUSED, STAGED
from robotics_bridge.sensors.runtime import probe_rows


def _gpu(envs: int) -> Any:
    return SimpleNamespace(num_envs=envs, device=SimpleNamespace(is_cuda=True, sm_count=132))


@given(
    counts=st.lists(st.sampled_from([1, 2, 3, 5, 31, 32, 33, 100, 1000]), min_size=1, max_size=4),
    envs=st.sampled_from([1, 64, 4096, 16_384]),
    mode=st.sampled_from([CLEAN, FUSED, STAGED]),
    cuda=st.booleans(),
)
@settings(max_examples=100)
def test_every_probe_is_taken_once_and_by_its_own_sensor(counts: list[int], envs: int, mode: int, cuda: bool) -> None:
    context = _gpu(envs)
    context.device.is_cuda = cuda
    starts = np.cumsum([0, *counts])
    slices = [ReadoutSlice("s", Noise(), int(start), (count,)) for start, count in zip(starts, counts, strict=False)]
    owner = np.full(starts[-1], -1)
    for first, end, step, part in probe_rows(slices, context, mode):
        taken = np.arange(first, end, step)
        assert taken.size
        assert (owner[taken] == -1).all()
        owner[taken] = part
    np.testing.assert_array_equal(owner, np.repeat(np.arange(len(counts)), counts))


@pytest.mark.parametrize(
    ("taxels", "mode", "expected"),
    [(1, CLEAN, 1), (100, CLEAN, 2), (1000, CLEAN, 8), (100, FUSED, 1), (1000, FUSED, 1), (10_000, FUSED, 1)],
)
def test_a_gpu_shares_as_much_as_was_fastest_when_measured(taxels: int, mode: int, expected: int) -> None:
    rows = probe_rows([ReadoutSlice("s", Noise(), 0, (taxels,))], _gpu(16_384), mode)
    assert len(rows) == -(-taxels // expected)
