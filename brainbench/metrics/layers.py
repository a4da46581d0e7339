"""Choice of a model's layer without the data on which the layer is then scored.

The best of many layers looks good by luck alone: with six stimuli the largest of 40 unrelated
comparisons is expected near .56. So the layer for an animal is the one that compares best with the
*other* animals. Comparisons vote raw: dividing by reliability would give the noisiest animals the
loudest vote. Ties go to the first layer.

Other animals saw the same few stimuli, so what they share by luck is not held out: ten layers that know
nothing score .41 on average against animals of one geometry and six stimuli. The permutation p-value
does account for it, because the functions here broadcast over leading axes and a test repeats the whole
choice inside every permutation; the mean score under permutation is the chance level to read beside a
score.
"""

from __future__ import annotations

import numpy as np

from brainbench.metrics.rdms.pairs import Floats, Ints

_TIE = 1e-12


def choose_on_others(r: Floats) -> Ints:
    """Return the layer [..., A] that compares best with all animals but each.

    Args:
        r: [..., L, A] raw comparisons, A ≥ 2.
    """
    # All leave-one-out means from one sum over animals.
    others = (r.sum(axis=-1, keepdims=True) - r) / (r.shape[-1] - 1)
    return _first_best(others)


def held_out(r: Floats) -> Floats:
    """Return the comparison [..., A] of each animal with the layer chosen on the others, from r [..., L, A]."""
    return _take(r, choose_on_others(r))


def choose_on_halves(first: Floats, second: Floats) -> tuple[Ints, Floats]:
    """Choose on one half of an animal's trials and evaluate on the other, both ways.

    Args:
        first, second: [..., L, S] comparisons with the RDMs of the two halves of each split.

    Returns:
        Layers [..., 2S] and their comparisons [..., 2S] with the half they were not chosen on.
    """
    on_first, on_second = _first_best(first), _first_best(second)
    chosen = np.concatenate([on_first, on_second], axis=-1)
    return chosen, np.concatenate([_take(second, on_first), _take(first, on_second)], axis=-1)


def most_chosen(chosen: Ints) -> int:
    """Return the layer chosen most often; the first among equals."""
    return int(np.argmax(np.bincount(np.ravel(chosen))))


def first_best(values: Floats) -> int:
    """Return the index of the largest value [L]; the first among equals."""
    return int(_first_best(np.asarray(values)[:, None])[0])


def _first_best(values: Floats) -> Ints:
    """Return the first index along axis −2 whose value equals the largest up to rounding."""
    # A tolerance for ties: layers with equal RDMs differ by rounding, and the first of them is to win on every machine.
    return np.argmax(values >= values.max(axis=-2, keepdims=True) - _TIE, axis=-2)


def _take(values: Floats, index: Ints) -> Floats:
    return np.take_along_axis(values, index[..., None, :], axis=-2)[..., 0, :]
