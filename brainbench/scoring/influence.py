"""What carries a score: how many units and animals share it.

An effective number is (Σw)²/Σw² of shares w: as many as there are where all weigh the same, 1 where one has all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.records import Score

DECIDES = 0.5  # share from which a unit or an animal decides alone
_CHANCE_LEVEL = 0.05


def effective_number(shares: ArrayLike) -> float:
    """Return how many parts of equal shares would be as uneven; negative shares count as none, NaN without any.

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
        if len(scored) > 2 and heights[first] > DECIDES * heights.sum() and score.p <= _CHANCE_LEVEL:
            share = heights[first] / heights.sum()
            remarks.append(f"one animal decides: {scored[first].subject} has {share:.0%} of the score")
    return {"effective": stated} if stated else {}, tuple(remarks)
