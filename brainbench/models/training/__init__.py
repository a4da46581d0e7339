"""Training of networks: one run in a folder, resumed exactly after any interruption.

A :mod:`.config` says what is trained; :mod:`.batches` give sweeps, which are augmented, answered by a network with the
head of its objective, and taken back to gradients for one of the :mod:`.optimizers`; the best network is
evaluated and kept as a checkpoint with its card. Importing this package imports no framework.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.models.training.config import TrainingConfig
    from brainbench.models.training.trainer import TrainingResult, train

__all__ = ["TrainingConfig", "TrainingResult", "train"]

__getattr__, __dir__ = lazy_exports(__name__)
