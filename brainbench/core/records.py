"""Scores and result records: one model's match to one set of recordings, typed and checked.

Letters: K stimulus, P = K(K−1)/2 RDM pair.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache, cached_property
from html import escape
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_args

import msgspec

from brainbench.core.errors import DataError, brief, listing
from brainbench.core.files import content_hash, to_json, to_plain
from brainbench.core.provenance import Provenance
from brainbench.core.reading.texts import check_values, parse_json
from brainbench.core.reading.values import typed_values

Status = Literal["ok", "unreliable", "undefined"]
"""``ok``: can be trusted; ``unreliable``: computed, but the data are too noisy or too few to trust
it; ``undefined``: no number exists. The reason stands in words beside it."""

RECORD_SCHEMA: Literal[2] = 2  # version of the result-record JSON layout

ESTIMATOR_VERSION = 5
"""Raised whenever the same recordings and activations would get another number from the default estimator."""

_ROUNDING = 1e-6
_LARGEST = 1e100  # largest absolute number of a record: squares and sums of such are still finite

if TYPE_CHECKING:
    Number = Reliability = Share = float
    Count = int
else:
    # JSON has no NaN: a number without value is written as null, and read back as NaN (NullIsNaN).
    Number = Annotated[float, msgspec.Meta(ge=-_LARGEST, le=_LARGEST)] | None
    Reliability = Annotated[float, msgspec.Meta(ge=-_LARGEST, le=1 + _ROUNDING)] | None
    Share = Annotated[float, msgspec.Meta(ge=0, le=1)] | None
    Count = Annotated[int, msgspec.Meta(ge=0)]


class NullIsNaN:
    """Base of dataclasses that hold numbers and are read from JSON."""

    def __post_init__(self) -> None:
        for name, alone in _numbers(type(self)):
            value = getattr(self, name)
            if alone and value is None:
                object.__setattr__(self, name, math.nan)
            elif not alone and isinstance(value, tuple) and None in value:
                object.__setattr__(self, name, tuple(math.nan if one is None else one for one in value))


@cache
def _numbers(kind: Any) -> list[tuple[str, bool]]:
    """Return the names of a dataclass' numbers, true, and tuples of numbers, false."""
    alone = {"Number": True, "Reliability": True, "Share": True, "tuple[Number, ...]": False}
    return [(slot.name, alone[str(slot.type)]) for slot in fields(kind) if slot.type in alone]


@dataclass(frozen=True)
class Interval(NullIsNaN):
    """A confidence interval with the method that made it."""

    low: Number
    high: Number
    level: Share = 0.95
    """Share of repetitions whose intervals hold the truth."""
    method: str = ""
    """Method that made it, over what, and why it may be unreliable."""


def spanned(value: float, interval: Interval | None = None, *, most: float = math.inf) -> str:
    """Return ``value [low, high]`` with as many digits as the interval carries: two of its half-width.

    A value without interval has two digits, NaN is a dash. The interval is cut at ``most``, the largest possible value.

    >>> spanned(0.14021, Interval(0.0409, 0.2391)), spanned(0.97, Interval(0.9412, 1.1), most=1.0)
    ('0.140 [0.041, 0.239]', '0.970 [0.941, 1.000]')
    """
    if not math.isfinite(value):
        return "–"
    if interval is None or not math.isfinite(interval.high - interval.low):
        return f"{value:.2f}" if abs(value) >= 0.1 else f"{value:.2g}"
    half = (interval.high - interval.low) / 2
    digits = min(max(1 - math.floor(math.log10(half)), 0), 9) if half > 0 else 3
    return f"{value:.{digits}f} [{interval.low:.{digits}f}, {min(interval.high, most):.{digits}f}]"


@dataclass(frozen=True)
class Ceiling(NullIsNaN):
    """Noise ceiling of the raw (uncorrected) comparison: what a perfect model could reach."""

    lower: Number
    """Each animal against the mean of the others."""
    upper: Number
    """Each animal against the mean of all."""
    method: str = "leave-one-animal-out (lower), mean of all (upper)"


@dataclass(frozen=True)
class SubjectScore(NullIsNaN):
    """One animal's part of a score."""

    subject: str
    value: Number
    """Noise-corrected score; NaN when undefined."""
    r: Number
    """Raw comparison of the model's RDM with this animal's."""
    reliability: Reliability
    """Share of this animal's squared RDM that is no noise, from halves of its trials."""
    status: Status = "ok"
    units: Count = 0
    """Neurons that entered."""
    trials: Count = 0
    """Trials that entered."""
    layer: str | None = None
    """Layer evaluated on this animal; it was chosen without this animal's data."""


@dataclass(frozen=True)
class LayerScore(NullIsNaN):
    """One layer compared with every animal; shown for reading, never picked from."""

    layer: str
    value: Number
    """Mean noise-corrected score over the animals whose RDM is reliable, on the scale of the layer that was chosen."""
    r: Number
    """Mean raw comparison over the same animals."""
    status: Status = "ok"
    interval: Interval | None = None
    """Interval of ``value``, over animals."""


class _Document:
    """Base of what a file holds: to and from JSON."""

    def to_json(self) -> str:
        """Serialise deterministically; NaN becomes null."""
        return to_json(self)

    @classmethod
    def from_json(cls, source: str | Mapping[str, Any]) -> Self:
        """Rebuild it from :meth:`to_json` or from the mapping inside it."""
        data = parse_json(source, "This text") if isinstance(source, str) else check_values(source, "the record")
        cls._check_version(data)
        choices = {"status": get_args(Status), "schema": (RECORD_SCHEMA,)}
        document = typed_values(cls, data, "the record", choices=choices)
        _check_rest(data, document, "")
        for score in document.scores:
            if contradiction := _contradiction(score):
                raise DataError(f"The score {brief(score.name)} contradicts itself: {contradiction}.")
        return document

    @classmethod
    def _check_version(cls, data: Any) -> None:
        """Raise DataError for a layout that is not read here."""

    @property
    def scores(self) -> tuple[Score, ...]:
        """All scores that it holds."""
        raise NotImplementedError


if TYPE_CHECKING:
    _StatedProvenance = Provenance
else:
    _StatedProvenance = Mapping[str, Any]  # in a file any object; Score makes it typed


@dataclass(frozen=True)
class Score(NullIsNaN, _Document):
    """One model's match to one set of recordings, with its statistics.

    Everything printed or published comes from this object. ``value`` is NaN exactly when
    ``status`` is ``undefined``. RDMs are upper triangles [P] in the order of ``stimuli``.
    """

    name: str
    """Name of the model."""
    value: Number
    """Mean over animals, corrected for their noise where the metric can be."""
    status: Status
    """``ok``, ``unreliable`` or ``undefined``."""
    reasons: tuple[str, ...] = ()
    """Reasons why it is not ``ok``, and what else a reader must know, in words."""
    r: Number = math.nan
    """Mean raw comparison over animals."""
    reliability: Reliability = math.nan
    """Mean reliability over animals."""
    reliability_interval: Interval | None = None
    """Interval of ``reliability``, over animals."""
    interval: Interval | None = None
    """Interval of ``value``."""
    p: Share = math.nan
    """Probability of a value as high without a match, by ``p_method``."""
    p_method: str = ""
    """The test, what was exchanged and how often."""
    p_smallest: Share = math.nan
    """Smallest p that this number of stimuli can give."""
    ceiling: Ceiling | None = None
    """Noise ceiling of ``r``; None where the metric has none."""
    layer: str | None = None
    """The layer chosen most often when each animal in turn is held out."""
    layer_rule: str = ""
    """Rule by which layers were chosen."""
    best_layer: str | None = None
    """Layer of ``best_layer_value``."""
    best_layer_value: Number = math.nan
    """The optimistic maximum over layers, chosen and evaluated on the same data. Not a result."""
    layers: tuple[LayerScore, ...] = ()
    subjects: tuple[SubjectScore, ...] = ()
    estimator: str = "default"
    metric: str = ""
    """Comparison and its measure, in words."""
    stimuli: tuple[str, ...] = ()
    """Names, in the order of the RDMs."""
    model_rdm: tuple[Number, ...] = ()
    """[P], of ``layer``."""
    brain_rdm: tuple[Number, ...] = ()
    """[P], mean over the animals that were scored."""
    chance: Number = field(default=math.nan, metadata={"later": True})
    """Mean of ``value`` under permuted stimuli, the choice of layer repeated in each permutation."""
    attainable: Number = field(default=math.nan, metadata={"later": True})
    """``value`` of a model that explains all that is reliable: 1 where the metric corrects for noise. NaN where chance
    reaches it, so that there is no scale."""
    without_stimulus: tuple[Number, ...] = field(default=(), metadata={"later": True})
    """[K] ``value`` without each stimulus in turn, for the variance over stimuli (jackknife); layers and corrections
    for noise are those of the whole."""
    provenance: _StatedProvenance = field(default_factory=Provenance)
    """Versions, machine, data with hashes, settings and the command that makes it again; a mapping becomes typed."""

    def __post_init__(self) -> None:
        """Read null as NaN, and any mapping as provenance."""
        super().__post_init__()
        if not isinstance(self.provenance, Provenance):
            object.__setattr__(self, "provenance", Provenance.of(self.provenance))

    @property
    def scores(self) -> tuple[Score, ...]:
        """This score."""
        return (self,)

    @property
    def intervals(self) -> list[tuple[str, float, Interval]]:
        """Each interval with its name and the number that it is of."""
        stated = [
            ("interval", self.value, self.interval),
            ("reliability_interval", self.reliability, self.reliability_interval),
            *((f"the interval of layer {brief(part.layer)}", part.value, part.interval) for part in self.layers),
        ]
        return [(name, value, interval) for name, value, interval in stated if interval is not None]

    @property
    def doubts(self) -> list[str]:
        """What is hardly true at once, in words: bootstrap intervals may miss their number, but by little."""
        return [
            f"{name} of the score {brief(self.name)} runs from {interval.low:.4g} to {interval.high:.4g}, without the "
            f"number {value:.4g} that it is of"
            for name, value, interval in self.intervals
            if value < interval.low - _ROUNDING or value > interval.high + _ROUNDING
        ]

    def on_scale(self, value: float) -> float:
        """Return a value of this score's metric on the scale that all metrics share.

        0 is chance and 1 all that is reliable: (value − chance)/(attainable − chance). NaN where chance is unknown or
        not below what is attainable.
        """
        span = self.attainable - self.chance
        return (value - self.chance) / span if span > 0 else math.nan

    @property
    def scaled(self) -> float:
        """``value`` between chance (0) and all that is reliable (1); what boards show and rank by."""
        return self.on_scale(self.value)

    @property
    def scaled_interval(self) -> Interval | None:
        """``interval`` on the scale of :attr:`scaled`; None where either is unknown."""
        if self.interval is None or math.isnan(self.on_scale(0.0)):
            return None
        low, high = self.on_scale(self.interval.low), self.on_scale(self.interval.high)
        return Interval(low, high, self.interval.level, self.interval.method)

    def summary(self) -> str:
        """Return one line to read: scaled score (the value where there is no scale), interval, p and status."""
        if self.status == "undefined":
            return f"{self.name}: undefined ({'; '.join(self.reasons)})"
        placed = math.isfinite(self.scaled)
        number, span = (self.scaled, self.scaled_interval) if placed else (self.value, self.interval)
        text = f"{self.name}: {'' if placed else 'value '}{number:.3f}"
        if span is not None:
            text += f" [{span.low:.3f}, {span.high:.3f}]"
        if placed:
            text += " from chance (0) to all that is reliable (1)"
        if math.isfinite(self.p):
            text += f", p = {self.p:.2g}"
        return text if self.status == "ok" else f"{text} ({self.status}: {'; '.join(self.reasons)})"

    def _repr_html_(self) -> str:
        """Show the score as a small table in a notebook."""
        ceiling = f"{spanned(self.ceiling.lower)} to {spanned(self.ceiling.upper)}" if self.ceiling else "none"
        rows = [
            ("score, from chance (0) to all that is reliable (1)", spanned(self.scaled, self.scaled_interval)),
            ("value", f"{spanned(self.value, self.interval)}; chance {spanned(self.chance)}"),
            ("status", ": ".join([self.status, *filter(None, ["; ".join(self.reasons)])])),
            ("raw r", spanned(self.r)),
            ("reliability", spanned(self.reliability)),
            ("permutation p", spanned(self.p)),
            ("noise ceiling (raw r)", ceiling),
            ("layer", self.layer_rule if self.layer is None else f"{self.layer} ({self.layer_rule})"),
            ("optimistic maximum", f"{spanned(self.best_layer_value)} at {self.best_layer}" if self.best_layer else ""),
            ("estimator", f"{self.estimator}; {self.metric}"),
        ]
        body = "".join(f"<tr><th>{escape(key)}</th><td>{escape(text)}</td></tr>" for key, text in rows if text)
        return f"<table><caption>{escape(self.name)}</caption>{body}</table>"


@dataclass(frozen=True)
class GraphNode:
    """One part of a model, as a diagram shows it."""

    name: str
    """Name of the layer in :attr:`Score.layers` where the part is one."""
    part: str
    """``input``, ``encoder``, ``attender`` or ``decoder``."""
    kind: str
    """Kind of computation, such as ``convolution 2×2``."""
    memory: str = ""
    """Its recurrent cell; empty for none."""
    shape: tuple[Count, ...] = ()
    """Shape of its output at one time step."""
    parameters: Count | None = None


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
    """Facts about a scored model. Fields that do not apply are None."""

    name: str
    family: str = ""
    objective: str | None = None
    augmentation: str | None = None
    parameters: Count | None = None
    multiply_adds: Count | None = None
    """Multiply-adds per time step of one stimulus."""
    top1: Share | None = None
    """Share of test sweeps whose class is the network's first answer."""
    top5: Share | None = None
    """Share whose class is among its first five."""
    accuracy_interval: Interval | None = None
    """Interval of ``top1``."""
    accuracy_data: str | None = None
    """Content hash of the test data behind the accuracies."""
    collapsed: bool | None = None
    """True when it answers everything with one class, or its features fall into one point."""
    twin: str | None = None
    """Registry name of the untrained twin."""
    seed: int | None = None
    """Seed of its weights."""
    weights: str | None = None
    """Content hash of the weights that were scored."""
    input: str = ""
    """Preparation of the stimuli for the model (units, normaliser)."""
    encoder: str | None = None
    """Encoder with its memory, without its size, such as ``zhuang-intersection-ln``."""
    attender: str | None = None
    """``gpt``, ``mamba``, or ``none`` for a network known to have none."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """Its training: optimiser, epochs, batch, data, as the checkpoint states it. Empty if untrained."""
    graph: ModelGraph | None = None
    citation: str | None = None
    """Papers that the architecture comes from."""
    twin_top1: Share | None = field(default=None, metadata={"later": True})
    """Top-1 accuracy of the untrained twin, its decoder trained on the same data."""
    twin_interval: Interval | None = field(default=None, metadata={"later": True})
    """Interval of ``twin_top1``."""
    layer: str | None = field(default=None, metadata={"later": True})
    """Layer that was committed to before anything was scored."""


@dataclass(frozen=True)
class ResultRecord(_Document):
    """A score with what is needed to judge it: animals, baselines and the model card."""

    score: Score
    animal_to_animal: Score | None = None
    baselines: Mapping[str, Score] = field(default_factory=dict)
    card: ModelCard | None = None
    synthetic: bool = False
    """True when the recordings are synthetic: ranks then say nothing about brains."""
    schema: Literal[2] = RECORD_SCHEMA

    @classmethod
    def _check_version(cls, data: Any) -> None:
        version = data.get("schema") if isinstance(data, Mapping) else RECORD_SCHEMA
        if type(version) is not int or version != RECORD_SCHEMA:
            newer = isinstance(version, int) and version > RECORD_SCHEMA
            advice = "update brainbench" if newer else "score the model again or use the version that wrote it"
            raise DataError(
                f"This result record has schema version {version!r}; this brainbench reads version {RECORD_SCHEMA}; "
                f"{advice}."
            )

    @property
    def scores(self) -> tuple[Score, ...]:
        """The score and those it is judged by."""
        return (self.score, *([self.animal_to_animal] if self.animal_to_animal else []), *self.baselines.values())

    @cached_property
    def identity(self) -> str:
        """Content hash of the result without time and machine: equal inputs give equal names."""
        return record_identity(to_plain(self))

    @property
    def file_name(self) -> str:
        """Name of the record's file: slug of the model's name, two hyphens, content hash.

        >>> ResultRecord(Score("Zhuang Intersection/LN", 0.5, "ok")).file_name[:24]
        'zhuang-intersection-ln--'
        """
        ascii_name = unicodedata.normalize("NFKD", self.score.name).encode("ascii", "ignore").decode().lower()
        slug = re.sub(r"[^a-z0-9.+]+", "-", ascii_name).strip("-.")[:80].rstrip("-.")
        return f"{slug or 'model'}--{self.identity}.json"

    def _repr_html_(self) -> str:
        """Show the score and its baselines in a notebook."""
        return "".join(score._repr_html_() for score in self.scores)


def record_identity(data: Mapping[str, Any]) -> str:
    """Return the content hash of a record given as the mapping inside its JSON.

    What differs between two runs of one computation does not count: time, machine, packages, command.
    """
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
    provenance = {name: value for name, value in (score.get("provenance") or {}).items() if name not in volatile}
    return {**score, "provenance": provenance}


@cache
def _names(kind: Any) -> tuple[str, ...]:
    """Return the names of a dataclass' fields; none for another type, or for provenance, which takes any."""
    return tuple(item.name for item in fields(kind)) if is_dataclass(kind) and kind is not Provenance else ()


def _check_rest(data: Any, built: Any, place: str) -> None:
    """Refuse fields that a dataclass does not have, which msgspec leaves out without a word."""
    if names := _names(type(built)):
        for name, value in data.items():
            if name not in names:
                raise DataError(f"{place or 'the record'} has no field {name!r}; it has {listing(names, limit=40)}.")
            _check_rest(value, getattr(built, name), f"{place}.{name}".lstrip("."))
    elif isinstance(built, tuple) and built and _names(type(built[0])):
        for index, (value, inner) in enumerate(zip(data, built, strict=True)):
            _check_rest(value, inner, f"{place}[{index}]")
    elif isinstance(built, Mapping) and not isinstance(built, Provenance):
        for name, inner in built.items():
            _check_rest(data[name], inner, f"{place}.{name}")


def _contradiction(score: Score) -> str | None:
    """Return what cannot be true at once, or None; what JSON Schema can say stands at the fields."""
    if math.isnan(score.value) != (score.status == "undefined"):
        return f"the status is {score.status!r} but the value is {score.value}"
    count = len(score.stimuli)
    pairs = count * (count - 1) // 2
    for name, wanted in (("model_rdm", pairs), ("brain_rdm", pairs), ("without_stimulus", count)):
        length = len(getattr(score, name))
        if length not in (0, wanted):
            what = "values" if name == "without_stimulus" else "pairs"
            return f"{name} has {length} {what} but {count} stimuli make {wanted}"
    for name, _, interval in score.intervals:
        if interval.low > interval.high:
            return f"{name} runs from {interval.low} down to {interval.high}"
    if score.p <= 0 or score.p < score.p_smallest * (1 - 1e-9):
        return f"p is {score.p} but the smallest possible is {score.p_smallest}"
    if str(score.provenance.settings.get("metric")).startswith("rsa"):  # correlations
        ends = (score.ceiling.lower, score.ceiling.upper) if score.ceiling else ()
        compared = (score.r, *ends, *(one.r for one in (*score.subjects, *score.layers)))
        if any(abs(r) > 1 + _ROUNDING for r in compared):
            return "a raw comparison (r, or its ceiling) is outside -1 to 1"
    return None
