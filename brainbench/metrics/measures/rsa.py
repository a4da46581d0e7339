"""Representational similarity analysis as a metric, and linear CKA as a case of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
    """RDM method of the animals, see :data:`brainbench.metrics.SUBJECT_METHODS`."""
    model_method: str = "correlation"
    """RDM method of the activations, which have no trial noise."""
    comparison: str = "pearson"

    def animal(
        self,
        subject: str,
        blocks: Sequence[Trials],
        n_stimuli: int,
        *,
        stimuli: Sequence[str] | None = None,
        seed: int = 0,
        draws: int = 0,
    ) -> SubjectRDM:
        """Return the animal's RDM with its split halves and draws; see :func:`subject_rdm`."""
        return subject_rdm(
            subject,
            blocks,
            n_stimuli,
            stimuli=stimuli,
            method=self.brain_method,
            comparison=self.comparison,
            seed=seed,
            draws=draws,
        )

    def score(
        self,
        features: Mapping[str, ArrayLike],
        animals: Sequence[SubjectRDM],
        *,
        name: str,
        stimuli: Sequence[str],
        estimator: str = "default",
        seed: int = 0,
    ) -> Score:
        """Score the RDMs of the layers' features [K, F]; see :func:`score_rdms`."""
        rdms = {layer: rdm(values, method=self.model_method) for layer, values in features.items()}
        return score_rdms(
            rdms, animals, name=name, stimuli=stimuli, estimator=estimator, compare=self.comparison, seed=seed
        )

    def score_animals(
        self, animals: Sequence[SubjectRDM], *, stimuli: Sequence[str], estimator: str = "default", seed: int = 0
    ) -> Score:
        """Score the animals against one another; see :func:`brainbench.metrics.score_animals`."""
        return score_animals(animals, stimuli=stimuli, estimator=estimator, compare=self.comparison, seed=seed)
