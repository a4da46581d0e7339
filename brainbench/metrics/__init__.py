"""Metrics: how alike a model's responses and animals' are, and what can be concluded from it.

``rdms`` makes and compares representational dissimilarity matrices (RDMs), ``reliability`` splits trials into halves
and corrects for noise, ``score`` and ``animal_to_animal`` join both, ``inference`` tests and gives intervals,
``measures`` holds the registered metrics. Data pass in this order: :class:`Trials` → :func:`subject_rdm` →
:func:`score_rdms` and :func:`score_animals` → a score.
"""

from __future__ import annotations

from brainbench.core.trials import Trials
from brainbench.metrics.animal_to_animal import pairwise_consistency, score_animals
from brainbench.metrics.inference.bootstrap import bootstrap_score
from brainbench.metrics.inference.equivalence import turing_test
from brainbench.metrics.inference.multiple import compare_models, layer_tests
from brainbench.metrics.inference.permutation import permutation_test
from brainbench.metrics.measures.patterns import PatternMetric
from brainbench.metrics.measures.registry import Metric, get_metric, list_metrics, register_metric
from brainbench.metrics.rdms.comparison import compare
from brainbench.metrics.rdms.display import RDM
from brainbench.metrics.rdms.dissimilarity import rdm, rdm_movie
from brainbench.metrics.rdms.noise import noise_precision
from brainbench.metrics.reliability.ceiling import noise_ceiling
from brainbench.metrics.reliability.noise_correction import noise_corrected
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, subject_rdm
from brainbench.metrics.score import score_rdms

__all__ = [
    "RDM",
    "Metric",
    "PatternMetric",
    "SubjectRDM",
    "Trials",
    "bootstrap_score",
    "compare",
    "compare_models",
    "get_metric",
    "layer_tests",
    "list_metrics",
    "noise_ceiling",
    "noise_corrected",
    "noise_precision",
    "pairwise_consistency",
    "permutation_test",
    "rdm",
    "rdm_movie",
    "register_metric",
    "score_animals",
    "score_rdms",
    "subject_rdm",
    "turing_test",
]
