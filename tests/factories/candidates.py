"""Candidates of a recovery with random features, unrelated to one another, and a design that is quick to simulate."""

import numpy as np

from brainbench.datasets.synthetic import PopulationDesign
from brainbench.scoring.recovery import Candidate, RecoveryDesign

NAMES = ("a", "b", "c")
DESIGN = RecoveryDesign(PopulationDesign(animals=5, units=30, trials=(6, 9)), splits=40)


def make_candidates(stimuli: int = 12, *, names: tuple[str, ...] = NAMES):
    random = np.random.default_rng(0)
    labels = [f"s{index}" for index in range(stimuli)]
    return tuple(
        Candidate.of(name, labels, {f"layer{index + 1}": random.standard_normal((stimuli, 6)) for index in range(2)})
        for name in names
    )
