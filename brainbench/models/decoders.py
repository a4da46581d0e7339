"""Decoders: features of one step [..., F] to class scores [..., classes]."""

from __future__ import annotations

from torch import nn

from brainbench.models._layers import RECTIFIER_GAIN, Linear

CLASSES = 117
"""Object categories of the whisking data set (Zhuang et al. 2017)."""


def linear_decoder(features: int, classes: int = CLASSES) -> nn.Module:
    """Return one linear layer (60,021 parameters for 512 features)."""
    return Linear(features, classes)


def mlp_decoder(features: int, classes: int = CLASSES) -> nn.Module:
    """Return linear layers 1024, 512 and ``classes`` with ReLU between (1,110,133 parameters for 512 features)."""
    return nn.Sequential(
        Linear(features, 1024, gain=RECTIFIER_GAIN),
        nn.ReLU(),
        Linear(1024, 512, gain=RECTIFIER_GAIN),
        nn.ReLU(),
        Linear(512, classes),
    )
