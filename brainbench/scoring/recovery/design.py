"""Design of a recovery study: what is measured of how many animals, and how candidates are scored."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from brainbench.core.errors import UsageError, shown
from brainbench.core.reading.ranges import check_fields
from brainbench.datasets.synthetic.design import PopulationDesign

FEWEST_STIMULI = 4
"""Fewest stimuli whose RDMs can be compared after one is left out."""


@dataclass(frozen=True)
class RecoveryDesign:
    """An experiment that is repeated on the computer with every candidate in turn as the truth."""

    population: PopulationDesign = field(default_factory=PopulationDesign)
    """Animals, units, trials and noise."""
    stimuli: int | None = None
    """Stimuli of one board, drawn anew for each from those that the candidates saw; all of them by default."""
    metric: str = "rsa"
    """Metric of the scores."""
    layer: str = "any"
    """Layer whose units the animals mix: any (drawn anew for each board), last, or the name of one."""
    splits: int = 100
    """Split halves that tell the reliability of an animal's RDM."""
    orders: int = 50
    """Random orders of the stimuli that tell the score expected by chance; the observed score counts among them, so
    with fewer than about 40 it looks like chance."""
    seed: int = 0
    """Seed of the animals."""

    def __post_init__(self) -> None:
        for name, fewest in (("splits", 1), ("orders", 40), ("seed", 0), ("stimuli", FEWEST_STIMULI)):
            check_fields(self, name, of="{} of a recovery", least=fewest, whole=True)


def parse_trials(text: str) -> int | tuple[int, int]:
    """Return the trials of a stimulus: ``18``, or the fewest and the most as in ``16-20``.

    >>> parse_trials("16-20")
    (16, 20)
    """
    found = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", text)
    first, last = (int(part or 0) for part in found.groups()) if found else (0, 0)
    if first < 1 or (found and found[2] and last < first):
        raise UsageError(f"Trials are a number above 0 or a range such as 16-20; received {shown(text)}.")
    return (first, last) if last else first
