"""Identity of a score: what was computed from what. Scores of one identity have the same numbers, on every machine.

A batch asks it which scores are missing or stale, an audit which records contradict one another, and a board which
settings make another score of the same network. Hashes stand for data, so neither folders nor machines count; nor does
the version of the package, since whatever changes the numbers of a default score raises the estimator's version.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from brainbench.core.files import to_json, to_plain
from brainbench.core.provenance import Provenance
from brainbench.core.records import ResultRecord

SETTINGS: Mapping[str, Any] = {
    "metric": "rsa", "estimator": "default", "time": "mean", "seed": 0, "units_reliability": None,
    "readout": "default", "normalize": True, "layers": None, "layer": None,
}  # fmt: skip
"""Settings that change numbers and stand in no hash, with their defaults: records leave out what they do not know."""
OF_MODELS = ("readout", "normalize", "layers", "layer")
"""Those that make another score of the same network on the same board."""


@dataclass(frozen=True)
class ScoreIdentity:
    """Everything that the numbers of a score follow from."""

    model: str
    """Name of the model."""
    weights: str | None
    """Content hash of its weights."""
    recordings: str | None
    """Hash of the recordings."""
    reading: tuple[str, str]
    """Window and selection of the recordings."""
    stimuli: str | None
    """Hash of the stimuli; None for features that were computed elsewhere."""
    labels: tuple[str, ...]
    """Labels that are compared, in order."""
    pairing: str
    """Pairs of labels that are not equal on both sides."""
    settings: str
    """:data:`SETTINGS` as JSON, with every default filled in."""
    estimator_version: int | None

    @classmethod
    def of(cls, record: ResultRecord) -> ScoreIdentity:
        """Return the identity that a record states."""
        score, weights = record.score, record.card.weights if record.card else None
        # Records that name no metric in their settings describe it.
        stated = {"estimator": score.estimator, "metric": score.metric}
        return cls.stated_by(score.name, weights, score.stimuli, score.provenance, stated)

    @classmethod
    def stated_by(
        cls,
        model: str,
        weights: str | None,
        labels: tuple[str, ...],
        origin: Provenance,
        fallback: Mapping[str, Any] | None = None,
    ) -> ScoreIdentity:
        """Return the identity that a provenance states; ``fallback`` are settings where it states none."""
        version = origin.settings.get("estimator_version")
        return cls(
            model=model,
            weights=weights,
            recordings=origin.recordings_hash,
            reading=(str(origin.recordings.get("window")), str(origin.recordings.get("selection"))),
            stimuli=origin.stimuli_hash,
            labels=labels,
            pairing=origin.pairing,
            settings=to_json(full_settings({**(fallback or {}), **origin.settings})),
            estimator_version=version if isinstance(version, int) else None,
        )


def full_settings(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return all of :data:`SETTINGS`, those that are not stated with their defaults."""
    return to_plain({name: stated.get(name, default) for name, default in SETTINGS.items()})


def unusual_settings(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of :data:`OF_MODELS` that are stated and are not the defaults."""
    values = to_plain({name: stated.get(name) for name in OF_MODELS})
    return {name: value for name, value in values.items() if value not in (None, SETTINGS[name])}
