"""brainbench: which artificial networks process touch the way a brain does.

The public names are imported on first use, so that ``import brainbench`` stays quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports
from brainbench.core.version import __version__

__all__ = [
    "BrainbenchError",
    "ResultRecord",
    "Score",
    "ScoreOptions",
    "__version__",
    "extract",
    "list_models",
    "load_model",
    "open_recordings",
    "register_model",
    "score",
]

if TYPE_CHECKING:
    from brainbench.core.errors import BrainbenchError
    from brainbench.core.records import ResultRecord, Score
    from brainbench.datasets import open_recordings
    from brainbench.models.activations import extract
    from brainbench.models.registry import list_models, load_model, register_model
    from brainbench.scoring.options import ScoreOptions
    from brainbench.scoring.scores import score

__getattr__, __dir__ = lazy_exports(__name__)
