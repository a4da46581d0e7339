"""The metric as users see it, what the engine adds to its hooks, and the registry that finds one by name.

A metric prepares each animal once (:meth:`Metric.animal`) and then scores any number of models against them. A new one
needs a single file: subclass :class:`brainbench.metrics.measures.patterns.PatternMetric`, write ``similarity`` and name
it in ``brainbench score --metric mine.py:MyMetric``, or call :func:`register_metric`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_name
from brainbench.core.plugins import load_entry_points, load_object, load_optional
from brainbench.core.records import Score
from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from brainbench.metrics.score import score_agreement, score_layers


class Metric(MetricHooks):
    """A metric that scores models and animals: the hooks that a subclass writes, and the engine that calls them."""

    def score(
        self,
        features: Mapping[str, ArrayLike],
        animals: Sequence[SubjectRDM],
        *,
        name: str,
        stimuli: Sequence[str],
        estimator: str = "default",
        seed: int = 0,
        layer: str | None = None,
        controls: Mapping[str, ArrayLike] | None = None,
    ) -> Score:
        """Score a model by the features [K, F] of its layers; ``layer`` is one committed to beforehand.

        With the features of ``controls`` the score also states what the layers explain beyond them, where the metric
        says (:meth:`unique`).
        """
        check_features(features, stimuli)
        layers, rivals = (
            {label: self.layer(values) for label, values in side.items()} for side in (features, controls or {})
        )
        options = {"name": name, "stimuli": stimuli, "estimator": estimator, "seed": seed, "committed": layer}
        options["controls"] = rivals
        return score_layers(self, layers, animals, **options)[0]

    def score_animals(
        self, animals: Sequence[SubjectRDM], *, stimuli: Sequence[str], estimator: str = "default", seed: int = 0
    ) -> Score:
        """Score the animals against one another, by the same estimator."""
        return score_agreement(self, animals, stimuli=stimuli, estimator=estimator, seed=seed)


def check_features(features: Mapping[str, Any], stimuli: Sequence[str]) -> None:
    """Raise UsageError for no layers, or features of another number of stimuli."""
    if not features:
        raise UsageError("There are no layers to score; give the features of at least one layer.")
    for layer, values in features.items():
        if len(values) != len(stimuli):
            raise UsageError(f"Features of layer {layer!r} have {len(values)} rows; {len(stimuli)} stimuli are scored.")


ENTRY_POINTS = "brainbench.metrics"
"""Group of entry points by which another package adds a metric: its name, and what is or makes it."""
_METRICS: dict[str, Metric] = {}


def register_metric(metric: Metric) -> Metric:
    """Add a metric under its name and return it."""
    check_metric(metric)
    if metric.name in _METRICS:
        raise UsageError(f"A metric named {metric.name!r} exists already; choose another name.")
    _METRICS[metric.name] = metric
    return metric


def get_metric(name: str | Metric) -> Metric:
    """Return a registered metric, or the one that ``FILE.py:NAME`` or ``package.module:NAME`` names.

    NAME is a metric, or a class or function that makes one without arguments. A metric itself is checked and returned.
    """
    if not isinstance(name, str):
        check_metric(name)
        return name
    if ":" not in name:
        if name not in _METRICS and (target := load_optional(ENTRY_POINTS, name, "metric")) is not None:
            _enter(name, target)
        check_name("metric", name, list_metrics(), hint="Your own: FILE.py:CLASS.")
        return _METRICS[name]
    metric = _instance(load_object(name, "metric"))
    if metric.name in _METRICS and metric is not _METRICS[metric.name]:  # a record could not tell the two apart
        raise UsageError(f"A metric named {metric.name!r} exists already; give the one in {name!r} another name.")
    return metric


def _instance(target: Any) -> Metric:
    """Return a metric from itself, or from a class or function that makes one."""
    # A class has the names of its instances, so it must be told from an instance first.
    makes = isinstance(target, type) or (not hasattr(target, "title") and callable(target))
    metric: Any = target() if makes else target
    check_metric(metric)
    return metric


def _enter(name: str, target: Any) -> None:
    """Register the metric of an entry point, once."""
    metric = _instance(target)
    if metric.name != name:
        raise UsageError(
            f"The entry point {name!r} of {ENTRY_POINTS} makes a metric named {metric.name!r}; use one name."
        )
    _METRICS.setdefault(name, metric)


def list_metrics() -> tuple[str, ...]:
    """Return the names of the registered metrics, RSA first; those of installed packages are among them."""
    load_entry_points(ENTRY_POINTS, _enter)
    return tuple(sorted(_METRICS, key=lambda name: (name != "rsa", name)))


def check_metric(metric: Any) -> None:
    """Raise UsageError naming what an object lacks to be a metric."""
    lacking = [part for part in ("name", "title", "animal", "score", "score_animals") if not hasattr(metric, part)]
    if lacking:
        raise UsageError(
            f"{metric!r} is no metric: it lacks {', '.join(lacking)}; subclass brainbench.metrics.PatternMetric."
        )
