"""Random numbers that belong to a trial, not to its place in an array.

A number is a hash of (seed, split, trial), so shuffling trials, sessions or units changes none of
them. Mixing is the 64-bit finaliser of SplitMix64 (Steele 2014).
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from brainbench.metrics.rdms.pairs import Ints

Hashes = NDArray[np.uint64]

_STEP = np.uint64(0x9E3779B97F4A7C15)
_REFINEMENTS = 2


def key_hashes(keys: Sequence[str]) -> Hashes:
    """Hash trial keys to 64 bits each, equally on every machine."""
    return np.array(
        [int.from_bytes(hashlib.blake2b(str(key).encode(), digest_size=8).digest(), "little") for key in keys],
        dtype=np.uint64,
    )


def content_hashes(responses: NDArray, codes: Ints) -> Hashes:
    """Hash each trial's responses [R, F], whatever the order of trials, units and stimuli.

    A trial starts as the set of its values; then trials and units describe one another (a unit by
    the trials it responds in, a trial by its units' values), so trials that hold the same values on
    different units differ. Trials that are still equal are numbered; swapping them changes nothing.
    """
    # Adding zero turns −0.0 into 0.0, which is equal but has other bits.
    values = _mix((np.where(np.isnan(responses), np.inf, responses).astype(np.float64) + 0.0).view(np.uint64))
    with np.errstate(over="ignore"):
        trial = _mix(values.sum(axis=1, dtype=np.uint64))
        for _ in range(_REFINEMENTS):
            stimulus = np.zeros(int(codes.max(initial=-1)) + 1, dtype=np.uint64)
            np.add.at(stimulus, codes, trial)
            trial = _mix(trial + _mix(stimulus)[codes])
            # Sums of mixed values do not depend on order, which makes trials and units anonymous sets to one another.
            unit = _mix(_mix(values ^ trial[:, None]).sum(axis=0, dtype=np.uint64))
            trial = _mix(trial + _mix(values ^ unit).sum(axis=1, dtype=np.uint64))
        order = np.argsort(trial, kind="stable")
        _, first, inverse = np.unique(trial[order], return_index=True, return_inverse=True)
        occurrence = np.empty(len(trial), dtype=np.uint64)
        occurrence[order] = np.arange(len(trial)) - first[inverse]
        return _mix(trial + occurrence * _STEP)


def draws(hashes: Hashes, splits: Ints, seed: int) -> Hashes:
    """Return one 64-bit random number per split and trial [S, R]."""
    with np.errstate(over="ignore"):
        start = _mix(np.uint64(seed & 0xFFFFFFFFFFFFFFFF) * _STEP + np.uint64(1))
        state = _mix(splits.astype(np.uint64) * _STEP + start)
        return _mix(hashes[None, :] ^ state[:, None])


def _mix(state: NDArray[np.uint64] | np.uint64) -> Hashes:
    with np.errstate(over="ignore"):
        z = np.asarray(state, dtype=np.uint64) + _STEP
        # SplitMix64's finaliser (Steele 2014) maps 64 bits one to one, so different trials keep different numbers.
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))
