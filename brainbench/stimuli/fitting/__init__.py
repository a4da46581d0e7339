"""Fit whiskers to measurements: traced shapes or base wrenches in, parameters with intervals out.

``trials`` join measurements (those of :mod:`brainbench.stimuli.tracks`, or wrenches) with the motion and the objects,
:func:`fit` estimates parameters, and :func:`find_contacts` takes contact point and force from shapes alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.fitting.contacts import ContactOptions, find_contacts
    from brainbench.stimuli.fitting.least_squares import fit
    from brainbench.stimuli.fitting.parameters import FitOptions
    from brainbench.stimuli.fitting.result import FitResult, FittedParameter
    from brainbench.stimuli.fitting.trials import Trial, read_wrenches
    from brainbench.stimuli.tracks.contract import new_shapes, new_wrenches
    from brainbench.stimuli.tracks.readers import TrackOptions, read_shapes

__all__ = [
    "ContactOptions",
    "FitOptions",
    "FitResult",
    "FittedParameter",
    "TrackOptions",
    "Trial",
    "find_contacts",
    "fit",
    "new_shapes",
    "new_wrenches",
    "read_shapes",
    "read_wrenches",
]

__getattr__, __dir__ = lazy_exports(__name__)
