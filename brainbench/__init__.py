"""brainbench: which artificial networks process touch the way a brain does.

The public names are imported on first use, so that ``import brainbench`` stays quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_LAZY = {
    "list_models": "brainbench.models.registry",
    "load_model": "brainbench.models.registry",
    "register_model": "brainbench.models.registry",
    "extract": "brainbench.models.activations",
    "score": "brainbench.scoring",
    "open_recordings": "brainbench.datasets",
    "Score": "brainbench.core.records",
    "ResultRecord": "brainbench.core.records",
    "BrainbenchError": "brainbench.core.errors",
}

__all__ = [
    "BrainbenchError",
    "ResultRecord",
    "Score",
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
    from brainbench.scoring.scores import score


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'brainbench' has no attribute {name!r}")
    value = getattr(import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
