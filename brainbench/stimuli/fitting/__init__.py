"""Fit whiskers to measurements: traced shapes or base wrenches in, parameters with intervals out.

``tracks`` reads measurements, ``trials`` join them with the motion and the objects, :func:`fit` estimates parameters,
and :func:`find_contacts` takes contact point and force from shapes alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.fitting.least_squares import fit
    from brainbench.stimuli.fitting.options import FitOptions
    from brainbench.stimuli.fitting.result import Estimate, FitResult
    from brainbench.stimuli.fitting.tracks.contract import new_shapes, new_wrenches
    from brainbench.stimuli.fitting.trials import Trial

__all__ = ["Estimate", "FitOptions", "FitResult", "Trial", "fit", "new_shapes", "new_wrenches"]

_MODULES = {
    ".least_squares": ("fit",),
    ".options": ("FitOptions",),
    ".result": ("Estimate", "FitResult"),
    ".tracks.contract": ("new_shapes", "new_wrenches"),
    ".trials": ("Trial",),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
