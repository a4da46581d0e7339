"""Compare the geometry of a model's responses with that of animals, and know what can be concluded.

The pieces, from trials to a score: :func:`rdm` and :func:`compare`; :func:`split_half` reliability and
:func:`noise_corrected`; :func:`noise_ceiling`; :func:`permutation_test`; :func:`subject_rdm`,
:func:`score_rdms` and :func:`score_animals`, which join them. Beyond one score: :func:`bootstrap_score`,
:func:`compare_models`, :func:`layer_tests`, :func:`turing_test`. Beyond RSA: :func:`get_metric`.
:class:`RDM` names and draws one.
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
    find_metric,
    get_metric,
    list_metrics,
    register_metric,
)
from brainbench.metrics.rdms.comparison import COMPARISONS, compare
from brainbench.metrics.rdms.display import RDM
from brainbench.metrics.rdms.dissimilarity import RDM_METHODS, rdm, rdm_problem
from brainbench.metrics.rdms.movies import rdm_movie
from brainbench.metrics.rdms.precision import noise_precision
from brainbench.metrics.reliability.ceiling import NoiseCeiling, noise_ceiling
from brainbench.metrics.reliability.noise_correction import (
    ESTIMATORS,
    RELIABILITY_GATE,
    Corrected,
    noise_corrected,
    spearman_brown,
)
from brainbench.metrics.reliability.split_half import SUBJECT_METHODS, SplitHalf, split_half
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, subject_rdm
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
    "SplitHalf",
    "SubjectRDM",
    "Trials",
    "bootstrap_ceiling",
    "bootstrap_comparisons",
    "bootstrap_score",
    "check_metric",
    "compare",
    "compare_models",
    "equivalence_test",
    "find_metric",
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
    "split_half",
    "subject_rdm",
    "turing_test",
    "unit_reliability",
]
