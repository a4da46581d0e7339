"""The main job: score a temporal network against neural recordings.

``score`` joins the four packages in the order of the data: stimuli → model → representational
dissimilarity matrices (RDMs) of every layer; recordings → RDM and reliability of every animal;
both → a noise-corrected comparison with honest statistics.
"""

from __future__ import annotations

import time as clock
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import BY_TRIAL
from brainbench.core.errors import UsageError, check_name, listing
from brainbench.core.files import provenance, to_plain
from brainbench.core.identity import SealedPlan
from brainbench.core.plugins import require_optional
from brainbench.core.progress import Progress, stages, track
from brainbench.core.provenance import Provenance
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord, Score
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.own_stimuli import joined
from brainbench.scoring.presentation import CHANCE_LEVEL, presentation_of

if TYPE_CHECKING:
    from brainbench.metrics import Metric
    from brainbench.scoring.model_responses import ModelResponses, ResolvedModel
    from brainbench.scoring.neural_responses import NeuralResponses


PARTS = "brainbench.scoring"
"""Entry points of what stands in optional folders: additions to a record's statistics by the name of their option,
``published_arrays``, the comparison of a published file as its authors' code takes it, and ``benchmark``."""
_ADDITIONS = ("by", "explain", "over_time")
STAGES = 5
"""Stages of a score that progress is told of: model, recordings, its responses, the animals' RDMs, comparisons."""


@dataclass(frozen=True)
class ScoreInputs:
    """Both sides of a score, ready to be compared."""

    brain: NeuralResponses
    network: ModelResponses
    metric: Metric
    labels: tuple[str, ...]
    """[K] labels that are compared, in order."""
    rows: list[int]
    """[K] their rows in the activations."""
    animals: tuple[Any, ...]
    """What the metric made of each animal."""
    options: ScoreOptions
    doubts: tuple[str, ...] = ()
    """Reasons why no score of these recordings is to be trusted, whatever its units or times."""

    @cached_property
    def features(self) -> Mapping[str, Any]:
        """Features [K, F] of every layer of the model."""
        return self.network.features(self.rows)


def score(
    model: Any,
    options: ScoreOptions | None = None,
    *,
    baselines: bool = False,
    progress: Progress | None = None,
    **changes: Any,
) -> Score:
    """Score a model against recordings.

    Args:
        model: a registry name (``"zhuang-intersection-ln"``), a ``torch.nn.Module`` mapping
            [B, T, C, H, W] → [B, …], ``"path/to/file.py:make_model"``, a file of activations
            (:mod:`brainbench.models.features`), or a mapping {layer: [K, F] or [K, T, F]} whose rows
            follow the stimuli.
        options: how it is scored; the defaults without.
        baselines, progress: see :func:`score_record`.
        **changes: single fields of :class:`~brainbench.scoring.options.ScoreOptions`, such as
            ``recordings="data/*.nwb"`` or ``metric="cka"``.
    """
    return score_record(model, options, baselines=baselines, progress=progress, **changes).score


def score_record(
    model: Any,
    options: ScoreOptions | None = None,
    *,
    baselines: bool = True,
    command: str | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> ResultRecord:
    """Score a model and its baselines, with everything that a leaderboard needs.

    Args:
        model, options, **changes: as in :func:`score`.
        baselines: also score the raw input, random features, times of presentation and animal against animal.
        command: the command line that makes this record, kept in its provenance.
        progress: called with (done, total, what).
    """
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.scoring.neural_responses import open_neural_responses

    started = clock.perf_counter()
    stage_done = stages(STAGES, "scoring", progress)
    options = ScoreOptions.of({**vars(options or ScoreOptions()), **changes})
    benchmark = with_benchmark(options, changes)
    options = _options(model, options if benchmark is None else benchmark.options)
    plan = None if options.plan is None else SealedPlan.read(options.plan)
    # Whatever can be wrong with a name or a file is found before the slow part, the simulation.
    metric = metric_of(options)
    options = replace(options, metric=metric)
    _prepare(model, options, progress)
    resolved = resolve_model(model, seed=options.model_seed)
    resolved.committed(options)
    stage_done()
    brain = open_neural_responses(options.recordings, progress=progress, **options.selection)
    brain = replace(brain, title=options.title, covariates=metric.of_covariates)
    brain = brain if benchmark is None else benchmark.checked(brain)
    stage_done()
    # Recordings name the stimuli that the animals felt; the caller's choice goes first.
    options = replace(options, stimuli=brain.stimuli if options.stimuli is None else options.stimuli)
    _check_inputs(resolved, brain, options)
    network = resolved.respond(options, progress=progress)
    stage_done()
    brain, network, pairs = joined(brain, network, options)
    labels = tuple(pairs)
    if plan is not None:
        plan.check_stimuli((*labels, *pairs.values()))
    rows = [network.labels.index(label) for label in pairs.values()]
    animals = brain.animals(labels, metric, options, progress=progress)
    inputs = ScoreInputs(brain, network, metric, labels, rows, animals, options)
    stage_done()

    scores, between, doubts = _compare(inputs, baselines=baselines, progress=progress)
    inputs = replace(inputs, doubts=doubts)
    stage_done()
    by_trial = {"match": BY_TRIAL} if options.match == BY_TRIAL else {}
    settings = {"estimator_version": ESTIMATOR_VERSION, "model": model if isinstance(model, str) else None, **by_trial}
    # Features with labels of their own were computed elsewhere, of stimuli unknown here.
    if resolved.labels is not None:
        settings |= dict.fromkeys(("stimuli", "whiskers", "fidelity"))
    origin = Provenance.of(
        provenance(
            **network.origin,
            recordings=brain.origin,
            pairs=brain.stated_pairs(pairs),
            settings=options.settings | settings,
            seconds=round(clock.perf_counter() - started, 2),
            **({"command": command} if command else {}),
            **({"plan": to_plain(plan)} if plan else {}),
            **({"benchmark": benchmark.stated} if benchmark else {}),
        )
    )
    statistics = [score.provenance.statistics for score in scores]
    for name in _ADDITIONS:
        if getattr(options, name):
            statistics[0] = {**statistics[0], **_optional(name)(inputs, progress=progress)}
    first, *rest = (
        replace(score, provenance=replace(origin, statistics=stated))
        for score, stated in zip(scores, statistics, strict=True)
    )
    # The animals' RDM stands in the record once.
    rest = [replace(score, brain_rdm=()) for score in rest]
    if between is not None:
        between = replace(between, brain_rdm=(), provenance=replace(origin, statistics=between.provenance.statistics))
    record = ResultRecord(first, between, {score.name: score for score in rest}, network.card, brain.synthetic)
    record = record if benchmark is None else benchmark.portable(record)
    if plan is None or not any(plan.deviations(record)):
        return record
    reasons = (*record.score.reasons, f"deviates from its sealed plan {plan.hash}")
    return replace(record, score=replace(record.score, reasons=reasons))


def with_benchmark(options: ScoreOptions, explicit: Iterable[str] = ()) -> Any:
    """Return the open benchmark that options name, with those of the score (``.options``); None where none is named.

    ``explicit`` are options that count as given although they are the defaults.
    """
    return None if options.benchmark is None else _optional("benchmark")(options, explicit)


def _options(model: Any, options: ScoreOptions) -> ScoreOptions:
    """Return options; a seed or a fidelity that would reach nothing is refused."""
    from brainbench.scoring.model_responses import follows_seed
    from brainbench.stimuli.sources import is_finished

    if options.weights_seed not in (None, options.seed) and not follows_seed(model):
        raise UsageError("weights_seed is that of untrained weights, and those of this model are given; leave it out.")
    if options.stimuli is not None and is_finished(options.stimuli) and options.fidelity not in (None, "balanced"):
        raise UsageError("fidelity is that of a simulation, and these stimuli are finished; leave it out.")
    return options


def _prepare(model: Any, options: ScoreOptions, progress: Progress | None) -> None:
    """Let the simulation get ready in a thread while the network loads, if any will be needed."""
    from brainbench.scoring.demo import DEMOS
    from brainbench.stimuli.sources import prepare_stimuli

    if isinstance(options.recordings, str) and options.recordings in DEMOS:
        prepare_stimuli(DEMOS[options.recordings], progress=progress)
    elif not isinstance(model, Mapping) and options.stimuli is not None:
        prepare_stimuli(options.stimuli, whiskers=options.whiskers, fidelity=options.fidelity, progress=progress)


def _check_inputs(resolved: ResolvedModel, brain: NeuralResponses, options: ScoreOptions) -> None:
    """Refuse what does not fit before anything is simulated: labels, where they are known by then."""
    from brainbench.scoring.model_responses import DEFAULT_STIMULI
    from brainbench.stimuli.sources import known_labels

    if options.by is not None:
        brain.groups(options.by)
    if brain.published and options.estimator != "default" and options.units_reliability is not None:
        raise UsageError(f"The estimator {options.estimator!r} takes all published units; leave out units_reliability.")
    if resolved.activations is not None and (options.whiskers != "all" or options.fidelity not in (None, "balanced")):
        raise UsageError("whiskers and fidelity are of a simulation, and these features were computed elsewhere.")
    source = DEFAULT_STIMULI if options.stimuli is None else options.stimuli
    if resolved.labels is not None or (labels := known_labels(source)) is None:
        return
    try:
        brain.pairs(labels, options.match)
    except UsageError as error:
        if options.stimuli is not None:
            raise
        raise UsageError(
            f"{error} The recordings do not name their stimuli, so the recipe {source!r} was taken; --stimuli names "
            "another."
        ) from error


def _compare(
    inputs: ScoreInputs, *, baselines: bool, progress: Progress | None
) -> tuple[list[Score], Score | None, tuple[str, ...]]:
    """Score the features of the model (the first) and, if asked, of baselines and the animals; also return doubts.

    The published estimators take a published file as its authors' code does: zeros kept, the maximum over all layers.
    """
    from brainbench.scoring.model_responses import RAW_INPUT

    brain, network, options = inputs.brain, inputs.network, inputs.options
    rivals = network.baseline_features(inputs.rows, options.seed) if baselines else {}
    features = {network.card.name: inputs.features, **rivals}
    if brain.published and options.estimator != "default":
        scores, between = _optional("published_arrays")(inputs, features, agreement=baselines)
    else:
        how: dict[str, Any] = {"stimuli": inputs.labels, "estimator": options.estimator, "seed": options.seed}
        more: dict[str, Any] = {network.card.name: {"layer": network.card.layer}}
        if (raw := rivals.get(RAW_INPUT)) and inputs.metric.of_unique_parts:
            kinematics = {name: values[inputs.rows] for name, values in network.kinematics.items()}
            more[network.card.name]["controls"] = {RAW_INPUT: raw["input"], **kinematics}
        scores = [
            inputs.metric.score(layers, inputs.animals, name=name, **more.get(name, {}), **how)
            for name, layers in track([*features.items()], "models", progress)
        ]
        between = inputs.metric.score_animals(inputs.animals, **how) if baselines else None
    presentation = presentation_of(inputs.metric, inputs.animals, inputs.labels, control=baselines, seed=options.seed)
    spikes = "many trials share spikes with another one of their stimulus, which makes noise look reliable"
    recorded = brain.label_doubt, spikes if brain.dependent else "", of_no_neurons(inputs.metric, inputs.animals)
    recorded = *recorded, brain.chance_doubt(inputs.labels, options), same_stimuli(inputs)
    wrong = *presentation.doubts, *filter(None, recorded)
    scores = [doubted(score, *wrong) for score in scores]
    stated = scores[0].provenance
    effective, remarks = influence_of(scores[0], inputs.metric, inputs.animals)
    statistics = {**stated.statistics, **presentation.statistics, **effective}
    scores[0] = held_parts(replace(scores[0], provenance=replace(stated, statistics=statistics)))
    between = between and doubted(between, *wrong)
    if baselines and presentation.control is not None:
        # That the times alone explain something is no doubt about the times.
        scores.append(doubted(presentation.control, *recorded))
    doubts = (*network.doubts, *brain.doubts)
    steps = max(values.shape[1] for values in network.activations.values())
    if options.time == "concatenate" and brain.dataset.sizes["time"] == 1 < steps:
        doubts += (f"{steps} time steps of the network are compared with one bin of the recordings: give a --bin",)
    unfelt = [label for row, label in enumerate(network.labels) if row not in inputs.rows]
    if unfelt and options.match is None:
        names = listing(unfelt, limit=6, quoted=False)
        doubts += (f"{len(unfelt)} of {len(network.labels)} stimuli have no recordings and are left out: {names}",)
    scores = [replace(score, reasons=(*score.reasons, *doubts)) for score in scores]
    scores[0] = replace(scores[0], reasons=(*scores[0].reasons, *remarks, *presentation.remarks))
    return scores, between and replace(between, reasons=(*between.reasons, *doubts)), wrong


def _optional(name: str) -> Any:
    """Return a part of a score that stands in an optional folder, by its entry point."""
    return require_optional(PARTS, name, "part of a score")


def doubted(score: Score, *doubts: str) -> Score:
    """Return a score that is never ``ok`` with a doubt, empty ones aside; why it has no value at all goes first."""
    reasons = tuple(filter(None, doubts))
    if not reasons:
        return score
    if score.status == "undefined":
        return replace(score, reasons=(*score.reasons, *reasons))
    return replace(score, status="unreliable", reasons=(*reversed(reasons), *score.reasons))


def held_parts(score: Score) -> Score:
    """Return a score whose parts are as doubtful as it is: what says little of the score says little of them."""
    part = score.provenance.unique
    if part is None or part.status != "ok" or score.status == "ok":
        return score
    part = replace(part, status="unreliable", reasons=("the score is not ok", *part.reasons))
    statistics = {**score.provenance.statistics, "unique": part.stated}
    return replace(score, provenance=replace(score.provenance, statistics=statistics))


def metric_of(options: ScoreOptions) -> Metric:
    """Return the metric, checked against the other options."""
    from brainbench.metrics import get_metric, list_metrics
    from brainbench.metrics.measures.rsa import RSA

    metric = get_metric(options.metric)
    if metric.name == "rsa" and (options.explain or options.estimator != "default"):
        # The published estimators were those of correlation distances.
        metric = get_metric("rsa-correlation")
    check_name(f"estimator of the metric {metric.name!r}", options.estimator, metric.estimators)
    if options.explain and metric.name != "rsa-correlation":
        raise UsageError(f"The published estimator is one of RSA; the metric {metric.name!r} has none to explain.")
    if options.over_time and not isinstance(metric, RSA):
        choices = [name for name in list_metrics() if isinstance(get_metric(name), RSA)]
        raise UsageError(f"Scores over time compare RDMs; the metric {metric.name!r} has none; choose from {choices}.")
    for name in _ADDITIONS:
        if getattr(options, name):
            _optional(name)
    return metric


DECIDES = 0.5  # share from which a unit or an animal decides alone
EXACT = 0.2  # share of the tuning from which units without noise are a doubt: .25 takes a score of .66 to .59


def effective_number(shares: ArrayLike) -> float:
    """Return (Σw)²/Σw² of shares w, as many as would be of equal size; negative ones count as none, NaN without any.

    >>> effective_number([1, 1, 1, 1]), round(effective_number([9, 1, 0, 0]), 2)
    (4.0, 1.22)
    """
    parts = np.maximum(np.asarray(shares, dtype=np.float64), 0.0)
    return float(parts.sum() ** 2 / (parts**2).sum()) if parts.any() else float("nan")


def unit_shares(animal: Any, *, by_noise: bool = False) -> NDArray[np.float64]:
    """Return the variance over stimuli [U] of each unit's mean responses, without that of noise, ``by_noise`` over it.

    Squared distances are sums over units, so these are what each adds to an animal's RDM.
    """
    noise = animal.noise.mean(axis=0)
    tuned = np.maximum(animal.patterns.var(axis=0, ddof=1) - noise, 0.0)
    return np.divide(tuned, noise, out=np.zeros_like(tuned), where=noise > 0) if by_noise else tuned


def of_no_neurons(metric: Any, animals: Sequence[Any]) -> str:
    """Return the doubt that units without noise beside noisy ones, as channels of stimuli, count much; or nothing."""
    marked = []
    for animal in animals:
        exact = ~(animal.noise > 0).any(axis=0)
        if not exact.all() and (shares := unit_shares(animal))[exact].sum() > EXACT * shares.sum():
            marked.append(f"{animal.subject}: {int((shares[exact] > 0).sum())} of {len(exact)}")
    if not marked or getattr(metric, "noise", "none") != "none":
        return ""
    share = f"{EXACT:.0%} of the tuning in {len(marked)} of {len(animals)} animals ({marked[0]})"
    return f"units that never vary between trials, as neurons do, have more than {share}: leave them out"


def same_stimuli(inputs: ScoreInputs) -> str:
    """Return the doubt that labels name one stimulus, to which any network responds alike as animals do; or nothing."""
    values, names = inputs.network.model_input, dict[bytes, list[str]]()
    if values is None:
        return ""
    for label, row in zip(inputs.labels, inputs.rows, strict=True):
        # Adding zero turns −0.0 into 0.0.
        names.setdefault((values[row] + 0.0).tobytes(), []).append(label)
    same = listing((" = ".join(labels) for labels in names.values() if len(labels) > 1), limit=3, quoted=False)
    if same == "none":
        return ""
    return f"labels of one stimulus ({same}), which unrelated networks find alike too: join or drop them (--match)"


def influence_of(score: Score, metric: Any, animals: Sequence[Any]) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the effective numbers of units (median over animals) and of animals, and a remark where one decides."""
    numbers, loud, remarks = [], [], []
    for animal in animals:
        # In bins a unit is several features, which nobody tells apart here.
        if animal.problem is not None or animal.patterns.shape[1] != animal.units or animal.units < 2:
            continue
        shares = unit_shares(animal, by_noise=getattr(metric, "noise", "none") != "none")
        if shares.any():
            numbers.append(effective_number(shares))
            if (largest := float(shares.max() / shares.sum())) > DECIDES:
                loud.append((largest, f"{animal.subject}: one of {animal.units} units has {largest:.0%} of the tuning"))
    stated: dict[str, Any] = {"units": float(np.median(numbers)), "units_least": min(numbers)} if numbers else {}
    if loud:
        remarks.append(f"one unit decides in {len(loud)} of {len(animals)} animals ({max(loud)[1]})")
    every = [part for part in score.subjects if part.status != "undefined"]
    scored = [part for part in every if part.status == "ok"] or every
    heights = np.maximum([score.on_scale(part.value) for part in scored], 0.0)
    if np.isfinite(heights).all() and heights.any():
        stated |= {"animals": effective_number(heights), "of_animals": len(scored)}
        first = int(np.argmax(heights))
        if len(scored) > 2 and heights[first] > DECIDES * heights.sum() and score.p <= CHANCE_LEVEL:
            share = heights[first] / heights.sum()
            remarks.append(f"one animal decides: {scored[first].subject} has {share:.0%} of the score")
    return {"effective": stated} if stated else {}, tuple(remarks)
