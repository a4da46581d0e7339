"""Windows of a convolution are those of PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch.nn import functional

from brainbench.models.ops import convolution
from brainbench.models.ops.layers import Conv2d


def _unfolded_by_pytorch(inputs: Sequence[torch.Tensor], geometry: convolution.ConvolutionShape) -> torch.Tensor:
    x = torch.cat([item.float() for item in inputs], 1)
    (top, left), (rows, columns) = geometry.pads, geometry.kernel
    down = geometry.out[0] + rows - 1 - top - x.shape[2]
    right = geometry.out[1] + columns - 1 - left - x.shape[3]
    windows = functional.unfold(functional.pad(x, (left, right, top, down)), geometry.kernel)  # [B, C · taps, places]
    return windows.unflatten(1, (x.shape[1], -1)).permute(0, 3, 2, 1).flatten(2).flatten(0, 1).to(convolution.HALF)


@pytest.mark.parametrize(
    ("kernel", "padding"), [((2, 2), "same"), ((2, 2), "valid"), ((3, 2), "same"), ((3, 3), (1, 1))]
)
def test_windows_are_those_of_pytorch(kernel: tuple[int, int], padding: Any, single: torch.device) -> None:
    conv = Conv2d(7, 5, kernel_size=kernel, padding=padding).to(single)
    inputs = [torch.randn(3, 4, 4, 6, device=single).to(memory_format=torch.channels_last)]
    inputs.append(torch.randn(3, 3, 4, 6, device=single))
    geometry = convolution.ConvolutionShape.of(conv, (4, 6))
    windows = convolution.unfolded(inputs, geometry)
    torch.testing.assert_close(windows, _unfolded_by_pytorch(inputs, geometry).float(), rtol=1e-2, atol=1e-2)
    with torch.no_grad():
        torch.testing.assert_close(convolution.convolve(conv, inputs), conv(torch.cat(inputs, 1)), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("channels", [(8, 16), (2, 6, 4), (16,), (3, 1, 2, 5, 1, 4)])
def test_windows_of_any_number_of_inputs_lie_side_by_side(channels: tuple[int, ...], single: torch.device) -> None:
    conv = Conv2d(sum(channels), 3, kernel_size=(2, 2), padding="same").to(single)
    # One of single, the others of half precision; one is part of a larger map.
    inputs = [torch.randn(5, 4, 6, count, device=single).permute(0, 3, 1, 2) for count in channels]
    inputs[1:] = [x.bfloat16() for x in inputs[1:]]
    inputs[0] = torch.cat((inputs[0], inputs[0]), 1)[:, : channels[0]]
    geometry = convolution.ConvolutionShape.of(conv, (4, 6))
    windows = convolution.unfolded(inputs, geometry)
    assert windows.shape == (5 * 24, 4 * sum(channels))
    expected = _unfolded_by_pytorch(inputs, geometry).float()
    torch.testing.assert_close(windows.float(), expected, rtol=1e-2, atol=1e-2)
