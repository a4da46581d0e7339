"""Bootstrap of one animal: sessions drawn with replacement, then trials of each stimulus within them.

Each draw gives an RDM and, from split halves of the drawn trials, its agreement with itself. Both
halves of a split hold different trials: a trial drawn twice stays in its half, or the halves would
agree by sharing noise. Random numbers are seeded by the trials' hashes, so the order of trials,
stimuli, sessions and units changes nothing. A session drawn twice counts its units twice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainbench.metrics.rdms.comparison import compare
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.halves import WeightedRDMs, chunk_size, split_members
from brainbench.metrics.reliability.sessions import SortedTrials


def resample(
    sessions: list[SortedTrials], count: int, method: str, comparison: str, *, draws: int, splits: int, seed: int
) -> tuple[Floats, Floats]:
    """Return the RDMs [D, P] of the draws and the comparisons [D, S] of their halves (NaN: none exists)."""
    sessions = sorted(sessions, key=lambda session: session.identity)
    counts = [trial_counts(session, count, draws, seed) for session in sessions]
    number = len(sessions)
    copies = _drawn(np.random.default_rng([seed, *(session.identity for session in sessions)]), number, draws)
    members = [split_members(session, count, np.arange(splits), seed) for session in sessions]
    rdms, agreement = np.empty((draws, count * (count - 1) // 2)), np.empty((draws, splits))
    step = chunk_size(sessions, count)
    for start in range(0, draws, step):
        rows = slice(start, min(start + step, draws))
        drawn = WeightedRDMs(sessions, [each[rows] for each in counts], count, method, copies[rows])
        rdms[rows] = drawn.whole()
        for split in range(splits):
            one, two = drawn.halves([member[split : split + 1] for member in members])
            agreement[rows, split] = compare(one, two, method=comparison)
    whole = np.stack([_splittable(*each, count, method) for each in zip(sessions, counts, members, strict=True)])
    # A session that was not drawn has no say, whatever it lacks.
    agreement[~(whole | (copies.T == 0)[..., None]).all(axis=0)] = np.nan
    return rdms, agreement


def trial_counts(session: SortedTrials, count: int, draws: int, seed: int) -> Floats:
    """Return how often each trial [D, R] was drawn among those of its stimulus."""
    parts = []
    for stimulus in range(count):
        # Seeded by the sum of the trials' hashes, which does not depend on their order.
        hashes = session.hashes[session.group(stimulus)]
        parts.append(_drawn(np.random.default_rng([seed, int(hashes.sum(dtype=np.uint64))]), len(hashes), draws))
    return np.concatenate(parts, axis=1).astype(np.float64)


def _drawn(generator: np.random.Generator, number: int, draws: int) -> Ints:
    """Return how often each of ``number`` things [D, number] was drawn with replacement."""
    # Numbers of draw d are moved by d · number, so that one count serves all draws.
    drawn = generator.integers(0, number, (draws, number)) + number * np.arange(draws)[:, None]
    return np.bincount(drawn.ravel(), minlength=draws * number).reshape(draws, number)


def _splittable(session: SortedTrials, counts: Floats, members: Floats, count: int, method: str) -> NDArray[np.bool_]:
    """Return where both halves [D, S] have enough different trials of every stimulus."""
    # The variance of a mean needs two different trials; one trial drawn twice holds its noise once.
    drawn, needed = (counts > 0).astype(np.float64), 2 if method == "crossnobis" else 1
    enough = np.ones((len(counts), len(members)), dtype=bool)
    for stimulus in range(count):
        rows = session.group(stimulus)
        for half in (members[:, rows], 1.0 - members[:, rows]):
            enough &= drawn[:, rows] @ half.T >= needed
    return enough
