"""Are models told apart when they should be, and only then? Many boards at once, with the two-factor rule.

    python -m benchmarks.scores.two_factor [--boards 500] [--seed 0] [--write]

Animals mix latent features that all share, with individual features and trial noise; models hold a share of the latent
features. Models and animals are compared by the whitened cosine of squared Euclidean RDMs, each pair of models by
:func:`brainbench.core.statistics.two_factor_error`, as the board does. ``--write`` puts the table into RESULTS.md.
"""

from __future__ import annotations

import argparse
import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from benchmarks.report import table, write_section
from brainbench.core.statistics import two_factor_error
from brainbench.metrics.layers import choose_on_others, take_layers

DIMENSIONS, UNITS, TRIALS = 8, 60, 18
INDIVIDUAL, NOISE = 0.5, 4.0
"""Standard deviation of a unit's individual tuning and of its noise in a trial; that of its shared tuning is 1."""


@dataclass(frozen=True)
class Cell:
    """One kind of board."""

    stimuli: int
    animals: int
    shares: tuple[float, ...]
    """Of each model, the true scaled score."""
    layers: int = 1
    """Layers of each model; those after the first know nothing."""


def centred(products: np.ndarray) -> np.ndarray:
    """Return products [..., K, K] with both sides centred over stimuli."""
    rows = products - products.mean(axis=-1, keepdims=True)
    return rows - rows.mean(axis=-2, keepdims=True)


def scaled(models: np.ndarray, brain: np.ndarray) -> np.ndarray:
    """Return whitened cosines [B, L, A] of products [B, L, K, K] and [B, A, K, K], less what permutation gives."""
    count = models.shape[-1]
    left, right = centred(models), centred(brain)
    sizes = [np.sqrt(np.einsum("bmij,bmij->bm", side, side)) for side in (left, right)]
    traces = [np.einsum("bmii->bm", side) / size for side, size in zip((left, right), sizes, strict=True)]
    flat = [
        side.reshape(*side.shape[:2], -1) / size[..., None] for side, size in zip((left, right), sizes, strict=True)
    ]
    # The mean of P L P′ over all orders of the stimuli is tr L/(K − 1) times the centring matrix.
    chance = traces[0][:, :, None] * traces[1][:, None] / (count - 1)
    return (flat[0] @ flat[1].swapaxes(-1, -2) - chance) / (1 - chance)


def draw(cell: Cell, boards: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return products of the models' layers [B, M·L, K, K] and of the animals [B, A, K, K], without trial noise."""
    shape = (boards, cell.stimuli)
    shared = rng.normal(size=(*shape, DIMENSIONS))
    models = []
    for share in cell.shares:
        # Products add up over features: w of the shared ones and 1 − w of others.
        weight = 1 / (1 + math.sqrt(1 / share**2 - 1)) if share > 0 else 0.0
        for layer in range(cell.layers):
            w = weight if layer == 0 else 0.0
            other = rng.normal(size=shared.shape)
            models.append(w * shared @ shared.swapaxes(1, 2) + (1 - w) * other @ other.swapaxes(1, 2))
    animals = []
    for _ in range(cell.animals):
        tuning = shared @ rng.normal(size=(boards, DIMENSIONS, UNITS)) / math.sqrt(DIMENSIONS)
        tuning = tuning + INDIVIDUAL * rng.normal(size=tuning.shape)
        noise = NOISE / math.sqrt(TRIALS)
        mean = tuning + noise * rng.normal(size=tuning.shape)
        animals.append(mean @ mean.swapaxes(1, 2) - UNITS * noise**2 * np.eye(cell.stimuli))
    return np.stack(models, axis=1), np.stack(animals, axis=1)


def told_apart(cell: Cell, boards: int, seed: int) -> dict[str, float]:
    """Return the share of pairs with p ≤ .05, and with a false discovery rate of 5 % over the pairs of their board."""
    rng = np.random.default_rng([seed, cell.stimuli, cell.animals, cell.layers])
    found = []
    for size in [25] * (boards // 25):
        models, brain = draw(cell, size, rng)
        shape = (size, len(cell.shares), cell.layers, cell.animals)
        values = scaled(models, brain).reshape(shape)
        chosen = choose_on_others(values)
        animals = take_layers(values, chosen)
        without = []
        for stimulus in range(cell.stimuli):
            kept = np.delete(np.arange(cell.stimuli), stimulus)
            some = scaled(models[..., kept[:, None], kept], brain[..., kept[:, None], kept]).reshape(shape)
            without.append(take_layers(some, chosen).mean(axis=-1))
        left_out = np.stack(without, axis=-1)
        first, second = np.array(list(itertools.combinations(range(len(cell.shares)), 2))).T
        error, freedom = two_factor_error(
            animals[:, first] - animals[:, second], left_out[:, first] - left_out[:, second]
        )
        mean = (animals[:, first] - animals[:, second]).mean(axis=-1)
        found.append((mean, 2 * stats.t.sf(np.abs(mean) / error, freedom)))
    mean, p = (np.concatenate(part) for part in zip(*found, strict=True))
    corrected = stats.false_discovery_control(p, axis=-1)
    return {
        "p": float((p <= 0.05).mean()),
        "told": float((corrected <= 0.05).mean()),
        "first": float(((corrected <= 0.05) & (mean > 0))[:, 0].mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--boards", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    rows = []
    for stimuli, animals in itertools.product((6, 20, 40, 60), (4, 11)):
        unrelated = told_apart(Cell(stimuli, animals, (0.0,) * 10), options.boards, options.seed)
        equal = told_apart(Cell(stimuli, animals, (0.6,) * 10), options.boards, options.seed)
        layered = told_apart(Cell(stimuli, animals, (0.0,) * 6, 8), options.boards, options.seed)
        better = told_apart(Cell(stimuli, animals, (0.9, 0.4)), options.boards, options.seed)
        deep = told_apart(Cell(stimuli, animals, (0.9, 0.4), 8), options.boards, options.seed)
        rows.append(
            [
                str(stimuli),
                str(animals),
                *(f"{item['p']:.3f} / {item['told']:.3f}" for item in (unrelated, equal, layered)),
                f"{better['first']:.3f}",
                f"{deep['first']:.3f}",
            ]
        )
        print(" | ".join(rows[-1]), flush=True)
    columns = ["stimuli", "animals", "unrelated: p ≤ .05 / told apart", "equal at .6", "unrelated, 8 layers"]
    columns += ["power, .9 against .4", "power, 8 layers"]
    if options.write:
        command = f"python -m benchmarks.scores.two_factor --boards {options.boards} --seed {options.seed} --write"
        write_section("Models told apart by animals and stimuli", command, table(columns, rows), subject="scores")


if __name__ == "__main__":
    main()
