"""Kernels of our own for recurrent convolutions in half precision on CUDA, where Triton is installed.

Convolutions of small grids become matrix products of rows (one row per place of the grid, channels innermost), all that
a gated cell does after its convolution is one kernel, and gradients of weights wait for the last step of a sweep, to be
one product over all of them. Everywhere else, PyTorch's own operations compute the same.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

_wanted: ContextVar[bool] = ContextVar("brainbench_kernels", default=True)


def usable(x: torch.Tensor) -> bool:
    """Return whether the kernels apply to what is computed from ``x`` here: in bfloat16, on CUDA, not being traced."""
    if not x.is_cuda or not _wanted.get() or torch.compiler.is_compiling() or torch.compiler.is_exporting():
        return False
    half = torch.get_autocast_dtype("cuda") if torch.is_autocast_enabled("cuda") else x.dtype
    return half == torch.bfloat16 and _installed()


@contextmanager
def plain() -> Iterator[None]:
    """Leave everything to PyTorch's own operations, to compare with."""
    token = _wanted.set(False)
    try:
        yield
    finally:
        _wanted.reset(token)


@functools.cache
def _installed() -> bool:
    return importlib.util.find_spec("triton") is not None
