"""Protocol and registry of metrics.

A metric prepares each animal once (:meth:`Metric.animal`) and then scores any number of models against them. A new one
needs a single file: subclass :class:`brainbench.metrics.measures.patterns.PatternMetric`, write ``similarity`` and name
it in ``brainbench score --metric mine.py:MyMetric``, or call :func:`register_metric`.
"""

from __future__ import annotations

from typing import Any

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.plugins import load_object
from brainbench.metrics.measures.metric import Metric

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

    Raises:
        DataFileNotFoundError: there is no such file or module.
    """
    if not isinstance(name, str):
        check_metric(name)
        return name
    if ":" not in name:
        if name not in _METRICS:
            raise unknown_name("metric", name, list_metrics(), hint="Your own: FILE.py:CLASS.")
        return _METRICS[name]
    found = load_object(name, "metric")
    # A class has the names of its instances, so it must be told from an instance first.
    made: Any = found() if isinstance(found, type) or (not hasattr(found, "title") and callable(found)) else found
    check_metric(made)
    if made.name in _METRICS and made is not _METRICS[made.name]:  # a record could not tell the two apart
        raise UsageError(f"A metric named {made.name!r} exists already; give the one in {name!r} another name.")
    return made


def list_metrics() -> tuple[str, ...]:
    """Return the names of the registered metrics, RSA first."""
    return tuple(sorted(_METRICS, key=lambda name: (name != "rsa", name)))


def check_metric(metric: Any) -> None:
    """Raise UsageError naming what an object lacks to be a metric."""
    lacking = [part for part in ("name", "title", "animal", "score", "score_animals") if not hasattr(metric, part)]
    if lacking:
        raise UsageError(
            f"{metric!r} is no metric: it lacks {', '.join(lacking)}; subclass brainbench.metrics.PatternMetric."
        )
