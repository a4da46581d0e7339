"""Permutation tests: could labels in another order have compared as well?

The stimulus labels of the model are permuted, which permutes rows and columns of its RDM together.
Up to eight stimuli all K! orders are taken (the p-value is exact), above that 10,000 random ones.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError, check_number
from brainbench.core.records import Status
from brainbench.metrics.arrays import Floats, Ints, find_device
from brainbench.metrics.rdms import comparison

EXACT_STIMULI = 8  # up to this many stimuli all orders are taken (8! = 40,320)

RANDOM_PERMUTATIONS = 10_000

SMALLEST_STIMULI = 4  # below this no p is given: 3 stimuli have 6 orders, so p could never fall below 1/6

TIE = 1e-12  # statistics closer than this are equal: permutations that map an RDM onto itself differ by rounding

_CHUNK_ELEMENTS = 1 << 22


@dataclass(frozen=True)
class PermutationTest:
    """Result of a one-sided permutation test."""

    p: float
    """P(statistic ≥ observed) under permuted labels; NaN when undefined."""
    smallest: float
    """Smallest p that this test could give."""
    exact: bool
    """True when all orders were taken."""
    count: int
    """Orders that were taken, the given one included."""
    observed: float
    null: Floats
    """[count] statistics, first the observed one."""
    reason: str = ""
    """Reason for an undefined p; empty otherwise."""

    @property
    def status(self) -> Status:
        """``undefined`` without a p (the reason says why), else ``ok``."""
        return "undefined" if math.isnan(self.p) else "ok"

    @property
    def monte_carlo_error(self) -> float:
        """Standard error of p from the number of random orders; 0 when all orders were taken."""
        return 0.0 if self.exact else math.sqrt(self.p * (1 - self.p) / self.count)

    @property
    def method(self) -> str:
        """The test in words."""
        how = f"all {self.count:,} orders" if self.exact else f"{self.count - 1:,} random orders, (b+1)/(n+1)"
        return f"one-sided permutation of stimulus labels, {how}"

    def summary(self, layers: int, repeated: str = "layer chosen anew in each") -> str:
        """Describe the test of a score, with the score that a model without knowledge gets by the same choice."""
        text = f"{self.method}; {'one layer' if layers == 1 else repeated}"
        finite = self.null[np.isfinite(self.null)]
        if not finite.size:
            return text
        # Adding zero keeps a rounded −0.00 out of the sentence.
        return f"{text}; mean score under permutation {round(float(finite.mean()), 2) + 0.0:.2f}"


def tail_p(null: Floats, observed: ArrayLike | None = None) -> Floats:
    """Return P(statistic ≥ observed) over null statistics [N, ...]; the first of them is the observed one.

    The given order of labels counts among the random ones, which is (b+1)/(n+1). An order without a statistic, NaN or
    −∞, counts for nothing.
    """
    # Ties within a relative tolerance count as reached, so that rounding cannot make p smaller.
    reached = null[0] if observed is None else np.asarray(observed)
    above = null >= reached - TIE * np.maximum(1.0, np.abs(reached))
    # Counted as below, orders without a statistic would make p too small.
    return np.asarray(above.sum(axis=0) / np.maximum((null > -np.inf).sum(axis=0), 1))


def make_test(null: Floats, *, exact: bool, smallest: float | None = None) -> PermutationTest:
    """Return the test of statistics [N], the observed one first."""
    least = 1 / len(null) if smallest is None else smallest
    return PermutationTest(float(tail_p(null)), least, exact, len(null), float(null[0]), null)


def permutation_test(
    model_rdm: ArrayLike, brain_rdms: ArrayLike, *, method: str = "pearson", seed: int = 0, device: Any = None
) -> PermutationTest:
    """Test whether the model's RDM compares better with the animals' than permuted ones do.

    The statistic is the mean comparison over animals; the test is one-sided (greater), since only
    likeness is evidence for a model.

    Args:
        model_rdm: [P].
        brain_rdms: [A, P] or [P].
        method: Comparison, see :func:`brainbench.metrics.compare`.
        seed: Seed of the random orders; unused when all are taken.
        device: Torch device for the products, which pays from some hundred stimuli on; numpy by default.

    >>> test = permutation_test([1, 2, 3, 4, 5, 7], [[1, 2, 3, 4, 5, 6], [2, 3, 3, 4, 6, 7]])
    >>> test.count, round(test.p, 4), test.p == test.smallest
    (24, 0.0417, True)
    """
    comparison.check_comparison(method)
    model = comparison.rdm_stack(model_rdm, "model_rdm")
    brain = np.atleast_2d(comparison.rdm_stack(brain_rdms, "brain_rdms"))
    if model.ndim != 1 or brain.ndim != 2 or model.shape[-1] != brain.shape[-1]:
        raise UsageError(
            f"A permutation test takes one model RDM [P] and brain RDMs [A, P] of the same stimuli; received shapes "
            f"{model.shape} and {brain.shape}."
        )
    stimuli = comparison.stimulus_count(len(model))
    exact, smallest = stimuli <= EXACT_STIMULI, smallest_p(stimuli)
    null, reason = np.empty(0), ""
    if stimuli < SMALLEST_STIMULI:
        reason = f"{stimuli} stimuli allow no p below {smallest:.3g}; at least {SMALLEST_STIMULI} are needed"
    elif not (np.isfinite(model).all() and np.isfinite(brain).all()):
        reason = "an RDM has missing pairs, so its stimuli cannot be permuted"
    else:
        # Sorted, random orders do not depend on how the stimuli were listed: entry n of two models is the same order.
        # The given one comes first, so the observed statistic went through the same arithmetic.
        pairs = comparison.permuted_pairs(canonical_order(brain)[None])[0]
        chunks = label_orders(stimuli, seed, step=max(1, _CHUNK_ELEMENTS // len(model)))
        sides = model[None, pairs], brain[:, pairs]
        comparisons = comparison.permuted_comparisons(*sides, chunks, method, device=find_device(device))
        null = np.concatenate([r[:, 0].mean(axis=-1) for r in comparisons])
        if np.isfinite(null[0]):
            return make_test(null, exact=exact, smallest=smallest)
        reason = "the comparison is undefined (a constant RDM)"
    return PermutationTest(math.nan, smallest, exact, len(null), math.nan, null, reason)


def layer_p(null: Floats, competing: Ints | None = None) -> tuple[Floats, Floats]:
    """Return each layer's p [L], alone and corrected by the largest of all layers, from statistics [N, L].

    The largest is that of the ``competing`` layers, where a layer is one of them: others are of fewer stimuli.

    The first row is the observed one; the correction is the maximum statistic (Nichols & Holmes 2002).
    """
    # The maximum over layers in each permutation keeps the family-wise error, however layers depend on one another.
    # A layer without a value under some order leaves the maximum to the others.
    defined = np.where(np.isfinite(null), null, -np.inf)
    corrected = tail_p(defined.max(axis=1, keepdims=True), null[0])
    if competing is not None:
        corrected[competing] = tail_p(defined[:, competing].max(axis=1, keepdims=True), null[0, competing])
    return tail_p(null), corrected


def most_exact(draws: int) -> int:
    """Return the largest number of stimuli of which all orders are taken: they are at most five times ``draws``."""
    return max(count for count in range(EXACT_STIMULI + 1) if math.factorial(count) <= 5 * draws)


def smallest_p(stimuli: int, draws: int = RANDOM_PERMUTATIONS) -> float:
    """Return the smallest p that permuting this many stimuli can give, with random orders where all are too many."""
    # Swapping two stimuli leaves their one distance as it is.
    if stimuli < 3:
        return 1.0
    return 1 / (math.factorial(stimuli) if stimuli <= most_exact(draws) else draws + 1)


def label_orders(
    stimuli: int, seed: int, *, exact: int | None = None, draws: int | None = None, step: int = 1 << 20
) -> Iterator[Ints]:
    """Yield orders of the stimuli [≤ step, K], the given order first: all K! in lexicographic order, or random ones.

    All orders are taken up to ``exact`` stimuli (:data:`EXACT_STIMULI` by default), ``draws`` random ones above
    (:data:`RANDOM_PERMUTATIONS`).
    """
    check_number("seed", seed, least=0, whole=True)
    if stimuli <= (EXACT_STIMULI if exact is None else exact):
        orders = itertools.permutations(range(stimuli))
        while some := list(itertools.islice(orders, step)):
            yield np.array(some, dtype=np.int64)
        return
    # Counting the given order once among the random ones is what (b+1)/(n+1) means.
    yield np.arange(stimuli)[None]
    # One seeded stream, drawn row by row: chunks of any size give the same orders.
    generator = np.random.default_rng(seed)
    number = RANDOM_PERMUTATIONS if draws is None else draws
    for start in range(0, number, step):
        rows = min(step, number - start)
        yield generator.permuted(np.tile(np.arange(stimuli), (rows, 1)), axis=1)


def canonical_order(brain: Floats) -> Ints:
    """Return an order of stimuli that depends on the RDMs [A, P] alone, not on how they were listed."""
    return np.argsort(comparison.square(brain.mean(axis=0)).sum(axis=-1), kind="stable")
