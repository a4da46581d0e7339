"""Kernels on a GPU if there is one, else by Triton's interpreter; skipped where Triton is not installed."""

import os
from collections.abc import Iterator

import pytest
import torch

from brainbench.models.ops import dispatch


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Where the kernels run."""
    if torch.cuda.is_available():
        pytest.importorskip("triton")
        yield torch.device("cuda")
        return
    os.environ.setdefault("TRITON_INTERPRET", "1")
    triton = pytest.importorskip("triton")
    # Triton's own functions are made when it is imported, which something may have done before.
    if isinstance(triton.language.sum, triton.runtime.JITFunction):
        pytest.skip("Triton was imported without its interpreter; run pytest with TRITON_INTERPRET=1.")
    monkeypatch.setattr(dispatch, "usable", lambda x: not x.is_meta)
    yield torch.device("cpu")


@pytest.fixture
def single(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The kernels in single precision, in which they can be compared closely."""
    from brainbench.models.ops import dispatch

    monkeypatch.setattr(dispatch, "usable", lambda x: not x.is_meta)
    monkeypatch.setattr(dispatch, "HALF", torch.float32)
    if device.type == "cuda":
        monkeypatch.setattr(torch.backends.cuda.matmul, "allow_tf32", False)
        monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    return device
