"""Networks that answer one stimulus at a time fastest, on the CPU.

A streaming step multiplies every weight with a handful of numbers, so it is bound by reading the weights. A packed
network keeps them a second time, in the order (and, if asked, the half precision) that is read and multiplied fastest.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

from brainbench.core.errors import UsageError, check_name

if TYPE_CHECKING:
    from torch import nn

PRECISIONS = ("float32", "bf16")


def packed(model: nn.Module, *, precision: str = "float32") -> nn.Module:
    """Return a copy of a network, in evaluation mode, whose steps for one stimulus are faster.

    ``float32`` equals the network to rounding; with ``bf16`` weights and what they are multiplied with are rounded to 8
    bits of mantissa, memories and everything else stay in single precision.

    Batches of two and more are computed as before, in single precision. The copy does not notice later changes of its
    weights: pack again after training.
    """
    import torch

    from brainbench.models.ops.layers import Conv2d, Linear

    check_name("precision of packed weights", precision, PRECISIONS)
    if any(parameter.device.type != "cpu" for parameter in model.parameters()):
        raise UsageError("Only networks on the CPU are packed; call .cpu() first.")
    faster = copy.deepcopy(model).eval().requires_grad_(False)
    for module in faster.modules():
        if isinstance(module, (Conv2d, Linear)):
            module.pack(torch.bfloat16 if precision == "bf16" else torch.float32)
    return faster
