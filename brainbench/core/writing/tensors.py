"""Tensors as safetensors files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

from brainbench.core.files import atomic_path

if TYPE_CHECKING:
    import torch


def write_tensors(path: str | os.PathLike[str], tensors: Mapping[str, torch.Tensor], **metadata: str) -> None:
    """Write tensors of any device to one safetensors file, replaced as a whole.

    Raises:
        FileWriteError: the folder cannot be made or written, or the disk is full.
    """
    from safetensors.torch import save

    stored = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    # Not by save_file: it writes to a temporary file of its own, which stays where it is killed, and no one else may
    # read what it makes.
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(stored, metadata=metadata or None))
