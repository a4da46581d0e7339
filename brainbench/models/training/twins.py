"""The untrained twin of a trained network: the network that its training started from, to the last bit.

Nothing of it is stored but its name, its seed and a hash. ``load_model(name, seed=seed)`` draws it again; another
version of PyTorch may draw other numbers, and the hash tells.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from brainbench.core.files import hash_arrays
from brainbench.models.registry import load_model


def describe_twin(name: str, seed: int, model: nn.Module) -> dict[str, Any]:
    """Return what a configuration says of a network before its training: how to get it, and what it was.

    ``state`` is a SHA-256 (32 digits) over names, types, shapes and bytes of all parameters and buffers, the decoder's
    included: it belongs to a number of classes.
    """
    state = hash_arrays({key: value.detach().cpu().numpy() for key, value in model.state_dict().items()})
    return {"name": name, "seed": seed, "state": state, "torch": torch.__version__}


def difference(twin: Mapping[str, Any], drawn: Mapping[str, Any]) -> str:
    """Return why a network that was drawn again is not the twin, as :func:`describe_twin` tells of both; else ''."""
    if twin["state"] == drawn["state"]:
        return ""
    return (
        f"{twin['name']} with seed {twin['seed']} is not the network that training started from: PyTorch "
        f"{drawn['torch']} here draws other weights than PyTorch {twin['torch']} there"
    )


def draw_twin(twin: Mapping[str, Any], options: Mapping[str, Any]) -> tuple[nn.Module, str]:
    """Return the twin that a checkpoint's configuration names, and why it is another network after all, or ''.

    ``twin`` and ``options`` are entries of the configuration.
    """
    model = load_model(twin["name"], seed=twin["seed"], **options)
    return model, difference(twin, describe_twin(twin["name"], twin["seed"], model))
