"""A probe: one rollout, every arm, and the differences between arms.

Letters: T control step, B environment, S sub-step, N taxel, F feature, D number of a target, K draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from brainbench.core.errors import UsageError, check_name
from brainbench.core.progress import Progress
from robotics_bridge.envs.env import Env
from robotics_bridge.policies.encoders.calibration import HandCalibration
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.evaluate import Acting
from robotics_bridge.policies.readouts.arms import ARMS, Subject
from robotics_bridge.policies.readouts.regression import FOLDS, Readout, read_targets
from robotics_bridge.policies.readouts.rollout import TARGETS, collect


@dataclass(frozen=True, kw_only=True)
class ProbeOptions:
    """Extent of a probe; UsageError for a number out of range."""

    seconds: float = 5.0
    """Simulated time per environment."""
    reservoirs: int = 3
    """Random reservoirs that are drawn."""
    untrained: int = 5
    """Initial states of the untrained network."""
    seed: int = 0
    """Seed of the bootstrap and of the reservoirs."""
    arms: tuple[str, ...] = ()
    """Arms of :data:`ARMS`; all by default."""

    def __post_init__(self) -> None:
        for name in self.arms:
            check_name("arm of a probe", name, ARMS)
        if not (0.5 <= self.seconds <= 600 and self.reservoirs >= 1 and self.untrained >= 1):
            raise UsageError(
                "A probe takes 0.5 to 600 seconds and at least one draw of each random arm; received "
                f"{self.seconds:g} s, {self.reservoirs} reservoirs and {self.untrained} untrained networks."
            )


@torch.no_grad()
def probe(env: Env, policy: Acting, options: ProbeOptions, progress: Progress | None = None) -> list[Readout]:
    """Roll a policy out once and read the targets from every arm.

    Raises:
        UsageError: the environment does not fit, or fewer environments than :data:`FOLDS` touch the object.
        DataError: nothing is touched.
    """
    if env.num_envs < 2 * FOLDS:
        raise UsageError(f"A probe needs at least {2 * FOLDS} environments; received {env.num_envs}.")
    say = progress or (lambda done, total, what: None)
    names = options.arms or tuple(ARMS)
    say(0, len(names) + 1, "rolling out")
    rollout = collect(env, policy, options.seconds)
    touch, kind = env.options, env.hand.layout(env.options.resolution, env.options.placement)
    grid = TaxelGrid(env.hand, placement=touch.placement, resolution=touch.resolution).to(env.device)
    calibration = HandCalibration.fit(grid(rollout.taxels.flatten(0, 1)).cpu())
    links = tuple(int(probes.active.sum()) for probes in kind.values())
    subject = Subject(rollout, grid, calibration, links, options.reservoirs, options.untrained, options.seed)
    wanted = torch.cat([rollout.targets[name] for name in TARGETS], -1)
    valid = rollout.valid & ~wanted.isnan().any(-1)
    if int((valid.sum(0) > 0).sum()) < 2 * FOLDS:
        raise UsageError("The object is touched in too few environments; take a policy that holds it, or more of them.")
    found = []
    for index, name in enumerate(names):
        say(index + 1, len(names) + 1, f"reading {name}")
        draws = ARMS[name](subject)
        solved = [read_targets(rollout.proprio, draw, wanted, valid) for draw in draws]
        found.append(Readout(name, draws[0].shape[-1], np.stack([one for one, _ in solved]), solved[0][1]))
    return found


CONTRASTS = (
    ("simclr", "untrained"), ("supervised", "untrained"), ("simclr", "reservoir"), ("supervised", "reservoir"),
    ("simclr, 45 ms", "untrained, 45 ms"), ("supervised, 45 ms", "untrained, 45 ms"), ("reservoir", "none, memory"),
    ("simclr", "taxels, memory"), ("simclr", "bits, memory"),
)  # fmt: skip
"""Arms that are compared."""


def plain(one: Readout, less: Readout | None = None) -> dict[str, Any]:
    """Return R² of an arm with its interval by target as plain numbers, or its difference from another arm."""
    facts: dict[str, Any] = {"arm": one.arm}
    facts |= {"features": one.features, "draws": len(one.errors)} if less is None else {"less": less.arm}
    for name in TARGETS:
        low, high = one.interval(name, less=less)
        value = one.r2(name) - (0.0 if less is None else less.r2(name))
        facts[name] = {"r2": value, "low": low, "high": high}
        if less is None:
            facts[name]["per_draw"] = one.per_draw(name)
    return facts


def differences(readouts: Sequence[Readout]) -> list[dict[str, Any]]:
    """Return the differences of :data:`CONTRASTS` whose two arms are there."""
    by_name = {one.arm: one for one in readouts}
    return [plain(by_name[a], by_name[b]) for a, b in CONTRASTS if a in by_name and b in by_name]
