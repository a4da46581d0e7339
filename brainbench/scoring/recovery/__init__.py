"""Recovery: animals are drawn from each candidate network, and all candidates are scored against them.

``boards`` runs the networks on the stimuli, draws animals from one of them (a design says how many and how noisy),
scores all, many times over, and counts how often the true network wins, as numbers and as a picture; it looks for the
smallest design that suffices too. ``selection`` picks the stimuli of a larger pool that separate
the candidates best, ``motion`` looks for the whisking that tells two networks apart, and ``commands`` is
``brainbench recovery``. An optional room, which nothing else imports.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.scoring.recovery.boards import (
        Candidate,
        Recovery,
        RecoveryDesign,
        find_cheapest,
        open_candidates,
        plot_confusion,
        recover,
    )
    from brainbench.scoring.recovery.motion import NetworkDesign, design_for_networks
    from brainbench.scoring.recovery.selection import select_stimuli

__all__ = [
    "Candidate",
    "NetworkDesign",
    "Recovery",
    "RecoveryDesign",
    "design_for_networks",
    "find_cheapest",
    "open_candidates",
    "plot_confusion",
    "recover",
    "select_stimuli",
]

__getattr__, __dir__ = lazy_exports(__name__)
