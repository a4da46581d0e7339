"""Identity of a score: what was computed from what; and the sealed plan that a score is held to.

Scores of one identity have the same numbers, on every machine. A batch asks it which scores are missing or stale, an
audit which records contradict one another, and a board which settings make another score of the same network. Hashes
stand for data, so neither folders nor machines count; nor does the version of the package, since whatever changes the
numbers of a default score raises the estimator's version.

A plan is what is fixed before animals are measured. ``brainbench power`` and ``recovery`` write it with the hash of its
content, which is stated where everybody can see it, such as in a preregistration: a plan that was changed later has
another one. A record holds the plan that it was scored by, so terminal, report and board find by themselves what
deviates.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from brainbench.core.errors import DataError, UsageError, brief, listing
from brainbench.core.files import content_hash, to_json, to_plain, write_json
from brainbench.core.limits import Count, Limit, Share, limited
from brainbench.core.provenance import Provenance
from brainbench.core.reading.texts import read_json
from brainbench.core.reading.values import typed_values
from brainbench.core.records import ResultRecord

SETTINGS: Mapping[str, Any] = {
    "metric": "rsa", "estimator": "default", "time": "mean", "seed": 0, "units_reliability": None,
    "readout": "default", "normalize": True, "layers": None, "layer": None,
}  # fmt: skip
"""Settings that change numbers and stand in no hash, with their defaults: records leave out what they do not know."""
OF_MODELS = ("readout", "normalize", "layers", "layer")
"""Those that make another score of the same network on the same board."""
_NAMED = 4  # most stimuli that a sentence names


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
        stated = {**SETTINGS, **(fallback or {}), **origin.settings}
        return cls(
            model=model,
            weights=weights,
            recordings=origin.recordings_hash,
            reading=(str(origin.recordings.get("window")), str(origin.recordings.get("selection"))),
            stimuli=origin.stimuli_hash,
            labels=labels,
            pairing=origin.pairing,
            settings=to_json(to_plain({name: stated[name] for name in SETTINGS})),
            estimator_version=version if isinstance(version, int) else None,
        )


def unusual_settings(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of :data:`OF_MODELS` that are stated and are not the defaults."""
    values = to_plain({name: stated.get(name) for name in OF_MODELS})
    return {name: value for name, value in values.items() if value not in (None, SETTINGS[name])}


@limited(of="{} of a plan")
class SealedPlan:
    """What an experiment will compare, stated before it is done."""

    made_by: Literal["power", "recovery"]
    """Command that made it."""
    stimuli: Annotated[int, Limit(least=2)]
    """Number of stimuli."""
    animals: Count
    metric: str = "rsa"
    layer: str | None = None
    """Layer that is committed to; by default a choice on held-out animals."""
    layers: Count | None = None
    """Most layers among which is chosen; None where any number is."""
    names: tuple[str, ...] = ()
    """Names of the stimuli; empty where only their number is fixed."""
    models: tuple[str, ...] = ()
    """Networks that are compared; empty where any is."""
    units: Count | None = None
    """Units of each animal at least."""
    trials: Count | None = None
    """Trials of each stimulus in each animal, at least on the average."""
    pilot: str | None = None
    """Hash of the recordings from which the plan was made: they cannot test it."""
    expected: Mapping[str, Share] = field(default_factory=dict)
    """Power or win rate that the plan expects, by true score or network."""
    command: str = ""
    """Command line that makes it again."""

    @property
    def hash(self) -> str:
        """Hash of its content."""
        return _hash(to_plain(self))

    def write(self, path: Path) -> Path:
        """Write it with its hash."""
        return write_json(path, {**to_plain(self), "hash": self.hash})

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> SealedPlan:
        """Read a plan; one that was changed after it was written is refused."""
        data, name = read_json(path, "plan"), str(path)
        if not isinstance(data, dict) or not {"made_by", "hash"} <= set(data):
            raise DataError(f"{name!r} is no plan; 'brainbench power --plan' and 'recovery --plan' write one.")
        sealed = data.pop("hash")
        if sealed != _hash(data):
            raise DataError(
                f"The plan {name!r} was changed after it was written: its content has the hash {_hash(data)}, and it "
                f"states {brief(sealed)}; take the file as it was written, or score without a plan."
            )
        return cls.of(data, f"the plan {name!r}")

    @classmethod
    def of(cls, data: Any, where: str = "the plan of the record") -> SealedPlan:
        """Return the plan that a mapping states."""
        return typed_values(cls, data, where)

    def check_stimuli(self, labels: Sequence[str]) -> None:
        """Refuse recordings that share no stimulus with the plan."""
        if self.names and not set(self.names) & set(labels):
            raise UsageError(
                f"The plan is of other recordings: none of its {len(self.names)} stimuli ({_some(self.names)}) is "
                f"among the {len(labels)} of these ({_some(labels)}); give the plan of these, or score without one."
            )

    def deviations(self, record: ResultRecord) -> Iterator[str]:
        """Yield what a record did otherwise than planned, one clause each."""
        score, origin = record.score, record.score.provenance
        if self.pilot is not None and self.pilot == origin.recordings_hash:
            yield "the recordings are the pilot from which the plan was made"
        if self.models and score.name not in self.models:
            yield f"the network {brief(score.name)} is not among the {len(self.models)} planned"
        yield from self._of_stimuli(score.stimuli, origin.pairs)
        metric = origin.settings.get("metric")
        if metric != self.metric:
            yield f"metric {brief(metric)}, planned {brief(self.metric)}"
        yield from self._of_layers(record)
        if (count := len(score.subjects)) != self.animals and score.subjects:
            yield f"{count} animals, planned {self.animals}"
        if self.units is not None and (few := [one for one in score.subjects if one.units < (self.units or 0)]):
            yield f"{len(few)} of {count} animals have fewer than the planned {self.units} units"
        if self.trials is not None:
            wanted = self.trials * len(score.stimuli)
            if few := [one for one in score.subjects if one.trials < wanted]:
                yield f"{len(few)} of {count} animals have fewer than the planned {self.trials} trials of each stimulus"

    def _of_stimuli(self, labels: Sequence[str], pairs: Mapping[str, str | None]) -> Iterator[str]:
        if len(labels) != self.stimuli:
            yield f"{len(labels)} stimuli, planned {self.stimuli}"
        # Recordings may call stimuli otherwise than the set that the plan was made with.
        either = {label: {label, str(pairs.get(label) or label)} for label in labels}
        if missing := [name for name in self.names if not any(name in pair for pair in either.values())]:
            yield f"{len(missing)} planned stimuli are not scored ({_some(missing)})"
        if self.names and (more := [label for label, pair in either.items() if not pair & {*self.names}]):
            yield f"{len(more)} stimuli are not in the plan ({_some(more)})"

    def _of_layers(self, record: ResultRecord) -> Iterator[str]:
        score, settings = record.score, record.score.provenance.settings
        committed = settings.get("layer") or (record.card and record.card.layer)
        if committed is None and len(score.layers) == 1:
            committed = score.layers[0].layer
        if self.layer is not None and committed != self.layer:
            instead = f"layer {brief(committed)}" if committed else f"layer chosen among {len(score.layers)}"
            yield f"{instead}, planned {brief(self.layer)}"
        elif self.layer is None and settings.get("layer"):
            yield f"layer {brief(settings['layer'])}, planned a choice on held-out animals"
        elif self.layers is not None and committed is None and len(score.layers) > self.layers:
            yield f"layer chosen among {len(score.layers)}, planned {self.layers}"


def plan_note(record: ResultRecord) -> str:
    """Return what a record says of its plan in one sentence; empty without one."""
    if not (stated := record.score.provenance.get("plan")):
        return ""
    try:
        plan = SealedPlan.of(stated)
    except DataError as error:
        return f"its plan cannot be read: {error}"
    clauses = list(plan.deviations(record))
    return f"{'deviates from' if clauses else 'follows'} the sealed plan {plan.hash}{': ' * bool(clauses)}" + "; ".join(
        clauses
    )


def _hash(data: Mapping[str, Any]) -> str:
    return content_hash(data, length=32)


def _some(names: Sequence[str]) -> str:
    return listing([brief(name) for name in names], limit=_NAMED, quoted=False)
