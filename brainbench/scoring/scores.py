"""The main job: score a temporal network against neural recordings.

``score`` joins the four packages in the order of the data: stimuli → model → representational
dissimilarity matrices (RDMs) of every layer; recordings → RDM and reliability of every animal;
both → a noise-corrected comparison with honest statistics.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import UsageError, check_name
from brainbench.core.files import provenance, to_plain
from brainbench.core.progress import Progress, stages
from brainbench.core.provenance import Provenance
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord, Score
from brainbench.scoring.options import ScoreOptions

if TYPE_CHECKING:
    from brainbench.metrics import Metric
    from brainbench.scoring.model_responses import ResolvedModel
    from brainbench.scoring.neural_responses import NeuralResponses

STAGES = 5
"""Stages of a score that progress is told of: model, recordings, its responses, the animals' RDMs, comparisons."""


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

    Returns:
        The score with its statistics.
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
        baselines: also score the raw input, random features and animal against animal.
        command: the command line that makes this record, kept in its provenance.
        progress: called with (done, total, what).

    Returns:
        The result record; its scores share one brain side.
    """
    from brainbench import metrics
    from brainbench.metrics.measures.rsa import RSA
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.scoring.neural_responses import open_neural_responses

    started = clock.perf_counter()
    stage_done = stages(STAGES, "scoring", progress)
    options = _options(model, {**vars(options or ScoreOptions()), **changes})
    _prepare(model, options, progress)
    # Whatever can be wrong with a name or a file is found before the slow part, the simulation.
    metric = metric_of(options)
    options = replace(options, metric=metric)
    resolved = resolve_model(model, seed=options.model_seed)
    stage_done()
    brain = open_neural_responses(options.recordings, progress=progress, **options.selection)
    brain = replace(brain, title=options.title, covariates=metric.of_covariates)
    stage_done()
    # Recordings name the stimuli that the animals felt; the caller's choice goes first.
    options = replace(options, stimuli=brain.stimuli if options.stimuli is None else options.stimuli)
    _check_inputs(resolved, brain, options)
    network = resolved.respond(options, progress=progress)
    stage_done()
    pairs = brain.pairs(network.labels, options.match)
    kept = tuple(pairs)
    rows = [network.labels.index(label) for label in pairs.values()]
    animals = brain.animals(kept, metric, options)
    stage_done()

    features = network.features(rows)
    named = {network.card.name: features, **(network.baseline_features(rows, options.seed) if baselines else {})}
    layer = network.card.layer
    scores, between = _compare(named, brain, animals, metric, kept, options, layer=layer, agreement=baselines)
    stage_done()
    settings = {"estimator_version": ESTIMATOR_VERSION, "model": model if isinstance(model, str) else None}
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
        )
    )
    statistics = [item.provenance.statistics for item in scores]
    if options.explain:
        from brainbench.metrics.explain import explain_score

        rdms = {layer: metrics.rdm(values) for layer, values in features.items()}
        statistics[0] = {**statistics[0], "estimator_walk": to_plain(explain_score(rdms, animals))}
    if options.over_time and isinstance(metric, RSA):
        from brainbench.scoring.over_time.course import time_course

        course = time_course(brain, network, metric, kept, rows, options, progress=progress)
        statistics[0] = {**statistics[0], "time_course": to_plain(course)}
    first, *others = (
        replace(item, provenance=replace(origin, statistics=found))
        for item, found in zip(scores, statistics, strict=True)
    )
    # The animals' RDM stands in the record once.
    others = [replace(item, brain_rdm=()) for item in others]
    if between is not None:
        between = replace(between, brain_rdm=(), provenance=replace(origin, statistics=between.provenance.statistics))
    return ResultRecord(first, between, {item.name: item for item in others}, network.card, brain.synthetic)


def _options(model: Any, values: Mapping[str, Any]) -> ScoreOptions:
    """Return the options that values state; a seed or a fidelity that would reach nothing is refused."""
    from brainbench.scoring.model_responses import follows_seed
    from brainbench.stimuli.sources import is_finished

    options = ScoreOptions.of(values)
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

    if brain.published and options.estimator != "default" and options.units_reliability is not None:
        raise UsageError(f"The estimator {options.estimator!r} takes all published units; leave out units_reliability.")
    if resolved.activations is not None and (options.whiskers != "all" or options.fidelity not in (None, "balanced")):
        raise UsageError("whiskers and fidelity are of a simulation, and these features were computed elsewhere.")
    source = DEFAULT_STIMULI if options.stimuli is None else options.stimuli
    if resolved.labels is not None or (shown := known_labels(source)) is None:
        return
    try:
        brain.pairs(shown, options.match)
    except UsageError as error:
        if options.stimuli is not None:
            raise
        raise UsageError(
            f"{error} The recordings do not name their stimuli, so the recipe {source!r} was taken; --stimuli names "
            "another."
        ) from error


def _compare(
    named: Mapping[str, Mapping[str, Any]],
    brain: NeuralResponses,
    animals: tuple[Any, ...],
    metric: Metric,
    kept: tuple[str, ...],
    options: ScoreOptions,
    *,
    layer: str | None,
    agreement: bool,
) -> tuple[list[Score], Score | None]:
    """Score the features of the model (the first) and of baselines, and the animals against one another if asked.

    The published estimators take a published file as its authors' code does: zeros kept, the maximum over all layers.
    """
    how: dict[str, Any] = {"stimuli": kept, "estimator": options.estimator}
    arrays = None if options.estimator == "default" else brain.zero_filled(kept)
    if arrays is None:
        how |= {"seed": options.seed}
        chosen = {next(iter(named)): layer}
        scores = [metric.score(one, animals, name=name, layer=chosen.get(name), **how) for name, one in named.items()]
        between = metric.score_animals(animals, **how) if agreement else None
    else:
        from brainbench.metrics.published import make_targets, score_published, score_published_animals

        targets = make_targets(arrays)
        if options.layer is not None:
            model = next(iter(named))
            named = {**named, model: {options.layer: named[model][options.layer]}}
        scores = [score_published(features, targets, name=name, **how) for name, features in named.items()]
        between = score_published_animals(arrays, stimuli=kept) if agreement else None
    if brain.label_doubt:
        scores = [_doubted(item, brain.label_doubt) for item in scores]
        between = between and _doubted(between, brain.label_doubt)
    if brain.dependent:
        told = "many trials share spikes with another one of their stimulus, which makes noise look reliable"
        scores, between = [_doubted(item, told) for item in scores], between and _doubted(between, told)
    scores = [replace(item, reasons=(*item.reasons, *brain.doubts)) for item in scores]
    return scores, between and replace(between, reasons=(*between.reasons, *brain.doubts))


def _doubted(score: Score, doubt: str) -> Score:
    """Return a score that is never ``ok``, with the doubt as its first reason."""
    status = "unreliable" if score.status == "ok" else score.status
    return replace(score, status=status, reasons=(doubt, *score.reasons))


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
        known = [name for name in list_metrics() if isinstance(get_metric(name), RSA)]
        raise UsageError(f"Scores over time compare RDMs; the metric {metric.name!r} has none; choose from {known}.")
    return metric
