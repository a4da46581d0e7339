"""Monte-Carlo error of a score against its time: splits and permutations.

Each setting is repeated with other seeds on the same synthetic animals; what varies is the error that
a larger number would take away: far less, at the defaults, than what the number of animals leaves open. The metric is
the default one, ``rsa``.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from brainbench.core.contracts import Trials
from brainbench.core.limits import Count, Limit, limited
from brainbench.metrics.arrays import Floats
from brainbench.metrics.inference.permutation import label_orders
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import compare, permuted_pairs
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.tradeoffs.study import Row, Study

SPLITS = (10, 30, 100, 300, 1000, 3000)
PERMUTATIONS = (100, 500, 1999, 10_000)
_STIMULI = 12
_NOISE = 3.0  # standard deviation of trial noise, beside tuning of variance 4


@dataclass(frozen=True)
@limited(of="{} of a trade-off")
class SyntheticData:
    """Synthetic animals that share one geometry of six stimuli, and how often each setting is repeated."""

    animals: Count = 4
    """Synthetic animals."""
    units: Count = 40
    """Units of each."""
    trials: Count = 20
    """Trials of each stimulus."""
    repeats: Annotated[int, Limit(least=2)] = 8
    """Seeds per setting; their spread is the error."""


def study(data: SyntheticData, splits: Sequence[int] = SPLITS, permutations: Sequence[int] = PERMUTATIONS) -> Study:
    """Return the study of each number, the others at their defaults.

    A row has ``quantity`` (``splits`` or ``permutations``), ``count``, whether it is the ``default``, the ``error``
    (standard deviation over seeds ``of`` the score or the p value) and the median ``seconds`` for all animals.
    """
    metric = RSA()
    (blocks, features), random = _data(data), np.random.default_rng(1)
    # RDMs of a model and a brain, of more stimuli than are permuted exactly, and the comparison whose p is .05.
    model, brain = (rdm(random.normal(size=(_STIMULI, 10))) for _ in range(2))
    threshold = np.quantile(_permuted(model, brain, 20_000, 2), 0.95)

    def value(seed: int, count: int) -> float:
        prepared = [metric.animal(str(i), [block], 6, seed=seed, splits=count) for i, block in enumerate(blocks)]
        return metric.score({"a": features}, prepared, name="x", stimuli=list("abcdef")).value

    def p(seed: int, count: int) -> float:
        # (b + 1)/(n + 1): the given order counts among the random ones.
        return (1 + int((_permuted(model, brain, count, seed) >= threshold).sum())) / (count + 1)

    jobs = {"splits": (value, "score", metric.splits), "permutations": (p, "p near .05", metric.orders)}

    def measure(row: Mapping[str, Any]) -> Row:
        job, of, default = jobs[row["quantity"]]
        values, seconds = [], []
        for seed in range(data.repeats):
            start = time.perf_counter()
            values.append(job(seed, row["count"]))
            seconds.append(time.perf_counter() - start)
        error, middle = float(np.std(values, ddof=1)), float(np.median(seconds))
        return {"error": error, "of": of, "seconds": middle, "default": row["count"] == default}

    rows = [{"quantity": "splits", "count": count} for count in splits]
    rows += [{"quantity": "permutations", "count": count} for count in permutations]
    return Study("brainbench tradeoff score", rows, measure)


def _permuted(model: Floats, brain: Floats, count: int, seed: int) -> Floats:
    """Return comparisons [N] under random orders of the stimuli."""
    _, *chunks = label_orders(_STIMULI, seed, exact=0, draws=count)
    # The given order, yielded first, is left out: what remains are random orders.
    orders = np.concatenate(chunks)
    return compare(model[permuted_pairs(orders)], brain)


def _data(data: SyntheticData) -> tuple[list[Trials], Floats]:
    """Return the trials of each animal, and features of a model that is nearly alike."""
    rng = np.random.default_rng(0)
    # Animals read out the same four dimensions of the stimuli by random weights of their own.
    latent = rng.normal(size=(6, 4))
    labels = np.repeat(np.arange(6), data.trials)
    blocks = []
    for animal in range(data.animals):
        responses = (latent @ rng.normal(size=(4, data.units)))[labels] + _NOISE * rng.normal(
            size=(len(labels), data.units)
        )
        blocks.append(Trials(responses, labels, [f"{animal}/{trial}" for trial in range(len(labels))]))
    return blocks, (latent + 0.3 * rng.normal(size=latent.shape)) @ rng.normal(size=(4, 500))
