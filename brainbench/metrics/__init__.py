"""Metrics: how alike a model's responses and animals' are, and what can be concluded from it.

``rdms`` makes and compares representational dissimilarity matrices (RDMs), ``reliability`` splits trials into halves
and corrects for noise, ``score`` and ``animal_to_animal`` join both, ``inference`` tests and gives intervals,
``measures`` holds the registered metrics. Data pass in this order: :class:`Trials` → :func:`subject_rdm` →
:func:`score_rdms` and :func:`score_animals` → a score.
"""

from __future__ import annotations

from brainbench.core.trials import Trials
from brainbench.metrics.animal_to_animal import pairwise_consistency, score_animals
from brainbench.metrics.inference.bootstrap import (
    DRAWS,
    Bootstrap,
    bootstrap_ceiling,
    bootstrap_comparisons,
    bootstrap_score,
)
from brainbench.metrics.inference.equivalence import EquivalenceTest, equivalence_test, turing_test
from brainbench.metrics.inference.multiple import LayerTest, ModelComparison, compare_models, layer_tests
from brainbench.metrics.inference.permutation import PermutationTest, permutation_test
from brainbench.metrics.measures.patterns import PatternMetric
from brainbench.metrics.measures.registry import (
    Metric,
    check_metric,
    get_metric,
    list_metrics,
    register_metric,
)
from brainbench.metrics.rdms.comparison import COMPARISONS, compare
from brainbench.metrics.rdms.display import RDM
from brainbench.metrics.rdms.dissimilarity import RDM_METHODS, rdm, rdm_movie, rdm_problem
from brainbench.metrics.rdms.noise import noise_precision
from brainbench.metrics.reliability.ceiling import NoiseCeiling, noise_ceiling
from brainbench.metrics.reliability.noise_correction import (
    ESTIMATORS,
    RELIABILITY_GATE,
    Corrected,
    noise_corrected,
    spearman_brown,
)
from brainbench.metrics.reliability.subject_rdm import SUBJECT_METHODS, SubjectRDM, subject_rdm
from brainbench.metrics.reliability.units import reliable_units, unit_reliability
from brainbench.metrics.score import score_rdms

__all__ = [
    "COMPARISONS",
    "DRAWS",
    "ESTIMATORS",
    "RDM",
    "RDM_METHODS",
    "RELIABILITY_GATE",
    "SUBJECT_METHODS",
    "Bootstrap",
    "Corrected",
    "EquivalenceTest",
    "LayerTest",
    "Metric",
    "ModelComparison",
    "NoiseCeiling",
    "PatternMetric",
    "PermutationTest",
    "SubjectRDM",
    "Trials",
    "bootstrap_ceiling",
    "bootstrap_comparisons",
    "bootstrap_score",
    "check_metric",
    "compare",
    "compare_models",
    "equivalence_test",
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
    "rdm_problem",
    "register_metric",
    "reliable_units",
    "score_animals",
    "score_rdms",
    "spearman_brown",
    "subject_rdm",
    "turing_test",
    "unit_reliability",
]
