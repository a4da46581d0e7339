"""Permutation tests: could labels in another order have compared as well?

The stimulus labels of the model are permuted, which permutes rows and columns of its RDM together.
Up to eight stimuli all K! orders are taken (the p-value is exact), above that 10,000 random ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.records import Status
from brainbench.metrics.arrays import find_device
from brainbench.metrics.rdms.comparison import check_comparison
from brainbench.metrics.rdms.pairs import Floats, Ints, permuted_pairs, rdm_stack, square, stimulus_count
from brainbench.metrics.rdms.relabelling import relabelled_comparisons

EXACT_STIMULI = 8
"""Up to this many stimuli all orders are taken (8! = 40,320)."""

RANDOM_PERMUTATIONS = 10_000

SMALLEST_STIMULI = 4
"""Below this no p is given: 3 stimuli have 6 orders, so p could never fall below 1/6."""

TIE = 1e-12
"""Statistics closer than this are equal: permutations that map an RDM onto itself differ by rounding."""

_CHUNK_ELEMENTS = 1 << 22


@dataclass(frozen=True)
class PermutationTest:
    """Result of a one-sided permutation test."""

    p: float
    """P(statistic ≥ observed) under permuted labels; NaN when undefined."""
    smallest: float
    """Smallest p that this test could give."""
    exact: bool
    """Whether all orders were taken."""
    count: int
    """Orders that were taken, the given one included."""
    observed: float
    null: Floats
    """[count] statistics, first the observed one."""
    reason: str = ""
    """Why p is undefined."""

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


def permutation_test(
    model_rdm: ArrayLike, brain_rdms: ArrayLike, *, method: str = "pearson", seed: int = 0, device: Any = None
) -> PermutationTest:
    """Test whether the model's RDM compares better with the animals' than relabelled ones do.

    The statistic is the mean comparison over animals; the test is one-sided (greater), since only
    likeness is evidence for a model.

    Args:
        model_rdm: [P].
        brain_rdms: [A, P] or [P].
        method: Comparison, see :func:`brainbench.metrics.rdms.comparison`.
        seed: Seed of the random orders; unused when all are taken.
        device: Torch device for the products, which pays from some hundred stimuli on; numpy by default.

    Raises:
        UsageError: unknown method or device, or RDMs of different numbers of stimuli.

    >>> test = permutation_test([1, 2, 3, 4, 5, 7], [[1, 2, 3, 4, 5, 6], [2, 3, 3, 4, 6, 7]])
    >>> test.count, round(test.p, 4), test.p == test.smallest
    (24, 0.0417, True)
    """
    check_comparison(method)
    model = rdm_stack(model_rdm, "model_rdm")
    brain = np.atleast_2d(rdm_stack(brain_rdms, "brain_rdms"))
    if model.ndim != 1 or brain.ndim != 2 or model.shape[-1] != brain.shape[-1]:
        raise UsageError(
            f"A permutation test takes one model RDM [P] and brain RDMs [A, P] of the same stimuli; received shapes "
            f"{model.shape} and {brain.shape}."
        )
    return permuted_statistic(
        model[None], brain, lambda r: r[:, 0].mean(axis=-1), method=method, seed=seed, device=device
    )


def permuted_statistic(
    layers: Floats,
    brain: Floats,
    statistic: Callable[[Floats], Floats],
    *,
    method: str = "pearson",
    seed: int = 0,
    device: Any = None,
) -> PermutationTest:
    """Test any statistic of the comparisons of layers with brain RDMs.

    Args:
        layers: [L, P] RDMs of one model; a permutation relabels all of them alike.
        brain: [A, P] RDMs.
        statistic: Takes comparisons [N, L, A] under N permutations, returns [N]. What is chosen on the
            data (a layer) must be chosen inside, or p is too small.
        method: Comparison.
        seed: Seed of the random orders.
        device: Torch device for the products, or None for numpy.
    """
    stimuli = stimulus_count(layers.shape[-1])
    exact = stimuli <= EXACT_STIMULI
    count = math.factorial(stimuli) if exact else RANDOM_PERMUTATIONS + 1
    smallest = smallest_p(stimuli)
    reason = ""
    if stimuli < SMALLEST_STIMULI:
        reason = f"{stimuli} stimuli allow no p below {smallest:.3g}; at least {SMALLEST_STIMULI} are needed"
    elif not (np.isfinite(layers).all() and np.isfinite(brain).all()):
        reason = "an RDM has missing pairs, so its stimuli cannot be permuted"
    if reason:
        return PermutationTest(math.nan, smallest, exact, count, math.nan, np.empty(0), reason)
    null = permuted_values(layers, brain, statistic, method=method, seed=seed, device=device)
    if not np.isfinite(null[0]):
        return PermutationTest(
            math.nan, smallest, exact, count, math.nan, null, "the comparison is undefined (a constant RDM)"
        )
    # The given order comes first, so the observed statistic went through the same arithmetic.
    p = float(np.mean(null >= null[0] - TIE * max(1.0, abs(null[0]))))
    return PermutationTest(p, smallest, exact, count, float(null[0]), null)


def permuted_values(
    layers: Floats,
    brain: Floats,
    statistic: Callable[[Floats], Floats],
    *,
    method: str = "pearson",
    seed: int = 0,
    device: Any = None,
) -> Floats:
    """Return a statistic [N, ...] of comparisons [N, L, A] under every order of the stimuli, the given one first.

    Orders depend on the brain's RDMs and the seed alone, so entry n of two models is the same relabelling.
    """
    layers, brain = _canonical(layers, brain)
    step = max(1, _CHUNK_ELEMENTS // layers.size)
    chunks = label_orders(stimulus_count(layers.shape[-1]), step, seed)
    found = relabelled_comparisons(layers, brain, chunks, method, device=find_device(device))
    return np.concatenate([statistic(r) for r in found])


def layer_p(null: Floats) -> tuple[Floats, Floats]:
    """Return each layer's p [L], alone and corrected by the largest of all layers, from statistics [N, L].

    The first row is the observed one; the correction is the maximum statistic (Nichols & Holmes 2002).
    """
    slack = TIE * np.maximum(1.0, np.abs(null[0]))
    largest = null.max(axis=1, keepdims=True)
    return (null >= null[0] - slack).mean(axis=0), (largest >= null[0] - slack).mean(axis=0)


def smallest_p(stimuli: int) -> float:
    """Return the smallest p that permuting this many stimuli can give."""
    # Swapping two stimuli leaves their one distance as it is.
    if stimuli < 3:
        return 1.0
    return 1 / (math.factorial(stimuli) if stimuli <= EXACT_STIMULI else RANDOM_PERMUTATIONS + 1)


def label_orders(stimuli: int, step: int, seed: int) -> Iterator[Ints]:
    """Yield orders of the stimuli [≤ step, K], the given order first: all K!, or 10,000 random ones."""
    if stimuli <= EXACT_STIMULI:
        orders = _all_orders(stimuli)
        yield from (orders[start : start + step] for start in range(0, len(orders), step))
        return
    # Counting the given order once among the random ones is what (b+1)/(n+1) means.
    yield np.arange(stimuli)[None]
    generator = np.random.default_rng(seed)
    for start in range(0, RANDOM_PERMUTATIONS, step):
        rows = min(step, RANDOM_PERMUTATIONS - start)
        yield generator.permuted(np.tile(np.arange(stimuli), (rows, 1)), axis=1)


def _all_orders(count: int) -> Ints:
    """Return all permutations [K!, K] in lexicographic order."""
    orders = np.zeros((1, 1), dtype=np.int64)
    for size in range(2, count + 1):
        rest = orders[None] + (orders[None] >= np.arange(size)[:, None, None])
        first = np.broadcast_to(np.arange(size)[:, None, None], (size, len(orders), 1))
        orders = np.concatenate([first, rest], axis=-1).reshape(-1, size)
    return orders


def canonical_order(brain: Floats) -> Ints:
    """Return an order of stimuli that depends on the RDMs [A, P] alone, not on how they were listed."""
    return np.argsort(square(brain.mean(axis=0)).sum(axis=-1), kind="stable")


def _canonical(layers: Floats, brain: Floats) -> tuple[Floats, Floats]:
    """Sort the stimuli, so that random orders do not depend on how the stimuli were listed."""
    pairs = permuted_pairs(canonical_order(brain)[None])[0]
    return layers[:, pairs], brain[:, pairs]
