"""The latency of each layer.

A layer's latency is the lag at which its mean comparison over times and animals, less chance, is highest. Its error is
a jackknife over animals and stimuli (Miller, Patterson & Ulrich 1998, doi:10.1111/1469-8986.3510099, for animals).

Letters: N permutation, L layer, G lag, T time bin, A animal, K stimulus.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from brainbench.core.records import Interval
from brainbench.core.statistics import two_factor_interval
from brainbench.metrics.arrays import finite_mean
from brainbench.metrics.inference.permutation import tail_p
from brainbench.metrics.rdms.pairs import Floats
from brainbench.metrics.time.lags import best_lag, votes

ALPHA = 0.05
"""Level at which a layer's latency is given."""


@dataclass(frozen=True)
class LayerLatency:
    """Lag of the animals behind one layer."""

    layer: str
    latency: float
    """Lag of the best match, seconds; positive where neurons follow the model. NaN where ``reason`` says why."""
    value: float
    """Mean raw comparison at the best lag, less chance."""
    p: float
    """Permutation p of the best match over lags, corrected for the number of layers and lags."""
    interval: Interval | None = None
    """Interval of ``latency`` over animals and stimuli."""
    reason: str = ""
    """Reason for having no latency."""


def standardised(null: Floats) -> Floats:
    """Return statistics [N, ...] in standard deviations from their mean over permutations; −∞ where undefined."""
    # Chance differs between times and lags: by an early bin's few spikes, by the bins that overlap.
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = finite_mean(np.moveaxis(null, 0, -1))
        spread = np.sqrt(finite_mean(np.moveaxis((null - mean) ** 2, 0, -1)))
        z = (null - mean) / spread
    return np.where(np.isfinite(z), z, -np.inf)


def layer_latencies(
    names: tuple[str, ...], lags: Floats, excess: Floats, left_out: list[Floats], match: Floats
) -> tuple[LayerLatency, ...]:
    """Return every layer's latency.

    ``lags`` [G] are seconds, ``excess`` [L, G, T, A] comparisons less chance, ``left_out`` the same without each
    stimulus in turn, ``match`` [N, L, G] mean comparisons under permutations, the given order first.
    """
    z = standardised(match)
    p = tail_p(z.reshape(len(z), -1).max(axis=1)[:, None], z[0].max(axis=-1))
    animals, step = excess.shape[-1], lags[1] - lags[0]

    def latency(values: Floats) -> Floats:
        return lags[0] + step * best_lag(values)

    best = latency(excess)
    # Pseudo-values, whose variance over animals is that of the jackknife.
    singles = np.stack([latency(np.delete(excess, index, axis=-1)) for index in range(animals)], axis=-1)
    pseudo = animals * best[:, None] - (animals - 1) * singles
    without = np.stack([latency(item) for item in left_out], axis=-1)
    reached = finite_mean(votes(excess[None])[0])
    found = []
    for index, name in enumerate(names):
        tried, reason = int(np.isfinite(reached[index]).sum()), ""
        if tried < 3:
            reason = "the layer has no time" if tried == 1 else "too few lags have a comparison"
        elif p[index] > ALPHA:
            reason = "no lag matches better than permuted stimuli"
        elif not math.isfinite(best[index]):
            reason = f"the best match lies at the end of the lags tried, {lags[0]:g} to {lags[-1]:g} s"
        # One replicate without a peak would make the error too small.
        steady = bool(np.isfinite(pseudo[index]).all() and np.isfinite(without[index]).all()) and animals > 1
        found.append(
            LayerLatency(
                layer=name,
                latency=math.nan if reason else float(best[index]),
                value=float(np.nanmax(reached[index])) if tried else math.nan,
                p=float(p[index]) if tried else math.nan,
                interval=two_factor_interval(float(best[index]), pseudo[index], without[index])
                if steady and not reason
                else None,
                reason=reason,
            )
        )
    return tuple(found)
