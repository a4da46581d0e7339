"""The main job: score a temporal network against neural recordings.

``score`` joins the four packages in the order of the data: stimuli → model → representational
dissimilarity matrices (RDMs) of every layer; recordings → RDM and reliability of every animal;
both → a noise-corrected comparison with honest statistics.
"""

from __future__ import annotations

import dataclasses
import os
import time as clock
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from brainbench.core.errors import UsageError
from brainbench.core.files import provenance
from brainbench.core.progress import Progress
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord, Score

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.datasets import Selection, Window
    from brainbench.metrics import Metric
    from brainbench.stimuli import Fidelity

TimeRule = Literal["mean", "concatenate"]


def score(
    model: Any,
    *,
    recordings: str | os.PathLike[str] | xr.Dataset = "demo",
    stimuli: Any = None,
    estimator: str = "default",
    **options: Any,
) -> Score:
    """Score a model against recordings.

    Args:
        model: a registry name (``"zhuang-intersection-ln"``), a ``torch.nn.Module`` mapping
            [B, T, C, H, W] → [B, …], ``"path/to/file.py:make_model"``, a file of activations
            (:mod:`brainbench.models.features`), or a mapping {layer: [K, F] or [K, T, F]} whose rows
            follow the stimuli.
        recordings: ``"demo"``, an NWB or HDF5 file, a folder, a glob, or an opened data set.
        stimuli: a recipe name (default ``"rodgers"``), a scene file, a stimulus-set file or an HDF5
            array file; see :func:`brainbench.stimuli.load_stimuli`.
        estimator: ``"default"``, or ``"thesis"`` / ``"thesis-input"`` for the published ones.
        **options: see :func:`score_record`.

    Returns:
        The score with its statistics.

    Raises:
        UsageError: a name, an option or a shape is wrong; the labels of both sides do not match.
        DataError: a file was found but cannot be used.
    """
    options = {"baselines": False, **options}
    return score_record(model, recordings=recordings, stimuli=stimuli, estimator=estimator, **options).score


def score_record(
    model: Any,
    *,
    recordings: str | os.PathLike[str] | xr.Dataset = "demo",
    stimuli: Any = None,
    estimator: str = "default",
    metric: str | Metric = "rsa",
    conditions: str | None = None,
    match: str | os.PathLike[str] | Mapping[str, str | None] | None = None,
    select: Selection | str | None = None,
    window: Window | str | None = None,
    bin: float | None = None,
    whiskers: str = "all",
    fidelity: Fidelity | str | None = None,
    layers: tuple[str, ...] | None = None,
    normalize: bool = True,
    time: TimeRule = "mean",
    seed: int = 0,
    weights_seed: int | None = None,
    baselines: bool = True,
    explain: bool = False,
    command: str | None = None,
    progress: Progress | None = None,
) -> ResultRecord:
    """Score a model and its baselines, with everything that a leaderboard needs.

    Args:
        model, recordings, stimuli, estimator: as in :func:`score`.
        metric: a name (:func:`brainbench.metrics.list_metrics`), ``"FILE.py:NAME"``, or a
            :class:`brainbench.metrics.Metric`.
        conditions: ``TABLE:COLUMN[,COLUMN]``, the interval table and columns that label the trials.
        match: recording label → stimulus label (None drops the recording label), as a mapping or a
            JSON, TOML or CSV file; without it both sides must have the same labels.
        select, window, bin: see :func:`brainbench.datasets.open_recordings`.
        whiskers: which whiskers a recipe simulates, e.g. ``"C0-C3"``.
        fidelity: preset name or settings of the simulation.
        layers: the layers to compare; all of them by default.
        normalize: give plain modules forces in units of 1e-4 N and moments in units of 1e-6 N·m,
            as our own models do inside; False passes SI values.
        time: how the time axis enters an RDM on both sides: ``"mean"`` averages over it,
            ``"concatenate"`` keeps every step as features.
        seed: seed of untrained weights, of split halves and of random features.
        weights_seed: seed of untrained weights alone, so that twins of other seeds share one brain side;
            ``seed`` by default.
        baselines: also score the raw input, random features and animal against animal.
        explain: also walk from the published estimator to the default one (``estimator_walk`` in the
            statistics of the provenance); RSA only.
        command: the command line that makes this record, kept in its provenance.
        progress: called with (done, total, what).

    Returns:
        The result record; its scores share one brain side.
    """
    from brainbench import metrics
    from brainbench.core.labels import join_labels
    from brainbench.metrics.inference.bootstrap import DRAWS
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.scoring.neural_responses import open_neural_responses

    started = clock.perf_counter()
    if time not in ("mean", "concatenate"):
        raise UsageError(f"Unknown time rule {time!r}; allowed: 'mean', 'concatenate'.")
    _prepare(model, stimuli, recordings, whiskers=whiskers, fidelity=fidelity, progress=progress)
    # Whatever can be wrong with a name or a file is found before the slow part, the simulation.
    chosen = metrics.get_metric(metric)
    if explain and chosen.name != "rsa":
        raise UsageError(f"The published estimator is one of RSA; the metric {chosen.name!r} has none to explain.")
    candidate = resolve_model(model, seed=seed if weights_seed is None else weights_seed)
    brain = open_neural_responses(
        recordings, conditions=conditions, select=select, window=window, bin=bin, progress=progress
    )
    network = candidate.respond(
        stimuli,
        whiskers=whiskers,
        fidelity=fidelity,
        layers=layers,
        normalize=normalize,
        time=time,
        progress=progress,
    )
    pairs = join_labels(brain.vocabulary, network.labels, match)
    kept = tuple(pairs)
    rows = [network.labels.index(label) for label in pairs.values()]
    animals = brain.animals(kept, metric=chosen, time=time, seed=seed, draws=DRAWS)

    def against_brain(name: str, features: Mapping[str, Any]) -> Score:
        return chosen.score(features, animals, name=name, stimuli=kept, estimator=estimator, seed=seed)

    features = network.features(rows)
    scores = [against_brain(network.card.name, features)]
    if explain:
        scores = [_with_walk(scores[0], {layer: metrics.rdm(values) for layer, values in features.items()}, animals)]
    between = None
    if baselines:
        scores += [against_brain(name, found) for name, found in network.baseline_features(rows, seed).items()]
        between = chosen.score_animals(animals, stimuli=kept, estimator=estimator)

    origin = provenance(
        **network.origin,
        recordings=brain.origin,
        pairs=pairs,
        **({"command": command} if command else {}),
        settings={
            "time": time,
            "whiskers": whiskers,
            "fidelity": fidelity or "balanced",
            "normalize": normalize,
            "layers": layers,
            "estimator": estimator,
            "estimator_version": ESTIMATOR_VERSION,
            "metric": chosen.name,
            "seed": seed,
            "weights_seed": seed if weights_seed is None else weights_seed,
            "model": model if isinstance(model, str) else None,
            "stimuli": None if stimuli is None else str(stimuli) if isinstance(stimuli, (str, os.PathLike)) else "data",
            "conditions": conditions,
            "select": select if select is None or isinstance(select, str) else str(select),
            "window": window if window is None or isinstance(window, str) else str(window),
            "bin": bin,
        },
        seconds=round(clock.perf_counter() - started, 2),
    )
    first, *others = (_with_origin(item, origin) for item in scores)
    return ResultRecord(
        score=first,
        animal_to_animal=between and _with_origin(between, origin),
        baselines={item.name: item for item in others},
        card=network.card,
        synthetic=brain.synthetic,
    )


def _prepare(model: Any, stimuli: Any, recordings: Any, *, progress: Progress | None, **options: Any) -> None:
    """Let the simulation get ready beside loading the network, if any will be needed."""
    from brainbench.scoring.model_responses import DEFAULT_STIMULI
    from brainbench.scoring.neural_responses import DEMO_STIMULI
    from brainbench.stimuli.sources import prepare_stimuli

    if isinstance(recordings, str) and recordings == "demo":
        prepare_stimuli(DEMO_STIMULI, progress=progress)
    elif not isinstance(model, Mapping):
        prepare_stimuli(stimuli or DEFAULT_STIMULI, progress=progress, **options)


def _with_origin(item: Score, origin: Mapping[str, Any]) -> Score:
    """Add where a score comes from to what its statistics say."""
    statistics = item.provenance.get("statistics")
    return dataclasses.replace(item, provenance={**origin, **({"statistics": statistics} if statistics else {})})


def _with_walk(item: Score, rdms: Mapping[str, Any], animals: tuple[Any, ...]) -> Score:
    """Add the walk from the published estimator to the default one to a score's statistics."""
    from brainbench.core.files import to_plain
    from brainbench.metrics.explain import explain_score

    walk = [to_plain(step) for step in explain_score(rdms, animals)]
    statistics = {**item.provenance.get("statistics", {}), "estimator_walk": walk}
    return dataclasses.replace(item, provenance={**item.provenance, "statistics": statistics})
