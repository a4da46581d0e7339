"""Choice of a model's layer without the data on which the layer is then scored.

The best of many layers looks good by luck alone: with six stimuli the largest of 40 unrelated
comparisons is expected near .56. So the layer for an animal is the one that compares best with the
*other* animals, unless one was committed to beforehand. Comparisons vote raw: dividing by reliability would give
the noisiest animals the loudest vote. Ties go to the first layer.

Other animals saw the same few stimuli, so what they share by luck is not held out: ten layers that know
nothing score .41 on average against animals of one geometry and six stimuli. The permutation p-value
does account for it, because the rules here broadcast over leading axes and a test repeats the whole
choice inside every permutation; the mean score under permutation is a score's ``chance``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from brainbench.metrics.rdms.pairs import Floats, Ints

_TIE = 1e-12

Kind = Literal["fixed", "others", "halves", "maximum"]


@dataclass(frozen=True)
class LayerRule:
    """Choice of the layer for each animal among comparisons [..., L, A]."""

    kind: Kind
    words: str
    """The rule, as a record states it."""
    fixed: int = 0
    """The layer, where it is given."""
    factors: Floats | None = None
    """[A] weights of the animals, where the maximum of the corrected mean is taken."""

    def choose(self, r: Floats) -> Ints:
        """Return the layer [..., A] for each animal."""
        if self.kind == "others":
            return choose_on_others(r)
        if self.kind == "halves":
            # Animals are the halves of one animal's splits: each is scored by the layer best on its other half.
            pairs = r.reshape(*r.shape[:-1], -1, 2)[..., ::-1]
            return first_best(pairs.reshape(r.shape))
        shape = (*r.shape[:-2], r.shape[-1])
        if self.kind == "maximum":
            weighted = r if self.factors is None else r * self.factors
            return np.broadcast_to(first_best(weighted.mean(axis=-1)[..., None]), shape)
        return np.full(shape, self.fixed)

    def held(self, r: Floats) -> Floats:
        """Return the comparison [..., A] of each animal with the layer chosen for it."""
        return r[..., self.fixed, :] if self.kind == "fixed" else take_layers(r, self.choose(r))


def layer_rule(
    names: list[str], animals: int, *, committed: str | None = None, estimator: str = "default", factors: Floats
) -> LayerRule:
    """Return the rule for layers ``names`` [L] and a number of animals (a single one whose halves are not known)."""
    if committed is not None:
        return LayerRule("fixed", "committed to beforehand", names.index(committed))
    if len(names) == 1:
        return LayerRule("fixed", "only layer")
    if estimator != "default":
        # The published rule; the test takes the same maximum, so its p stays honest where the value is not.
        words = "maximum over layers on the data that are scored (as published; optimistic)"
        return LayerRule("maximum", words, factors=factors)
    if animals == 1:
        words = "maximum over layers on the only animal (optimistic; the permutation takes the same maximum)"
        return LayerRule("maximum", words)
    return LayerRule("others", "chosen on the other animals, evaluated on the animal held out")


HALVES = LayerRule("halves", "chosen on one half of the only animal's trials, evaluated on the other half")


def choose_on_others(r: Floats) -> Ints:
    """Return the layer [..., A] that compares best with all animals but each.

    From raw comparisons [..., L, A], A ≥ 2.
    """
    # All leave-one-out means from one sum over animals.
    others = (r.sum(axis=-1, keepdims=True) - r) / (r.shape[-1] - 1)
    return first_best(others)


def held_out(r: Floats) -> Floats:
    """Return the comparison [..., A] of each animal with the layer chosen on the others, from r [..., L, A]."""
    return take_layers(r, choose_on_others(r))


def most_chosen(chosen: Ints) -> int:
    """Return the layer chosen most often; the first among equals."""
    return int(np.argmax(np.bincount(np.ravel(chosen))))


def first_best(values: Floats) -> Ints:
    """Return the first index [..., A] of the layers [..., L, A] whose value equals the largest up to rounding."""
    # A tolerance for ties: layers with equal RDMs differ by rounding, and the first of them is to win on every machine.
    return np.argmax(values >= values.max(axis=-2, keepdims=True) - _TIE, axis=-2)


def take_layers(values: Floats, index: Ints) -> Floats:
    """Return the values [..., A] of one layer for each animal, from [..., L, A] and layers [A] or [..., A]."""
    index = np.broadcast_to(index, (*values.shape[:-2], values.shape[-1]))
    return np.take_along_axis(values, index[..., None, :], axis=-2)[..., 0, :]
