"""How often intervals of differences hold the truth, with as few networks and policy seeds as we can train.

    python -m benchmarks.policies.coverage [--simulations 1000] [--write]

Success of policies is drawn from the mixed model of :mod:`robotics_bridge.policies.contrasts`, whose arms all succeed
equally often: an interval of a difference should hold 0 in 95 % of the simulations, and no arm should be said to help.
Beside it the pooled t interval over policy seeds, which takes seeds of one network for independent networks.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from scipy.special import stdtrit

from benchmarks.report import publish, script_parser, table
from robotics_bridge.policies.contrasts import MixedModel, TrainedPolicy

SEED_SPREAD = 0.03
"""Standard deviation of success within a network (.018 between seeds of our students)."""
Design = dict[str, list[tuple[int | None, int]]]
"""Arm → its policies as (draw, seed)."""
ONCE: list[tuple[int | None, int]] = [(None, seed) for seed in range(5)]
CROSSED: list[tuple[int | None, int]] = list(itertools.product(range(3), range(5)))
PAIRED: list[tuple[int | None, int]] = [(seed, seed) for seed in range(5)]
DESIGNS: dict[str, tuple[Design, tuple[tuple[str, str], ...]]] = {
    "the comparison: 3 × 5 trained and reservoirs, 5 × 1 untrained, 5 seeds without draws": (
        {"none": ONCE, "bits": ONCE, "force": ONCE, "reservoir": CROSSED, "untrained": PAIRED, "simclr": CROSSED,
         "supervised": CROSSED},
        (("simclr", "reservoir"), ("simclr", "untrained"), ("simclr", "none"), ("none", "bits")),
    ),
    "two arms alone: 3 × 5 and 3 × 5": ({"reservoir": CROSSED, "simclr": CROSSED}, (("simclr", "reservoir"),)),
    "one policy a draw: 5 × 1 each, trained 3 in turn": (
        {"none": ONCE, "reservoir": PAIRED, "untrained": PAIRED, "simclr": [(seed % 3, seed) for seed in range(5)]},
        (("simclr", "reservoir"), ("untrained", "reservoir"), ("simclr", "none")),
    ),
}  # fmt: skip
SPREADS = ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (1.0, 0.7, 0.7), (0.0, 1.0, 0.0))
"""Standard deviations of draw, seed(arm) and seed, in units of the residual's."""


def simulate(design: Design, spread: tuple[float, ...], rng: np.random.Generator) -> MixedModel:
    """Return policies of arms that succeed equally often."""
    residual, (draw, own, shared) = SEED_SPREAD, (SEED_SPREAD * part for part in spread)
    seeds, found = rng.normal(0, shared, 5), []
    for arm, cells in design.items():
        draws, seeds_of_arm = rng.normal(0, draw, 5), rng.normal(0, own, 5)
        for number, seed in cells:
            value = 0.5 + seeds[seed] + seeds_of_arm[seed] + rng.normal(0, residual)
            found.append(TrainedPolicy(arm, value + (0.0 if number is None else draws[number]), seed, number))
    return MixedModel(tuple(found))


def pooled(model: MixedModel, one: str, other: str) -> bool:
    """Return whether the pooled t interval over all policies of two arms holds 0."""
    groups = {arm: [p.success for p in model.policies if p.arm == arm] for arm in model.arms}
    freedom = sum(len(group) - 1 for group in groups.values())
    spread = math.sqrt(sum(float(np.var(group)) * len(group) for group in groups.values()) / freedom)
    error = spread * math.sqrt(1 / len(groups[one]) + 1 / len(groups[other]))
    return abs(np.mean(groups[one]) - np.mean(groups[other])) <= stdtrit(freedom, 0.975) * error


def measure(simulations: int) -> list[list[str]]:
    """Return one row for each design, spread and pair."""
    rows: list[list[str]] = []
    for (name, (design, pairs)), spread in itertools.product(DESIGNS.items(), SPREADS):
        rng, helped = np.random.default_rng(0), 0
        held: dict[Any, list[tuple[bool, bool, float]]] = {pair: [] for pair in pairs}
        for _ in range(simulations):
            model = simulate(design, spread, rng)
            random = [arm for arm in ("reservoir", "untrained") if arm in design]
            helped += model.judge("simclr", random).helps
            for pair in pairs:
                interval = model.contrast(*pair).interval
                assert interval is not None
                inside = interval.low <= 0 <= interval.high
                held[pair].append((inside, pooled(model, *pair), interval.high - interval.low))
        for pair, found in held.items():
            inside, naive, width = np.mean(found, axis=0)
            ratio = " / ".join(f"{part:g}" for part in spread)
            claim = f"{helped / simulations:.3f}" if pair[0] == "simclr" and pair[1] in random else "–"
            rows.append([name, ratio, " – ".join(pair), f"{inside:.3f}", f"{naive:.3f}", f"{width / 2:.3f}", claim])
            print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--simulations", type=int, default=1000)
    options = parser.parse_args()
    rows = measure(options.simulations)
    heads = ["design", "draw / seed(arm) / seed, of the residual", "difference", "held by the mixed model",
             "by pooled t", "half width", "said to help"]  # fmt: skip
    share = [float(row[3]) for row in rows]
    low = math.sqrt(0.95 * 0.05 / options.simulations)
    body = (
        f"{options.simulations:,} simulations a row, no arm better than another; residual {SEED_SPREAD:g}. Intervals "
        f"of 95 % hold 0 in {min(share):.3f} to {max(share):.3f} (chance of the simulations: ± {1.96 * low:.3f}). "
        "“Said to help”: by .05 over the best random arm and the interval above 0.\n\n" + table(heads, rows)
    )
    publish(options, "Intervals of students with random networks", body, f"--simulations {options.simulations}")


if __name__ == "__main__":
    main()
