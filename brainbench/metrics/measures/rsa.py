"""Representational similarity analysis as a metric, and linear CKA as a case of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from brainbench.core.records import Score
from brainbench.core.trials import Trials
from brainbench.metrics.animal_to_animal import score_animals
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, subject_rdm
from brainbench.metrics.score import score_rdms


@dataclass(frozen=True)
class RSA:
    """Compare RDMs; corrected by the split-half reliability of each animal's RDM."""

    name: str
    title: str
    brain_method: str = "correlation"
    """RDM method of the animals, see :func:`brainbench.metrics.subject_rdm`."""
    model_method: str = "correlation"
    """RDM method of the activations, which have no trial noise."""
    comparison: str = "pearson"

    def animal(self, subject: str, blocks: Sequence[Trials], n_stimuli: int, **options: Any) -> SubjectRDM:
        """Return the animal's RDM with its split halves and draws; options are those of :func:`subject_rdm`."""
        return subject_rdm(subject, blocks, n_stimuli, method=self.brain_method, comparison=self.comparison, **options)

    def score(self, features: Mapping[str, ArrayLike], animals: Sequence[SubjectRDM], **options: Any) -> Score:
        """Score the RDMs of the layers' features [K, F]; options are those of :func:`score_rdms`."""
        rdms = {layer: rdm(values, method=self.model_method) for layer, values in features.items()}
        return score_rdms(rdms, animals, compare=self.comparison, **options)

    def score_animals(self, animals: Sequence[SubjectRDM], **options: Any) -> Score:
        """Score the animals against one another; options are those of :func:`brainbench.metrics.score_animals`."""
        return score_animals(animals, compare=self.comparison, **options)
