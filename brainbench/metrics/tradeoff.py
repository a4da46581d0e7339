"""Monte-Carlo error of a score against its time: splits and permutations.

Each setting is repeated with other seeds on the same synthetic animals; what varies is the error that
a larger number would take away: far less, at the defaults, than what the number of animals leaves open. The metric is
the default one, ``rsa``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from brainbench.core.progress import Progress, track
from brainbench.core.reading.ranges import check_number
from brainbench.core.trials import Trials
from brainbench.metrics.inference.permutation import label_orders
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import compare
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.rdms.pairs import Floats, permuted_pairs

SPLITS = (10, 30, 100, 300, 1000, 3000)
PERMUTATIONS = (100, 500, 1999, 10_000)
REPEATS = 8

_STIMULI = 12
_NOISE = 3.0
"""Standard deviation of trial noise, beside tuning of variance 4."""


@dataclass(frozen=True)
class MonteCarloPoint:
    """Error and time of one setting."""

    quantity: str
    """``splits`` or ``permutations``."""
    count: int
    error: float
    """Standard deviation over seeds, of what :attr:`of` names."""
    of: str
    seconds: float
    """Median time for all animals."""
    default: bool


def measure_tradeoff(
    *,
    animals: int = 4,
    units: int = 40,
    trials: int = 20,
    splits: Sequence[int] = SPLITS,
    permutations: Sequence[int] = PERMUTATIONS,
    repeats: int = REPEATS,
    progress: Progress | None = None,
) -> tuple[MonteCarloPoint, ...]:
    """Measure Monte-Carlo error and time of each number, the others at their defaults.

    Synthetic animals share one geometry of six stimuli; every setting is repeated with ``repeats`` seeds.
    """
    check_number("repeats of a trade-off", repeats, least=2)
    check_number("numbers of a trade-off", min(*splits, *permutations, animals, units, trials), least=1)
    (blocks, features), metric = _data(animals, units, trials), RSA()

    def value(seed: int, count: int) -> float:
        prepared = [metric.animal(str(i), [block], 6, seed=seed, splits=count) for i, block in enumerate(blocks)]
        return metric.score({"a": features}, prepared, name="x", stimuli=list("abcdef")).value

    # RDMs of more stimuli than are permuted exactly, and the statistic whose p is .05.
    rng = np.random.default_rng(1)
    model, brain = (rdm(rng.normal(size=(_STIMULI, 10))) for _ in range(2))
    threshold = float(np.quantile(_permuted(model, brain, 20_000, 2), 0.95))

    def p(seed: int, count: int) -> float:
        # (b + 1)/(n + 1): the given order counts among the random ones.
        return (1 + int((_permuted(model, brain, count, seed) >= threshold).sum())) / (count + 1)

    jobs: list[tuple[str, int, str, bool, Callable[[int], float]]] = [
        *(("splits", n, "score", n == metric.splits, lambda seed, n=n: value(seed, n)) for n in splits),
        *(("permutations", n, "p near .05", n == metric.orders, lambda seed, n=n: p(seed, n)) for n in permutations),
    ]
    points = []
    for quantity, count, of, default, job in track(jobs, "measuring Monte-Carlo error", progress):
        values, seconds = [], []
        for seed in range(repeats):
            start = time.perf_counter()
            values.append(job(seed))
            seconds.append(time.perf_counter() - start)
        error, middle = float(np.std(values, ddof=1)), float(np.median(seconds))
        points.append(MonteCarloPoint(quantity, count, error, of, middle, default))
    return tuple(points)


def _permuted(model: Floats, brain: Floats, count: int, seed: int) -> Floats:
    """Return comparisons [N] under random orders of the stimuli."""
    _, *chunks = label_orders(_STIMULI, seed, exact=0, draws=count)
    # The given order, yielded first, is left out: what remains are random orders.
    orders = np.concatenate(chunks)
    return compare(model[permuted_pairs(orders)], brain)


def _data(animals: int, units: int, trials: int) -> tuple[list[Trials], Floats]:
    """Return the trials of each animal, and features of a model that is nearly alike."""
    rng = np.random.default_rng(0)
    # Animals read out the same four dimensions of the stimuli by random weights of their own.
    latent = rng.normal(size=(6, 4))
    labels = np.repeat(np.arange(6), trials)
    blocks = []
    for animal in range(animals):
        responses = (latent @ rng.normal(size=(4, units)))[labels] + _NOISE * rng.normal(size=(len(labels), units))
        blocks.append(Trials(responses, labels, [f"{animal}/{trial}" for trial in range(len(labels))]))
    return blocks, (latent + 0.3 * rng.normal(size=latent.shape)) @ rng.normal(size=(4, 500))
