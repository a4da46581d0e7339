"""Metrics: how alike a model's responses and animals' are, and what can be concluded from it.

``rdms`` makes and compares representational dissimilarity matrices (RDMs), ``reliability`` splits trials into halves
and corrects for noise, ``hooks`` says what a metric has to define and ``measures`` holds the registered ones,
``evaluation`` and ``score`` are the engine of all of them, ``inference`` tests. Data pass in this order:
:class:`Trials` → :meth:`Metric.animal` → :meth:`Metric.score` and :meth:`Metric.score_animals` → a score.
"""

from __future__ import annotations

from brainbench.metrics.inference.multiple import compare_models
from brainbench.metrics.inference.permutation import permutation_test
from brainbench.metrics.measures.metric import Metric, get_metric, list_metrics, register_metric
from brainbench.metrics.measures.patterns import PatternMetric
from brainbench.metrics.rdms.comparison import RDM, compare
from brainbench.metrics.rdms.dissimilarity import noise_precision, rdm
from brainbench.metrics.reliability.noise_correction import noise_ceiling, noise_corrected

__all__ = [
    "RDM",
    "Metric",
    "PatternMetric",
    "compare",
    "compare_models",
    "get_metric",
    "list_metrics",
    "noise_ceiling",
    "noise_corrected",
    "noise_precision",
    "permutation_test",
    "rdm",
    "register_metric",
]
