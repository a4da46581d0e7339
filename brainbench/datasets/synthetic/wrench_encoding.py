"""Expected rates from whisker wrenches: the fixed nonlinear temporal encoding of the demo recordings' neurons.

Afferents: every wrench channel of every whisker, scaled by its root mean square, half-wave rectified
in both directions, compressed, once adapting within 30 ms (onsets) and once within 200 ms, then
divided by the mean activity of the tracked whiskers (contacts are compared across whiskers: Rodgers
2021). Units: a sparse random mixture of afferents around a preferred whisker; most of them answer
only when another such mixture, on any tracked whisker, was active 18 to 45 ms before, so that they
report the order of contacts. Then an expansive gain and 15 ms latency.

Letters: K stimulus, T frame, W whisker, A afferent of one whisker, U unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing
from brainbench.datasets.layouts.rodgers import TRACKED

if TYPE_CHECKING:
    import xarray as xr

LATENCY = 0.015
"""Delay from whisker to spike, s."""

_FAST, _SLOW = 0.03, 0.2
_ONSET = 3.0
"""Weight of the fast-adapting afferents."""
_COMPRESSION = 1.0
"""Half-saturation of an afferent, in root mean squares of its channel."""
_OTHERS = 0.15
"""Share of units that prefer an untracked whisker."""
_SPREAD = 0.6
"""Width of a receptive field, in whiskers."""
_SPARSE = 0.25
"""Share of afferent channels that drive one unit."""
_SEQUENCE = 0.5
"""Share of units that need an earlier input."""
_DELAYS = (2, 6)
"""Delay of the earlier input, in frames; the end is excluded."""
_EXPONENT = 2.0


@dataclass(frozen=True)
class Afferents:
    """Responses of the whisker afferents to the stimuli."""

    values: NDArray[np.float64]
    """[K, T, W, A]."""
    whiskers: tuple[str, ...]
    """[W]."""
    position: NDArray[np.float64]
    """[W, 2] row and column on the grid."""
    frame: float
    """Duration of a frame, s."""


@dataclass(frozen=True)
class Population:
    """Units of one animal or session."""

    weights: NDArray[np.float64]
    """[W, A, U] mixture of afferents."""
    earlier: NDArray[np.float64]
    """[W, A, U] mixture that must have been active before; equal to ``weights`` where none must."""
    delay: NDArray[np.int64]
    """[U] delay of that mixture, in frames."""
    baseline: NDArray[np.float64]
    """[U] Hz."""
    gain: NDArray[np.float64]
    """[U] Hz at a drive of one root mean square."""

    def rates(self, afferents: Afferents) -> NDArray[np.float64]:
        """Return the expected firing rate [K, T, U], Hz, before the latency."""
        now = _unit_scale(np.tensordot(afferents.values, self.weights, axes=2))
        before = _unit_scale(np.tensordot(afferents.values, self.earlier, axes=2))
        for delay in np.unique(self.delay[self.delay > 0]):
            late = self.delay == delay
            before[:, delay:, late] = before[:, :-delay, late]
            before[:, :delay, late] = 0.0
        # The geometric mean asks for both inputs, present and earlier; the exponent then sharpens the tuning.
        drive = _unit_scale(np.sqrt(now * before)) ** _EXPONENT
        # Rounding keeps the spikes equal where two machines simulate stimuli that differ in the last bits.
        return np.round(self.baseline + self.gain * drive / (1 + drive / 8), 4)


def make_afferents(stimuli: xr.Dataset) -> Afferents:
    """Compute the afferent responses to a stimulus set.

    Raises:
        DataError: a wrench is not finite (an unstable simulation), all are zero, or no tracked whisker is there.
    """
    names = tuple(str(name) for name in stimuli["whisker"].values)
    wrench = stimuli["wrench"].transpose("stimulus", "time", "whisker", "channel").values.astype(np.float64)
    broken = [name for index, name in enumerate(names) if not np.isfinite(wrench[:, :, index]).all()]
    if broken:
        raise DataError(f"The stimuli hold no finite wrench for {listing(broken)}: simulate with a finer fidelity.")
    frame = float(np.median(np.diff(stimuli["time"].values)))
    tracked = [index for index, name in enumerate(names) if name in TRACKED]
    if not tracked:
        raise DataError(f"The stimuli have none of the tracked whiskers {listing(TRACKED)}; simulate them too.")
    scale = np.sqrt(np.mean(wrench[:, :, tracked] ** 2, axis=(0, 1, 2)))
    if not np.any(scale > 0):
        raise DataError("The stimuli exert no force on the whiskers, so there is nothing for neurons to encode.")
    # An afferent answers to one direction of a channel (half-wave rectification) and saturates as x/(x + 1).
    signal = wrench / np.where(scale > 0, scale, np.inf)
    halves = np.concatenate([np.maximum(signal, 0.0), np.maximum(-signal, 0.0)], axis=3)
    halves = halves / (halves + _COMPRESSION)
    # Fast adaptation: what exceeds the last 30 ms, so onsets. Slow adaptation: divided by the mean of the last 200 ms.
    fast = np.maximum(halves - _smooth(halves, _FAST, frame), 0.0)
    slow = halves / (0.5 + _smooth(halves, _SLOW, frame))
    afferents = np.concatenate([_ONSET * fast, slow], axis=3)
    # Divisive normalisation by all tracked whiskers: the encoding compares contacts instead of adding up forces.
    surround = afferents[:, :, tracked].mean(axis=(2, 3), keepdims=True)
    position = np.stack([stimuli["row"].values, stimuli["col"].values], axis=1).astype(np.float64)
    return Afferents(afferents / (0.3 + surround), names, position, frame)


def draw_population(
    random: np.random.Generator, afferents: Afferents, units: int, emphasis: NDArray[np.float64], depth: float = 1.0
) -> Population:
    """Draw units from the tuning distribution that all animals share.

    Args:
        random: source of the draws.
        afferents: what the units listen to.
        units: number of units.
        emphasis: [W, A] weight that this animal gives to each afferent.
        depth: strength of the tuning against the baseline.
    """
    whiskers = len(afferents.whiskers)
    tracked = np.array([float(name in TRACKED) for name in afferents.whiskers])
    preference = (1 - _OTHERS) * tracked / tracked.sum() + _OTHERS / whiskers
    first, second = (
        _mixture(random, afferents, random.choice(whiskers, size=units, p=chances)) * emphasis[:, :, None]
        for chances in (preference, tracked / tracked.sum())
    )
    plain = random.random(units) >= _SEQUENCE
    second[:, :, plain] = first[:, :, plain]
    return Population(
        weights=first,
        earlier=second,
        delay=np.where(plain, 0, random.integers(*_DELAYS, size=units)),
        baseline=random.gamma(3.0, 1.0, size=units),
        gain=depth * random.gamma(2.0, 1.8, size=units),
    )


def window_rates(
    rates: NDArray[np.float64], frame: float, first: NDArray[np.float64], last: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the mean rate [K, U] from ``first`` [K] to each of ``last`` [N] (s after onset), averaged over N."""
    frames = rates.shape[1]
    edges = np.arange(frames + 1) * frame + LATENCY
    # The running integral is read between frames by interpolation, exact for rates constant within a frame.
    total = np.concatenate([np.zeros_like(rates[:, :1]), np.cumsum(rates, axis=1) * frame], axis=1)
    result = np.empty((rates.shape[0], rates.shape[2]))
    for stimulus, begin in enumerate(first):
        ends = np.concatenate([[begin], last])
        read = np.stack([np.interp(ends, edges, total[stimulus, :, unit]) for unit in range(rates.shape[2])], axis=1)
        result[stimulus] = np.mean((read[1:] - read[0]) / (last - begin)[:, None], axis=0)
    return result


def _mixture(random: np.random.Generator, afferents: Afferents, centre: NDArray[np.int64]) -> NDArray[np.float64]:
    """Draw a sparse mixture [W, A, U] of afferents around each unit's whisker ``centre`` [U]."""
    whiskers, channels = afferents.values.shape[2:]
    units = len(centre)
    distance = np.linalg.norm(afferents.position[:, None] - afferents.position[centre][None], axis=2)
    field = np.exp(-0.5 * (distance / _SPREAD) ** 2)
    # Neighbours may also inhibit: what a unit reports is then a comparison between whiskers.
    sign = np.where(distance == 0, 1.0, random.choice([-1.0, 1.0], p=[0.6, 0.4], size=(whiskers, units)))
    mixture = random.exponential(size=(channels, units)) * (random.random((channels, units)) < _SPARSE)
    mixture[random.integers(channels, size=units), np.arange(units)] += 1.0
    return (field * sign)[:, None, :] * mixture[None]


def _unit_scale(drive: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rectify and give every unit a root mean square of one over stimuli and frames."""
    drive = np.maximum(drive, 0.0)
    return drive / np.maximum(np.sqrt(np.mean(drive**2, axis=(0, 1))), 1e-12)


def _smooth(values: NDArray[np.float64], seconds: float, frame: float) -> NDArray[np.float64]:
    """First-order low-pass along axis 1, starting from rest."""
    from scipy.signal import lfilter

    # y ← y + (1 − e^(−Δt/τ))(x − y), exact for an input constant within a frame.
    share = 1.0 - np.exp(-frame / seconds)
    return np.asarray(lfilter([share], [1.0, share - 1.0], values, axis=1))
