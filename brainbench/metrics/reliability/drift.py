"""Drift: halves by time beside random halves, within sessions and between them.

Where the responses to a stimulus stay what they are, the earlier and the later half of its trials are halves as any
others, so their RDMs agree as those of random halves do: the share of random halves that agree as little is a p. The
same holds of the earlier and the later sessions of an animal, whose order is drawn anew. Drift of all rates alike is
none of the geometry; that of blocks is a matter of their times (:mod:`brainbench.scoring.presentation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from brainbench.metrics.arrays import finite_mean
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE, spearman_brown
from brainbench.metrics.reliability.subject_rdm import FEWEST_SESSIONS, SubjectRDM

LEVEL = 0.01  # responses drift where so few random halves agree as little; of fewer than 100 halves, where none does
_ORDERS = 999
_TIE = 1e-12


@dataclass(frozen=True)
class Drift:
    """Agreement of halves by time, and of random ones."""

    by_time: float
    """Within sessions a reliability, between them a share of what any two sessions have in common."""
    random: float
    p: float
    """Of an agreement as low for random halves."""
    level: float
    animals: int

    @property
    def present(self) -> bool:
        """True where halves by time agree less than chance explains."""
        return self.p <= self.level

    @property
    def reliable(self) -> bool:
        """True where halves by time are as reliable as a score needs."""
        return self.by_time >= RELIABILITY_GATE

    @property
    def stated(self) -> dict[str, Any]:
        """What a record keeps."""
        return {"by_time": self.by_time, "random": self.random, "p": self.p, "animals": self.animals}


def drift_within(animals: Sequence[SubjectRDM]) -> Drift | None:
    """Compare the halves by time of every session's trials with random ones; None where no times are known."""
    timed = [animal for animal in animals if animal.problem is None and np.isfinite(animal.by_time)]
    if not timed:
        return None
    # Comparisons, not products: what changes over time averages out in the length of the whole, not in that of halves.
    # Splits of different animals are independent, so each column of splits is a draw of the mean over animals.
    null = finite_mean(np.stack([animal.split_half_r for animal in timed]), axis=0)
    null = null[np.isfinite(null)]
    observed = float(np.mean([animal.by_time for animal in timed]))
    p, smallest = _tail(null, observed), 1 / (len(null) + 1)
    shorter, longer = spearman_brown([observed, float(null.mean())])
    reliability = float(np.mean([animal.reliability for animal in timed]))
    by_time = reliability * float(shorter / longer) if longer > 0 else np.nan
    return Drift(by_time, reliability, p, max(LEVEL, smallest), len(timed))


def drift_between(animals: Sequence[SubjectRDM], *, seed: int = 0) -> Drift | None:
    """Compare the earlier with the later sessions of each animal, in random orders too; None without such animals."""
    generator, sums, count = np.random.default_rng(seed), np.zeros(_ORDERS + 1), 0
    for animal in animals:
        size = len(animal.between)
        common = animal.between.sum() - np.trace(animal.between)
        # Sessions that have nothing in common lose nothing over time.
        if size < FEWEST_SESSIONS or not common > 0:
            continue
        orders = np.tile(np.arange(size), (_ORDERS + 1, 1))
        orders[1:] = generator.permuted(orders[1:], axis=1)
        half = size // 2
        crossed = animal.between[orders[:, :half, None], orders[:, None, size - half :]]
        sums += crossed.mean(axis=(1, 2)) / (common / (size * (size - 1)))
        count += 1
    if not count:
        return None
    shares = sums / count
    return Drift(float(shares[0]), 1.0, _tail(shares[1:], float(shares[0])), LEVEL, count)


def _tail(null: np.ndarray, observed: float) -> float:
    return float((1 + (null <= observed + _TIE).sum()) / (len(null) + 1))
