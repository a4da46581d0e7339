"""Stimuli of single trials: each trial meets what was simulated of its own track, and a label their mean.

Stimuli are named by trial: ``ANIMAL_SESSION_TRIAL``, ``SESSION_TRIAL`` or ``TRIAL``, whichever tells the trials apart;
TRIAL is the id of the row in its table. A network answers to the stimulus of each trial. Its features of a label are
the mean over the trials of all animals that are used.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.contracts import BY_TRIAL
from brainbench.core.errors import DataError, listing
from brainbench.scoring.model_responses import LayerFeatures, reduce_time
from brainbench.scoring.neural_responses import NeuralResponses

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.scoring.model_responses import ModelResponses
    from brainbench.scoring.options import ScoreOptions

WITHOUT = "no stimulus of their own"
MISSED = 0.05
"""Share of the trials from which trials without a stimulus, beside stimuli without a trial, put the names in doubt."""
SHARED = 0.9
"""Share of the variance between labels that animals have in common below which their mean stands for none of them: at
.9 a perfect model loses 2 to 7 % of its score, at .8 up to 14 % (8 to 40 labels, 2 to 10 animals)."""

LEVEL = 0.01
"""Level at which labels differ within animals."""


def mean_rows(values: NDArray[np.floating], members: list[list[int]]) -> NDArray[np.floating]:
    """Return the mean [K, …] of the rows of values [S, …] that belong together."""
    means = np.stack([np.mean(values[rows], axis=0, dtype=np.float64) for rows in members])
    return means.astype(np.result_type(values.dtype, np.float32))


def shared_variance(values: NDArray[np.floating], animals: Sequence[str], labels: Sequence[str]) -> float:
    """Return the share of the variance between labels in values [S, F] that animals have in common.

    Sums of squares of the mean of each label in each animal, with labels that all animals have, estimate the variance
    of labels and that of labels within animals (analysis of variance of two factors, trials being the error). What is
    an animal's under all labels changes no distance. 1 where labels differ within animals no more than trials make them
    (F test), NaN where that is unknown.
    """
    from scipy.stats import f

    cells: dict[tuple[str, str], list[int]] = {}
    for row in np.flatnonzero(np.isfinite(values).all(axis=1)).tolist():
        cells.setdefault((animals[row], labels[row]), []).append(row)
    names, kinds = sorted({*animals}), sorted({*labels})
    kinds = [kind for kind in kinds if all((name, kind) in cells for name in names)]
    parts = [[values[cells[name, kind]] for kind in kinds] for name in names]
    numbers = np.array([[len(part) for part in row] for row in parts])
    if len(names) < 2 or len(kinds) < 2 or not (free := int((numbers - 1).sum())):
        return math.nan
    means = np.array([[part.mean(axis=0) for part in row] for row in parts])
    error = sum(float(part.var(axis=0).sum()) * len(part) for row in parts for part in row) / free
    error *= float((1 / numbers).mean())
    means -= means.mean(axis=1, keepdims=True)
    common = means.mean(axis=0)
    between = float((common**2).sum()) / (len(kinds) - 1) * len(names)
    within = float(((means - common) ** 2).sum()) / ((len(kinds) - 1) * (len(names) - 1))
    single, every = max(within - error, 0.0), max((between - within) / len(names), 0.0)
    differ = f.sf(within / error, (len(kinds) - 1) * (len(names) - 1), free) < LEVEL if error > 0 else within > 0
    return every / (every + single) if differ else 1.0


def joined(
    brain: NeuralResponses, network: ModelResponses, options: ScoreOptions
) -> tuple[NeuralResponses, ModelResponses, dict[str, str]]:
    """Return recordings and responses that fit together, and recording labels with those of their stimuli.

    By trial, recordings keep the trials that have a stimulus of their own, and a label has the mean of its trials'
    responses. Other trials stand in the ledger and in the doubts of every score; ``strict`` refuses them. Where names
    may be those of other trials, or animals met other stimuli under a label, scores are ``unreliable``.
    """
    if options.match != BY_TRIAL:
        return brain, network, brain.pairs(network.labels, options.match)
    rows, data = brain.stimulus_rows(network.labels), brain.dataset
    doubts, wrong = list(data.attrs.get("doubts", ())), [brain.label_doubt]
    keep = rows >= 0
    animals, sessions, ids, kinds = (
        data[name].values.astype(str) for name in ("subject", "session", "trial_id", "stimulus")
    )
    without = [f"{sessions[row]}_{ids[row]}" for row in np.flatnonzero(~keep)]
    if lost := len(without):
        doubts.append(f"{lost} of {len(rows)} trials have {WITHOUT} and are left out: {listing(without)}")
        if options.strict:
            raise DataError(doubts[-1] + ".")
    if unused := [label for row, label in enumerate(network.labels) if row not in rows]:
        doubts.append(f"{len(unused)} of {len(network.labels)} stimuli belong to no trial: {listing(unused)}")
    if min(lost, len(unused)) > MISSED * len(rows):
        wrong.append(f"{lost} trials have no stimulus and {len(unused)} stimuli no trial: names may be of other trials")
    for step, where in ((1, "after"), (-1, "before")):
        if (moved := int((brain.stimulus_rows(network.labels, step=step) >= 0).sum())) > len(rows) - lost:
            wrong.append(
                f"{moved} trials have a stimulus of the number {where} theirs, {len(rows) - lost} of their own"
            )
    ledger = {kind: dict(numbers) for kind, numbers in data.attrs.get("ledger", {}).items()}
    if lost and "trials" in ledger:
        trials = ledger["trials"]
        entry = {"reason": WITHOUT, "number": lost, "lost": True}
        ledger["trials"] = {**trials, "read": trials["read"] - lost, "left_out": [*trials["left_out"], entry]}
    used = keep & brain.of_units
    pairs = brain.pairs(network.labels, BY_TRIAL)
    labels = tuple(pairs)
    members = [rows[used & (kinds == label)].tolist() for label in labels]
    inputs = [values for values in (network.model_input, *network.activations.values()) if values is not None]
    of_trials = (reduce_time(values, network.time)[rows[used]] for values in inputs)
    shares = (shared_variance(values, animals[used].tolist(), kinds[used].tolist()) for values in of_trials)
    # A layer whose mean stands for no animal would leave the score to others, which may know less.
    if not any(wrong) and (smallest := min(filter(math.isfinite, shares), default=1.0)) < SHARED:
        wrong.append(
            f"animals met other stimuli under one label: {smallest:.0%} of the variance between labels is common to"
            " them; score each by itself (--select subjects=NAME)"
        )
    stated = {"doubts": doubts, "label_doubt": "; ".join(filter(None, wrong))} | ({"ledger": ledger} if ledger else {})
    means = replace(
        network,
        labels=labels,
        activations=LayerFeatures(network.activations, lambda values: mean_rows(values, members)),
        model_input=None if network.model_input is None else mean_rows(network.model_input, members),
        kinematics={name: mean_rows(values, members) for name, values in network.kinematics.items()},
    )
    chosen = replace(brain, dataset=data.isel(trial=keep).assign_attrs(stated))
    return chosen, means, pairs
