"""Artificial networks of touch: what turns a whisker array's forces and torques into activations.

A name (:mod:`~brainbench.models.recipes`) is looked up in the :mod:`~brainbench.models.registry`, which builds an
encoder (often a temporal graph of cells), an attender and a decoder into a :mod:`~brainbench.models.network`; its
:mod:`~brainbench.models.activations` are what is compared with brains. Importing this package imports no framework.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports
from brainbench.models import zoo

if TYPE_CHECKING:
    from brainbench.models.activations import extract
    from brainbench.models.registry import describe_model, list_models, load_model, load_user_model, register_model

__all__ = ["describe_model", "extract", "list_models", "load_model", "load_user_model", "register_model"]

zoo.register()

__getattr__, __dir__ = lazy_exports(__name__)
