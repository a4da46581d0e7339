"""Motion of whiskers, heads and objects.

``trajectories`` holds motions that formulas or keyframes describe, ``recorded`` whisking from files; both give the
angles of each follicle over time, which ``hinge_angles`` keeps continuous when the head turns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.motion.recorded import Recorded, load_initial_angles, load_trajectory
    from brainbench.stimuli.motion.trajectories import Path, Spin, Still, Translation, Whisking

__all__ = ["Path", "Recorded", "Spin", "Still", "Translation", "Whisking", "load_initial_angles", "load_trajectory"]

_MODULES = {
    ".recorded": ("Recorded", "load_initial_angles", "load_trajectory"),
    ".trajectories": ("Path", "Spin", "Still", "Translation", "Whisking"),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
