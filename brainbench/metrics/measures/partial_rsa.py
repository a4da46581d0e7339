"""RSA without what contacts, licks and choices explain, and how the variance is shared with them.

Recordings carry, beside responses, how often each trial's whiskers touched, how often the animal licked and
what it chose. An animal's mean of each over a stimulus makes a nuisance RDM
(:func:`~brainbench.metrics.measures.nuisance.nuisance_rdm`); the value is the correlation of the model's RDM with the
animal's, both without what these explain linearly. The record keeps the variance partition too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from brainbench.core.trials import Trials
from brainbench.metrics.measures.animal_patterns import AnimalPatterns, animal_patterns
from brainbench.metrics.measures.nuisance import partial_correlations, variance_partition
from brainbench.metrics.measures.patterns import PatternMetric
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.rdms.pairs import Floats, Ints, permuted_pairs, upper
from brainbench.metrics.stimulus_labels import stimulus_codes, stimulus_means


@dataclass(frozen=True)
class CovaryingPatterns(AnimalPatterns):
    """An animal's mean responses, and the means of what else was measured."""

    nuisances: dict[str, Floats] = field(default_factory=dict, repr=False)
    """Name → RDM [P]: absolute differences of means over trials of all sessions."""


class PartialRSA(PatternMetric):
    """Partial correlation between RDMs of correlation distances, given nuisance RDMs."""

    name = "rsa-partial"
    title = "correlation between RDMs without what contacts, licks and choices explain"

    def animal(
        self,
        subject: str,
        blocks: Sequence[Trials],
        n_stimuli: int,
        *,
        stimuli: Sequence[str] | None = None,
        seed: int = 0,
        draws: int = 0,
    ) -> CovaryingPatterns:
        """Return the animal's mean responses with its nuisance RDMs; without any the animal cannot be used."""
        found = animal_patterns(subject, blocks, n_stimuli, stimuli=stimuli)
        nuisances, told = _nuisances(blocks, n_stimuli)
        made = CovaryingPatterns(**{name: getattr(found, name) for name in found.__dataclass_fields__})
        if found.problem is None and not nuisances:
            return replace(made, problem=f"no contacts, licks or choices that differ between stimuli{told}")
        return replace(made, nuisances=nuisances)

    def compare_orders(self, model: Floats, animals: Sequence[AnimalPatterns], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        relabelled = rdm(model)[permuted_pairs(orders)]
        columns = []
        for animal in animals:
            brain = rdm(animal.patterns)
            if isinstance(animal, CovaryingPatterns) and np.isfinite(brain).all():
                columns.append(partial_correlations(relabelled, np.stack(list(animal.nuisances.values())), brain))
            else:
                columns.append(np.full(len(orders), np.nan))
        return np.stack(columns, axis=1)

    def statistics(self, model: Floats, animals: Sequence[Any], seed: int) -> dict[str, Any]:
        """Return the shares of variance of the chosen layer, averaged over animals."""
        parts = [
            variance_partition(rdm(model), animal.nuisances, rdm(animal.patterns), seed=seed) for animal in animals
        ]
        names = ("total", "unique_model", "unique_nuisance", "shared", "chance")
        nuisances = sorted({name for part in parts for name in part.nuisances})
        shares = {name: float(np.mean([getattr(part, name) for part in parts])) for name in names}
        return {"variance_partition": {**shares, "nuisances": nuisances}}


def _nuisances(blocks: Sequence[Trials], count: int) -> tuple[dict[str, Floats], str]:
    """Return the RDM of every covariate with a value for all stimuli and a difference between some."""
    names = list(dict.fromkeys(name for block in blocks for name in block.covariates))
    labels = [stimulus_codes(block.labels, count)[0] for block in blocks]
    found, lacking = {}, []
    for name in names:
        values = [
            np.asarray(block.covariates.get(name, np.full(len(codes), math.nan)), dtype=np.float64)
            for block, codes in zip(blocks, labels, strict=True)
        ]
        means = stimulus_means(np.concatenate(values)[:, None], np.concatenate(labels), count)[:, 0]
        if np.isfinite(means).all() and np.ptp(means) > 0:
            found[name] = upper(np.abs(means[:, None] - means))
        else:
            lacking.append(name)
    return found, f" ({', '.join(lacking)} do not)" if lacking else ""
