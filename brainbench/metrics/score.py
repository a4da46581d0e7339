"""From RDMs of a model's layers and of animals to a :class:`brainbench.core.records.Score`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.files import to_plain
from brainbench.core.provenance import Provenance
from brainbench.core.records import LayerScore, Score, Status, SubjectScore
from brainbench.metrics.animals import (
    Animals,
    ceiling_of,
    gather,
    mean_rdm,
    mean_reliability,
)
from brainbench.metrics.inference.bootstrap import bootstrap_animals
from brainbench.metrics.inference.intervals import interval_reasons, t_interval
from brainbench.metrics.inference.permutation import (
    SMALLEST_STIMULI,
    PermutationTest,
    layer_p,
    permuted_statistic,
    smallest_p,
)
from brainbench.metrics.layers import choose_on_halves, choose_on_others, first_best, held_out, most_chosen
from brainbench.metrics.rdms.comparison import check_comparison, compare_all
from brainbench.metrics.rdms.pairs import Floats, rdm_stack
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat

_HALVES_IN_PERMUTATIONS = 100
"""Splits of a single animal that every permutation repeats; more only cost time."""


@dataclass(frozen=True)
class _Choice:
    """The layer that each scored animal was compared with, and the result."""

    r: Floats
    """[A] raw comparisons."""
    values: Floats
    """[A] corrected."""
    layers: tuple[int, ...]
    """[A] indices among the defined layers; one animal's halves may have chosen several: the commonest."""
    overall: int
    rule: str
    test: PermutationTest
    layer_null: tuple[Floats, ...]
    """Mean of every layer [n, L] under the orders of the stimuli, in parts; empty without a test."""


def score_rdms(
    layer_rdms: Mapping[str, ArrayLike],
    subjects: Sequence[SubjectRDM],
    *,
    name: str,
    stimuli: Sequence[str],
    estimator: str = "default",
    compare: str = "pearson",
    seed: int = 0,
    device: Any = None,
) -> Score:
    """Score a model by the RDMs of its layers against animals.

    ``default``: each reliable animal is compared with the layer that compares best with the *other*
    reliable animals, the comparison is corrected for the animal's noise, and the score is the mean over
    animals. The permutation p-value repeats the choice of layer in every permutation. A single animal
    chooses on one half of its trials and is scored on the other. ``thesis`` and ``thesis-input`` are
    the published estimators with their maximum over layers, which is optimistic and says so.

    Args:
        layer_rdms: RDM [P] of each layer, in network order.
        subjects: From :func:`subject_rdm`, for the same stimuli in the same order.
        name: Name of the model.
        stimuli: Names of the K stimuli, in the order of the RDMs.
        estimator: See :func:`noise_corrected`.
        compare: Comparison of RDMs, see :func:`brainbench.metrics.compare`.
        seed: Seed of random permutations (more than 8 stimuli).
        device: Torch device for the permutations, which pays from some hundred stimuli on; numpy by default.

    Raises:
        UsageError: no layers or animals, RDMs that do not fit the stimuli, unknown estimator or comparison.
    """
    return score_with_test(layer_rdms, subjects, name, stimuli, estimator, compare, seed, device)[0]


def score_with_test(
    layer_rdms: Mapping[str, ArrayLike],
    subjects: Sequence[SubjectRDM],
    name: str,
    stimuli: Sequence[str],
    estimator: str,
    compare: str,
    seed: int,
    device: Any,
) -> tuple[Score, PermutationTest | None]:
    """Return what :func:`score_rdms` does, and its permutation test with all statistics."""
    check_comparison(compare)
    names, rdms = _layers(layer_rdms, stimuli)
    animals = gather(subjects, estimator=estimator, comparison=compare, pairs=rdms.shape[1])
    defined = np.flatnonzero(~is_flat(rdms)).tolist()
    choice = None
    if animals.scored and defined and len(stimuli) > 2:
        choice = _choose(rdms[defined], animals, estimator, compare, {"seed": seed, "device": device})
    status, reasons = _verdict(animals, names, defined, len(stimuli), estimator, choice)
    reliability, reliability_interval = mean_reliability(animals)
    layers = _layer_scores(names, rdms, defined, animals, compare)
    finite = [index for index in defined if math.isfinite(layers[index].value)]
    best = finite[first_best(np.array([layers[index].value for index in finite]))] if finite else None
    measured: dict[str, Any] = {"value": math.nan}
    statistics: dict[str, Any] = {}
    if choice is not None:
        chosen, usable = defined[choice.overall], [names[index] for index in defined]
        repeated = f"{'layer chosen' if estimator == 'default' else 'maximum over layers taken'} anew in each"
        measured = {
            "value": float(choice.values.mean()),
            "r": float(choice.r.mean()),
            "interval": t_interval(choice.values),
            "p": choice.test.p,
            "p_method": choice.test.summary(len(defined), repeated),
            "layer": names[chosen],
            "layer_rule": choice.rule,
            "model_rdm": tuple(rdms[chosen].tolist()),
        }
        statistics = _statistics(usable, rdms[defined], animals, choice, estimator, compare, seed)
    score = Score(
        name=name,
        status=status,
        reasons=reasons,
        reliability=reliability,
        reliability_interval=reliability_interval,
        p_smallest=smallest_p(len(stimuli)),
        ceiling=ceiling_of(animals, compare),
        best_layer=None if best is None else names[best],
        best_layer_value=math.nan if best is None else layers[best].value,
        layers=layers,
        subjects=_subject_scores(names, rdms, defined, animals, choice, compare),
        estimator=estimator,
        metric=metric_name(animals, compare),
        stimuli=tuple(map(str, stimuli)),
        brain_rdm=mean_rdm(animals),
        provenance=Provenance.of(
            {
                "statistics": statistics,
                "seed": seed,
                "splits": max(len(subject.split_half_r) for subject in animals.subjects),
                "reliability_gate": RELIABILITY_GATE,
            }
        ),
        **measured,
    )
    return score, None if choice is None else choice.test


def _statistics(
    names: list[str], rdms: Floats, animals: Animals, choice: _Choice, estimator: str, comparison: str, seed: int
) -> dict[str, Any]:
    """Return Monte-Carlo errors, every layer's p, and the hierarchical bootstrap where the animals hold draws."""
    scored = [animals.subjects[index] for index in animals.scored]
    found: dict[str, Any] = {
        "monte_carlo_error": {
            "value": splits_error(choice.values, [subject.split_half_by(comparison) for subject in scored]),
            "p": choice.test.monte_carlo_error,
        }
    }
    if choice.layer_null:
        found["layer_tests"] = layer_table(names, np.concatenate(choice.layer_null))
    held = min(len(subject.draws) for subject in scored)
    if estimator == "default" and held and all(subject.comparison == comparison for subject in scored):
        # The draws of sessions and trials were made with the animals' RDMs and are shared by all models.
        boot = bootstrap_animals(rdms, animals, comparison, draws=held, levels="all", seed=seed)
        found["bootstrap"] = {
            "levels": boot.levels,
            "draws": held,
            "undefined_draws": boot.undefined,
            "standard_error": boot.standard_error,
            "interval": to_plain(boot.interval("percentile")),
        }
        found["monte_carlo_error"]["bootstrap_interval"] = boot.monte_carlo_error("percentile")
    return found


def layer_table(names: Sequence[str], null: Floats) -> list[dict[str, Any]]:
    """Return each layer's p, alone and corrected for the number of layers, from statistics [N, L]."""
    return [
        {"layer": name, "p": p, "p_corrected": corrected}
        for name, p, corrected in zip(names, *(values.tolist() for values in layer_p(null)), strict=True)
    ]


def splits_error(values: Floats, split_half_r: Sequence[Floats]) -> float:
    """Return the standard error of the mean score over animals from the finite number of random splits.

    Splits are independent draws given the trials, so the mean split-half correlation h has standard
    error s/√S, and value ∝ √((1 + h)/2h) turns it into value · se / (2h(1 + h)).
    """
    # Errors of the score by the random splits alone: the trials are held fixed.
    errors = []
    for value, r in zip(values, split_half_r, strict=True):
        finite = r[np.isfinite(r)]
        h = float(finite.mean()) if finite.size else math.nan
        spread = float(finite.std(ddof=1)) / math.sqrt(finite.size) if finite.size > 1 else math.nan
        # Delta method: the derivative of ln √((1 + h)/2h) is −1/(2h(1 + h)).
        errors.append(float(value) * spread / (2 * h * (1 + h)))
    # Splits of different animals are independent, so squared errors add up in the mean over animals.
    return math.sqrt(sum(error**2 for error in errors)) / len(errors)


def metric_name(animals: Animals, comparison: str) -> str:
    """Name the metric in words."""
    methods = sorted({subject.method for subject in animals.subjects})
    return f"RSA: {'/'.join(methods)} RDM, {comparison} comparison"


def _layers(layer_rdms: Mapping[str, ArrayLike], stimuli: Sequence[str]) -> tuple[tuple[str, ...], Floats]:
    if not layer_rdms:
        raise UsageError("There are no layers to score; give the RDM of at least one layer.")
    if len(set(map(str, stimuli))) < len(stimuli):
        raise UsageError(f"Stimulus names repeat: {list(stimuli)}.")
    rdms = [rdm_stack(rdm, f"The RDM of layer {layer!r}") for layer, rdm in layer_rdms.items()]
    pairs = len(stimuli) * (len(stimuli) - 1) // 2
    for layer, rdm in zip(layer_rdms, rdms, strict=True):
        if rdm.shape != (pairs,):
            raise UsageError(
                f"The RDM of layer {layer!r} has shape {rdm.shape}; {len(stimuli)} stimuli have {pairs} pairs."
            )
    return tuple(map(str, layer_rdms)), np.stack(rdms)


def _choose(
    rdms: Floats, animals: Animals, estimator: str, comparison: str, test_options: dict[str, Any]
) -> _Choice | None:
    """Choose layers by the estimator's rule, with a test that repeats the choice."""
    if len(animals.scored) == 1 and len(rdms) > 1 and estimator == "default":
        return _choose_on_halves(rdms, animals.subjects[animals.scored[0]], comparison, test_options)
    # An animal's factor does not change when labels are permuted, so permutations repeat r alone.
    brain, factors = animals.rdms(animals.scored), animals.factors(animals.scored)
    r = compare_all(rdms, brain, method=comparison)
    if len(rdms) == 1:
        chosen = np.zeros(len(brain), dtype=np.int64)
        rule = "only layer"
    elif estimator == "default":
        chosen = choose_on_others(r)
        rule = "chosen on the other animals, evaluated on the animal held out"
    else:
        # The published rule; the test takes the same maximum, so its p stays honest where the value is not.
        chosen = np.full(len(brain), first_best((r * factors).mean(axis=1)))
        rule = "maximum over layers on the data that are scored (as published; optimistic)"
    means: list[Floats] = []

    def statistic(x: Floats) -> Floats:
        """Return the score [N] of comparisons [N, L, A], and keep every layer's mean on the way."""
        # Layers are tested from the same permutations as the score, so their means are kept on the way.
        means.append((x * factors).mean(axis=-1))
        if estimator != "default":
            return means[-1].max(axis=-1)
        return (x[:, 0] if len(rdms) == 1 else held_out(x)) @ factors / len(brain)

    test = permuted_statistic(rdms, brain, statistic, method=comparison, **test_options)
    picked = r[chosen, np.arange(len(brain))]
    return _Choice(picked, picked * factors, tuple(chosen.tolist()), most_chosen(chosen), rule, test, tuple(means))


def _choose_on_halves(
    rdms: Floats, subject: SubjectRDM, comparison: str, test_options: dict[str, Any]
) -> _Choice | None:
    # A half in which a stimulus met silent units has no RDM; such splits say nothing.
    halves = subject.halves[~is_flat(subject.halves).any(axis=1)]
    splits = len(halves)
    if not splits:
        return None
    r = compare_all(rdms, halves.reshape(2 * splits, -1), method=comparison).reshape(len(rdms), splits, 2)
    chosen, held = choose_on_halves(r[..., 0], r[..., 1])
    # What is evaluated is the RDM of one half, whose reliability is the raw split-half correlation.
    agreement = subject.split_half_by(comparison)
    factor = 1 / math.sqrt(float(agreement[np.isfinite(agreement)].mean()))
    some = halves[:_HALVES_IN_PERMUTATIONS]
    means: list[Floats] = []

    def statistic(x: Floats) -> Floats:
        means.append(x.mean(axis=-1) * factor)
        pair = x.reshape(*x.shape[:-1], len(some), 2)
        return choose_on_halves(pair[..., 0], pair[..., 1])[1].mean(axis=-1) * factor

    test = permuted_statistic(rdms, some.reshape(2 * len(some), -1), statistic, method=comparison, **test_options)
    rule = "chosen on one half of the only reliable animal's trials, evaluated on the other half"
    mean, layer = float(held.mean()), most_chosen(chosen)
    return _Choice(np.array([mean]), np.array([mean * factor]), (layer,), layer, rule, test, tuple(means))


def _verdict(
    animals: Animals,
    names: tuple[str, ...],
    defined: list[int],
    stimuli: int,
    estimator: str,
    choice: _Choice | None,
) -> tuple[Status, tuple[str, ...]]:
    """Return the status of the score and its reasons, the gravest first."""
    if choice is None:
        if stimuli < 3:
            reason = f"{stimuli} stimuli have one pair, and RDMs of one pair cannot be compared; at least 3 are needed"
        elif not defined:
            reason = "activations of every layer are constant or NaN"
        elif not animals.scored:
            reason = "no animal has a usable RDM"
        else:
            reason = "halves of the only reliable animal's trials have no RDM, so no layer can be chosen"
        return "undefined", (reason, *animals.reasons)
    reasons = list(choice.test.reason and [choice.test.reason])
    if not animals.reliable:
        reasons.append(
            "no animal's RDM is reliable" if estimator == "default" else "the published estimator has no gate"
        )
    reasons += animals.reasons
    if estimator != "default" and len(defined) > 1:
        reasons.append("optimistic: the layer was chosen as the maximum on the data that are scored (as published)")
    broken = [names[index] for index in range(len(names)) if index not in defined]
    if broken:
        reasons.append(f"layers without a usable RDM (constant or NaN activations), never chosen: {', '.join(broken)}")
    reasons += interval_reasons(len(animals.scored))
    unreliable = not animals.reliable or stimuli < SMALLEST_STIMULI
    return "unreliable" if unreliable else "ok", tuple(reasons)


def _layer_scores(
    names: tuple[str, ...], rdms: Floats, defined: list[int], animals: Animals, comparison: str
) -> tuple[LayerScore, ...]:
    found: dict[int, LayerScore] = {}
    if animals.scored and defined and rdms.shape[1] > 1:
        r = compare_all(rdms[defined], animals.rdms(animals.scored), method=comparison)
        status: Status = "ok" if animals.reliable else "unreliable"
        for index, raw, value in zip(defined, r, r * animals.factors(animals.scored), strict=True):
            found[index] = LayerScore(names[index], float(value.mean()), float(raw.mean()), status, t_interval(value))
    return tuple(found.get(i) or LayerScore(name, math.nan, math.nan, "undefined") for i, name in enumerate(names))


def _subject_scores(
    names: tuple[str, ...],
    rdms: Floats,
    defined: list[int],
    animals: Animals,
    choice: _Choice | None,
    comparison: str,
) -> tuple[SubjectScore, ...]:
    scores = []
    for index, subject in enumerate(animals.subjects):
        value = r = math.nan
        layer = None
        status: Status = "undefined"
        if choice is not None and index in animals.scored:
            row = animals.scored.index(index)
            value, r, layer = float(choice.values[row]), float(choice.r[row]), choice.layers[row]
            status = animals.status(index)
        elif choice is not None and index in animals.usable:
            # An animal that did not vote is held out from the choice of all who did.
            layer, status = choice.overall, animals.status(index)
            r = float(compare_all(rdms[[defined[layer]]], subject.rdm[None], method=comparison)[0, 0])
            value = r * animals.corrections[index].value
        scores.append(
            SubjectScore(
                subject=subject.subject,
                value=value,
                r=r,
                reliability=animals.corrections[index].reliability,
                status=status,
                units=subject.units,
                trials=subject.trials,
                layer=None if layer is None else names[defined[layer]],
            )
        )
    return tuple(scores)
