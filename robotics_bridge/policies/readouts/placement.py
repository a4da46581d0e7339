"""Placement of few taxels: which of a hand's tell most of the object, found on some environments and read on others.

Greedy forward selection of groups of features in ridge regression. After each choice, what the chosen taxels tell of
the others is taken out (block elimination of the normal equations), so that the gain of every further taxel is exact
and a choice costs one product per fold. Letters: T control step, B environment, N taxel, F feature of a taxel, P all
features, D number of a target.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from brainbench.core.errors import UsageError
from brainbench.core.progress import Progress
from robotics_bridge.hands.layouts import active_count
from robotics_bridge.policies.readouts.arms import traces
from robotics_bridge.policies.readouts.regression import FARTHEST, Readout, read_targets
from robotics_bridge.policies.readouts.rollout import TouchRollout
from robotics_bridge.sensors.probes.placement import Probes

HALVES = 2
"""Parts of the environments; what is chosen on the others is read on each."""
_INNER = 4
"""Folds of the environments on which a choice is made."""
_PENALTY = 1.0
"""Ridge penalty of the choice, per sample."""


@dataclass(frozen=True)
class Placed:
    """Taxels of the hand, and what is read from them."""

    name: str
    readout: Readout
    taxels: tuple[tuple[int, ...], ...]
    """Indices in the layout's order: one tuple for each draw, or for each half of the environments."""


def taxel_features(rollout: TouchRollout) -> torch.Tensor:
    """Return force, torque and their leaky averages [T, B, N, 18] of every taxel."""
    felt = rollout.taxels.mean(2)
    return traces(felt.flatten(2), rollout.begun).unflatten(-1, (-1, *felt.shape[2:])).transpose(2, 3).flatten(3)


def choose_taxels(
    proprio: torch.Tensor, features: torch.Tensor, wanted: torch.Tensor, valid: torch.Tensor, count: int
) -> list[int]:
    """Return the taxels that raise R² most on environments left out, one after the other, best first.

    The score of a taxel is R², averaged over all numbers of the targets and over four folds of the environments, of a
    regression on the joints, the taxels chosen so far and this one.

    Args:
        proprio: [T, B, n] what is known without touch.
        features: [T, B, N, F].
        wanted: [T, B, D] targets.
        valid: [T, B] bool, steps that count.
    """
    taxels, width = features.shape[2:]
    if features.shape[1] < _INNER:
        raise UsageError(f"Taxels are chosen on at least {_INNER} environments; received {features.shape[1]}.")
    first = proprio.shape[-1]
    x, fold = torch.cat((proprio, features.flatten(2)), -1), torch.arange(features.shape[1]) % _INNER
    parts = [_Elimination(x, wanted, valid, fold != number) for number in range(_INNER)]
    for part in parts:
        part.take(slice(0, first))
    chosen: list[int] = []
    for _ in range(count):
        score = torch.stack([part.gains(first, taxels, width) for part in parts]).mean(0)
        score[chosen] = -torch.inf
        best = int(score.argmax())
        for part in parts:
            part.take(slice(first + best * width, first + (best + 1) * width))
        chosen.append(best)
    return chosen


class _Elimination:
    """Moments of features and targets on learning and test environments, less what the taken features explain."""

    def __init__(self, x: torch.Tensor, wanted: torch.Tensor, valid: torch.Tensor, learning: torch.Tensor) -> None:
        rows, aims = x[:, learning][valid[:, learning]], wanted[:, learning][valid[:, learning]]
        mean, scale, centre, size = rows.mean(0), rows.std(0), aims.mean(0), aims.std(0).clamp(min=1e-12)
        used = scale > 1e-7 * scale.max().clamp(min=1e-30)
        moments = []
        for mine in (learning, ~learning):
            kept = valid[:, mine]
            z = ((x[:, mine][kept] - mean) / torch.where(used, scale, 1.0)).clamp(-FARTHEST, FARTHEST) * used
            y = (wanted[:, mine][kept] - centre) / size
            moments.append([part.double() / len(z) for part in (z.T @ z, z.T @ y, y.square().sum(0))])
        (self._gram, self._product, _), (self._test_gram, self._test_product, self._error) = moments
        self._gram.diagonal().add_(_PENALTY)
        self._spread = self._error.clone()

    def take(self, block: slice) -> None:
        """Put a block of features into the regression."""
        factor = torch.linalg.cholesky(self._gram[block, block])
        told = torch.cholesky_solve(self._gram[block], factor)  # B: features of the block → all features
        weights = torch.cholesky_solve(self._product[block], factor)
        # Schur complement on the learning side; x − x_S B and y − x_S w on the test side.
        column = self._gram[:, block].clone()
        self._product -= column @ weights
        self._gram.addmm_(column, told, alpha=-1)
        inner, across = self._test_gram[block, block].clone(), self._test_gram[:, block].clone()
        self._error += (weights * (inner @ weights)).sum(0) - 2 * (weights * self._test_product[block]).sum(0)
        self._test_product -= across @ weights + told.T @ (self._test_product[block] - inner @ weights)
        self._test_gram.addmm_(across, told, alpha=-1).addmm_(told.T, across.T - inner @ told, alpha=-1)

    def gains(self, first: int, taxels: int, width: int) -> torch.Tensor:
        """Return by how much each taxel [N] would raise R² on the test environments."""
        own, own_test = (_blocks(gram[first:, first:], taxels, width) for gram in (self._gram, self._test_gram))
        product, test = (m[first:].unflatten(0, (taxels, width)) for m in (self._product, self._test_product))
        # Of taken taxels nothing but the penalty's rest is left; it keeps the blocks regular.
        weights = torch.linalg.solve(own + 1e-9 * torch.eye(width, dtype=own.dtype), product)
        lost = (weights * (own_test @ weights)).sum(1) - 2 * (weights * test).sum(1)
        return -(lost / self._spread).mean(1)


def _blocks(gram: torch.Tensor, taxels: int, width: int) -> torch.Tensor:
    """Return the blocks [N, F, F] on the diagonal of a matrix [N·F, N·F]."""
    return gram.unflatten(0, (taxels, width)).unflatten(2, (taxels, width)).diagonal(dim1=0, dim2=2).movedim(-1, 0)


def check_count(layout: Mapping[str, Probes], count: int) -> None:
    """Raise UsageError unless so many taxels can be chosen of a layout."""
    if not 1 <= count <= (total := active_count(layout)):
        raise UsageError(f"Between 1 and {total} taxels can be chosen of this hand; received {count}.")


def even_taxels(layout: Mapping[str, Probes], count: int) -> list[int]:
    """Return taxels spread over a hand: of every link its share of the count, of a link those farthest apart."""
    sizes = np.array([int(probes.active.sum()) for probes in layout.values()])
    # Largest remainders: shares are whole and add up.
    share = count * sizes / sizes.sum()
    whole = np.floor(share).astype(int)
    whole[np.argsort(whole - share, kind="stable")[: count - whole.sum()]] += 1
    found: list[int] = []
    for first, number, probes in zip(np.cumsum(sizes) - sizes, whole, layout.values(), strict=True):
        points, mine = probes.position[probes.active], []
        away = -np.linalg.norm(points - points.mean(0), axis=1)
        for _ in range(number):
            mine.append(int(away.argmax()))
            gap = np.linalg.norm(points - points[mine[-1]], axis=1)
            away = gap if len(mine) == 1 else np.minimum(away, gap)
        found += [int(first) + one for one in mine]
    return found


def part_of_layout(layout: Mapping[str, Probes], taxels: Iterable[int]) -> dict[str, Probes]:
    """Return a layout with these taxels alone, for :func:`robotics_bridge.hands.layouts.write_probes`."""
    wanted, first, found = set(taxels), 0, {}
    for link, probes in layout.items():
        active = np.flatnonzero(probes.active)
        kept = [cell for index, cell in enumerate(active) if first + index in wanted]
        if kept:
            radius = np.zeros_like(probes.radius)
            radius[kept] = probes.radius[kept]
            found[link] = Probes(probes.position, probes.normal, radius, probes.shape)
        first += len(active)
    return found


def read_placements(
    rollout: TouchRollout,
    layout: Mapping[str, Probes],
    count: int,
    *,
    others: Mapping[str, Iterable[int]] | None = None,
    draws: int = 10,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Placed]:
    """Read the targets from all taxels, from ``count`` chosen ones, and from as many random and evenly spread ones.

    Environments are halved: on each half the targets are read from what was chosen on the other, by
    :func:`~robotics_bridge.policies.readouts.regression.read_targets`, whose folds lie within the half.

    Args:
        rollout: What a policy felt, and what is read where it is valid.
        layout: The hand's, whose active taxels are those of the rollout.
        count: Taxels of a placement.
        others: Further placements, name → taxels.
        draws: Random placements, by the seed.
        progress: Called with parts done, in all, and a word.
    """
    check_count(layout, count)
    wanted, valid = rollout.wanted, rollout.valid
    features, every = taxel_features(rollout), range(rollout.taxels.shape[3])
    half = torch.arange(features.shape[1]) // -(-features.shape[1] // HALVES)
    random = np.random.default_rng(seed)
    fixed: dict[str, list[list[int]]] = {"none": [[]], "all": [[*every]], "even": [even_taxels(layout, count)]}
    fixed |= {name: [[*taxels]] for name, taxels in (others or {}).items()}
    fixed["random"] = [sorted(random.permutation(len(every))[:count].tolist()) for _ in range(draws)]
    total, done = HALVES * (1 + sum(map(len, fixed.values()))), 0
    say = progress or (lambda done, total, what: None)
    chosen: list[tuple[int, ...]] = []
    parts: dict[str, list[list[tuple[NDArray[Any], NDArray[Any]]]]] = {}
    for number in range(HALVES):
        mine, rest = half == number, half != number
        say(done, total, "choosing taxels")
        chosen.append(
            tuple(choose_taxels(rollout.proprio[:, rest], features[:, rest], wanted[:, rest], valid[:, rest], count))
        )
        for name, sets in {**fixed, "chosen": [[*chosen[-1]]]}.items():
            read = []
            for taxels in sets:
                say(done, total, f"reading {name}")
                part = features[:, mine][:, :, taxels].flatten(2)
                read.append(read_targets(rollout.proprio[:, mine], part, wanted[:, mine], valid[:, mine]))
                done += 1
            parts.setdefault(name, []).append(read)
    found = []
    for name, read in parts.items():
        errors = np.stack([np.concatenate([one[0] for one in draw]) for draw in zip(*read, strict=True)])
        spread = np.concatenate([part[0][1] for part in read])
        sets = tuple(map(tuple, fixed[name])) if name in fixed else tuple(chosen)
        found.append(Placed(name, Readout(name, len(sets[0]) * features.shape[-1], errors, spread), sets))
    return found
