"""Scores and result records: what is known about one model's match to one set of recordings, typed.

Letters: K stimulus, P = K(K−1)/2 RDM pair.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from brainbench.core.errors import DataError

Status = Literal["ok", "unreliable", "undefined"]
"""``ok``: can be trusted; ``unreliable``: computed, but the data are too noisy or too few to trust
it; ``undefined``: no number exists. The reason stands in words beside it."""

RECORD_SCHEMA = 2
"""Version of the result-record JSON layout; :meth:`ResultRecord.from_json` also reads every earlier one."""

ESTIMATOR_VERSION = 1
"""Raised whenever the same recordings and activations would get another number from the default estimator."""


@dataclass(frozen=True)
class Interval:
    """A confidence interval with the method that made it."""

    low: float
    high: float
    level: float = 0.95
    """Share of repetitions whose intervals hold the truth."""
    method: str = ""
    """How it was made, over what, and why it may be unreliable."""


@dataclass(frozen=True)
class Ceiling:
    """Noise ceiling of the raw (uncorrected) comparison: what a perfect model could reach."""

    lower: float
    """Each animal against the mean of the others."""
    upper: float
    """Each animal against the mean of all."""
    method: str = "leave-one-animal-out (lower), mean of all (upper)"


@dataclass(frozen=True)
class SubjectScore:
    """One animal's part of a score."""

    subject: str
    value: float
    """Noise-corrected score; NaN when undefined."""
    r: float
    """Raw comparison of the model's RDM with this animal's."""
    reliability: float
    """Spearman-Brown-corrected split-half reliability of this animal's RDM."""
    status: Status = "ok"
    units: int = 0
    """Neurons that entered."""
    trials: int = 0
    """Trials that entered."""
    layer: str | None = None
    """Layer evaluated on this animal; it was chosen without this animal's data."""


@dataclass(frozen=True)
class LayerScore:
    """One layer compared with every animal; shown for reading, never picked from."""

    layer: str
    value: float
    """Mean noise-corrected score over the animals whose RDM is reliable."""
    r: float
    """Mean raw comparison over the same animals."""
    status: Status = "ok"
    interval: Interval | None = None
    """Of ``value``, over animals."""


@dataclass(frozen=True)
class Score:
    """What is known about one model's match to one set of recordings.

    Everything printed or published comes from this object. ``value`` is NaN exactly when
    ``status`` is ``undefined``. RDMs are upper triangles [P] in the order of ``stimuli``.
    """

    name: str
    """Of the model."""
    value: float
    """Mean over animals, corrected for their noise where the metric can be."""
    status: Status
    """``ok``, ``unreliable`` or ``undefined``."""
    reasons: tuple[str, ...] = ()
    """Why it is not ``ok``, and what else a reader must know, in words."""
    r: float = math.nan
    """Mean raw comparison over animals."""
    reliability: float = math.nan
    """Mean Spearman-Brown-corrected split-half reliability over animals."""
    reliability_interval: Interval | None = None
    """Of ``reliability``, over animals."""
    interval: Interval | None = None
    """Of ``value``."""
    p: float = math.nan
    """Of a value as high without a match, by ``p_method``."""
    p_method: str = ""
    """The test, what was exchanged and how often."""
    p_smallest: float = math.nan
    """Smallest p that this number of stimuli can give."""
    ceiling: Ceiling | None = None
    """Of ``r``; None where the metric has none."""
    layer: str | None = None
    """The layer chosen most often when each animal in turn is held out."""
    layer_rule: str = ""
    """How layers were chosen."""
    best_layer: str | None = None
    """Layer of ``best_layer_value``."""
    best_layer_value: float = math.nan
    """The optimistic maximum over layers, chosen and evaluated on the same data. Not a result."""
    layers: tuple[LayerScore, ...] = ()
    subjects: tuple[SubjectScore, ...] = ()
    estimator: str = "default"
    metric: str = ""
    """What was compared and how, in words."""
    stimuli: tuple[str, ...] = ()
    """Names, in the order of the RDMs."""
    model_rdm: tuple[float, ...] = ()
    """[P], of ``layer``."""
    brain_rdm: tuple[float, ...] = ()
    """[P], mean over the animals that were scored."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Versions, machine, data with hashes, settings and the command that makes it again."""

    def to_json(self) -> str:
        """Serialise deterministically; NaN becomes null."""
        from brainbench.core.files import to_json

        return to_json(self)

    @classmethod
    def from_json(cls, source: str | Mapping[str, Any]) -> Score:
        """Rebuild a score from :meth:`to_json` or from the mapping inside it.

        Raises:
            DataError: a field is missing, unknown or of the wrong kind.
        """
        data = _mapping(source, "score")
        return _build(
            cls,
            data,
            reliability_interval=_optional(Interval, data.get("reliability_interval")),
            interval=_optional(Interval, data.get("interval")),
            ceiling=_optional(Ceiling, data.get("ceiling")),
            layers=tuple(
                _build(LayerScore, item, interval=_optional(Interval, item.get("interval")))
                for item in data.get("layers", ())
            ),
            subjects=tuple(_build(SubjectScore, item) for item in data.get("subjects", ())),
        )

    def summary(self) -> str:
        """One line a person reads: value, interval, p and status."""
        if self.status == "undefined":
            return f"{self.name}: undefined ({'; '.join(self.reasons)})"
        text = f"{self.name}: {self.value:.3f}"
        if self.interval is not None:
            text += f" [{self.interval.low:.3f}, {self.interval.high:.3f}]"
        if math.isfinite(self.p):
            text += f", p = {self.p:.2g}"
        return text if self.status == "ok" else f"{text} ({self.status}: {'; '.join(self.reasons)})"

    def _repr_html_(self) -> str:
        """Show the score as a small table in a notebook."""
        from html import escape

        rows = [
            ("score (noise-corrected)", _number(self.value) + (f" {_span(self.interval)}" if self.interval else "")),
            ("status", ": ".join([self.status, *filter(None, ["; ".join(self.reasons)])])),
            ("raw r", _number(self.r)),
            ("reliability", _number(self.reliability)),
            ("permutation p", _number(self.p)),
            ("noise ceiling (raw r)", _span(self.ceiling) if self.ceiling else "none"),
            ("layer", f"{self.layer} ({self.layer_rule})"),
            ("optimistic maximum", f"{_number(self.best_layer_value)} at {self.best_layer}"),
            ("estimator", f"{self.estimator}; {self.metric}"),
        ]
        body = "".join(f"<tr><th>{escape(key)}</th><td>{escape(text)}</td></tr>" for key, text in rows)
        return f"<table><caption>{escape(self.name)}</caption>{body}</table>"


@dataclass(frozen=True)
class GraphNode:
    """One part of a model, as a diagram shows it."""

    name: str
    """Name of the layer in :attr:`Score.layers` where the part is one."""
    part: str
    """``input``, ``encoder``, ``attender`` or ``decoder``."""
    kind: str
    """What it computes, such as ``convolution 2×2``."""
    memory: str = ""
    """Its recurrent cell; empty for none."""
    shape: tuple[int, ...] = ()
    """Shape of its output at one time step."""
    parameters: int | None = None


@dataclass(frozen=True)
class GraphEdge:
    """A connection between two parts of a model."""

    source: str
    target: str
    feedback: bool = False
    """True for a connection that leads back and therefore acts one step later."""


@dataclass(frozen=True)
class ModelGraph:
    """Parts of a model and their connections, from input to output."""

    nodes: tuple[GraphNode, ...]
    edges: tuple[GraphEdge, ...]


@dataclass(frozen=True)
class ModelCard:
    """What a scored model is. Fields that do not apply are None."""

    name: str
    family: str = ""
    objective: str | None = None
    augmentation: str | None = None
    parameters: int | None = None
    multiply_adds: int | None = None
    """Multiply-adds per time step of one stimulus."""
    top1: float | None = None
    """Share of test sweeps whose class is the network's first answer."""
    top5: float | None = None
    """Share whose class is among its first five."""
    accuracy_interval: Interval | None = None
    """Of ``top1``."""
    accuracy_data: str | None = None
    """Content hash of the test data behind the accuracies."""
    collapsed: bool | None = None
    """Whether it answers everything with one class, or its features fall into one point."""
    twin: str | None = None
    """Registry name of the untrained twin."""
    seed: int | None = None
    """Of its weights."""
    weights: str | None = None
    """Content hash of the weights that were scored."""
    input: str = ""
    """How the stimuli were turned into the model's input (units, normaliser)."""
    encoder: str | None = None
    """Encoder with its memory, without its size, such as ``zhuang-intersection-ln``."""
    attender: str | None = None
    """``gpt``, ``mamba``, or ``none`` for a network known to have none."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """How it was trained: optimiser, epochs, batch, data, as the checkpoint states it. Empty if untrained."""
    graph: ModelGraph | None = None
    citation: str | None = None
    """Papers that the architecture comes from."""
    twin_top1: float | None = field(default=None, metadata={"later": True})
    """Top-1 accuracy of the untrained twin, its decoder trained on the same data."""
    twin_interval: Interval | None = field(default=None, metadata={"later": True})
    """Of ``twin_top1``."""


@dataclass(frozen=True)
class ResultRecord:
    """A score with what is needed to judge it: animals, baselines and the model card."""

    score: Score
    animal_to_animal: Score | None = None
    baselines: Mapping[str, Score] = field(default_factory=dict)
    card: ModelCard | None = None
    synthetic: bool = False
    """True when the recordings are synthetic: ranks then say nothing about brains."""
    schema: int = RECORD_SCHEMA

    def to_json(self) -> str:
        """Serialise deterministically; NaN becomes null."""
        from brainbench.core.files import to_json

        return to_json(self)

    @classmethod
    def from_json(cls, source: str | Mapping[str, Any]) -> ResultRecord:
        """Rebuild a record; one of an earlier schema version is brought to this one (:func:`migrate_record`).

        Raises:
            DataError: it is not a record of a schema version this package reads.
        """
        data = migrate_record(_mapping(source, "result record"))
        if "score" not in data:
            raise DataError("This result record is incomplete (it has no 'score').")
        card = data.get("card")
        return _build(
            cls,
            data,
            score=Score.from_json(data["score"]),
            animal_to_animal=_optional_score(data.get("animal_to_animal")),
            baselines={key: Score.from_json(item) for key, item in data.get("baselines", {}).items()},
            card=card and _card(card),
        )

    @property
    def identity(self) -> str:
        """Content hash of the result without time and machine: equal inputs give equal names."""
        from brainbench.core.files import to_plain

        return record_identity(to_plain(self))

    def _repr_html_(self) -> str:
        """Show the score and its baselines in a notebook."""
        parts = [self.score, *([self.animal_to_animal] if self.animal_to_animal else []), *self.baselines.values()]
        return "".join(part._repr_html_() for part in parts)


def record_identity(data: Mapping[str, Any]) -> str:
    """Return the content hash of a record given as the mapping inside its JSON, of any schema version.

    What differs between two runs of one computation does not count: time, machine, packages, command.
    """
    from brainbench.core.files import content_hash

    return content_hash(
        {
            **data,
            "score": _steady(data.get("score")),
            "animal_to_animal": _steady(data.get("animal_to_animal")),
            "baselines": {name: _steady(item) for name, item in (data.get("baselines") or {}).items()},
        }
    )


def _steady(score: Mapping[str, Any] | None) -> dict[str, Any] | None:
    if score is None:
        return None
    volatile = ("time", "machine", "python", "packages", "seconds", "command")
    kept = {name: value for name, value in (score.get("provenance") or {}).items() if name not in volatile}
    return {**score, "provenance": kept}


def migrate_record(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """Bring the mapping inside a record's JSON to :data:`RECORD_SCHEMA`.

    Version 2 added to version 1 the model card's encoder, attender, training, graph and citation and the
    layers' intervals; all of them may be absent, so nothing but the number changes.

    Raises:
        DataError: the version is unknown here.
    """
    version = data.get("schema")
    if version == 1 and not isinstance(version, bool):
        return {**data, "schema": 2}
    if version == RECORD_SCHEMA:
        return data
    newer = isinstance(version, int) and version > RECORD_SCHEMA
    advice = "update brainbench" if newer else "score the model again or use the version that wrote it"
    raise DataError(
        f"This result record has schema version {version!r}; this brainbench reads versions 1 to "
        f"{RECORD_SCHEMA}; {advice}."
    )


def _number(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else "undefined"


def _span(interval: Interval | Ceiling) -> str:
    low, high = (interval.low, interval.high) if isinstance(interval, Interval) else (interval.lower, interval.upper)
    return f"[{_number(low)}, {_number(high)}]"


def _mapping(source: str | Mapping[str, Any], what: str) -> Mapping[str, Any]:
    import json

    if isinstance(source, str):
        try:
            source = json.loads(source)
        except json.JSONDecodeError as error:
            raise DataError(f"This {what} is not valid JSON ({error}).") from error
    if not isinstance(source, Mapping):
        raise DataError(f"A {what} is a JSON object; received {type(source).__name__}.")
    return source


def _card(data: Mapping[str, Any]) -> ModelCard:
    graph = data.get("graph")
    if graph is not None:
        nodes = tuple(_build(GraphNode, item) for item in graph.get("nodes", ()))
        graph = ModelGraph(nodes, tuple(_build(GraphEdge, item) for item in graph.get("edges", ())))
    spans = {name: _optional(Interval, data.get(name)) for name in ("accuracy_interval", "twin_interval")}
    return _build(ModelCard, data, **spans, graph=graph)


def _optional(kind: type, data: Mapping[str, Any] | None) -> Any:
    return None if data is None else _build(kind, data)


def _optional_score(data: Mapping[str, Any] | None) -> Score | None:
    return None if data is None else Score.from_json(data)


def _build(kind: type, data: Mapping[str, Any], **ready: Any) -> Any:
    """Make a dataclass from JSON: null becomes NaN for floats, lists become tuples."""
    annotations = {item.name: str(item.type) for item in fields(kind)}
    unknown = sorted(set(data) - set(annotations))
    if unknown:
        raise DataError(f"A {kind.__name__} has no field {unknown[0]!r}; it has {sorted(annotations)}.")
    values: dict[str, Any] = {}
    for name, value in data.items():
        if value is None and annotations[name] == "float":
            value = math.nan
        elif isinstance(value, list):
            value = tuple(math.nan if item is None else item for item in value)
        values[name] = value
    try:
        return kind(**{**values, **ready})
    except TypeError as error:
        raise DataError(f"This {kind.__name__} is incomplete ({error}).") from error
