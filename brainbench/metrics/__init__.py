"""Compare the geometry of a model's responses with that of animals, and know what can be concluded.

The pieces, from trials to a score: :func:`rdm` and :func:`compare`; :func:`split_half` reliability and
:func:`noise_corrected`; :func:`noise_ceiling`; :func:`permutation_test`; :func:`subject_rdm`,
:func:`score_rdms` and :func:`score_animals`, which join them.
"""

from __future__ import annotations

from brainbench.metrics.animal_to_animal import score_animals
from brainbench.metrics.ceiling import NoiseCeiling, noise_ceiling
from brainbench.metrics.compare import COMPARISONS, compare
from brainbench.metrics.inference import PermutationTest, permutation_test
from brainbench.metrics.noise import ESTIMATORS, RELIABILITY_GATE, Corrected, noise_corrected, spearman_brown
from brainbench.metrics.precision import noise_precision
from brainbench.metrics.rdm import RDM_METHODS, rdm, rdm_problem
from brainbench.metrics.reliability import SplitHalf, TrialBlock, split_half
from brainbench.metrics.score import score_rdms
from brainbench.metrics.subject import SubjectRDM, subject_rdm

__all__ = [
    "COMPARISONS",
    "ESTIMATORS",
    "RDM_METHODS",
    "RELIABILITY_GATE",
    "Corrected",
    "NoiseCeiling",
    "PermutationTest",
    "SplitHalf",
    "SubjectRDM",
    "TrialBlock",
    "compare",
    "noise_ceiling",
    "noise_corrected",
    "noise_precision",
    "permutation_test",
    "rdm",
    "rdm_problem",
    "score_animals",
    "score_rdms",
    "spearman_brown",
    "split_half",
    "subject_rdm",
]
