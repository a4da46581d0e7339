"""A probe: one rollout, every arm or placement, and their differences.

Letters: T control step, B environment, S sub-step, N taxel, F feature, D number of a target, K draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from brainbench.core.errors import UsageError, check_each, check_once
from brainbench.core.progress import Progress
from robotics_bridge.envs.env import Env
from robotics_bridge.hands.layouts import PLACEMENTS, Layout
from robotics_bridge.policies.encoders.front_end import FrontEnd
from robotics_bridge.policies.encoders.taxel_graph import TaxelGraph
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.evaluate import Acting
from robotics_bridge.policies.readouts.arms import ARMS, Features, Subject, networks
from robotics_bridge.policies.readouts.placement import (
    HALVES,
    Placed,
    check_count,
    choose_taxels,
    part_of_layout,
    read_placements,
    taxel_features,
)
from robotics_bridge.policies.readouts.regression import FOLDS, Readout, read_targets
from robotics_bridge.policies.readouts.rollout import TARGETS, TouchRollout, calibrate, collect


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
    """Seed of the episodes, of the reservoirs and of random placements."""
    arms: tuple[str, ...] = ()
    """Arms of :data:`ARMS`; all by default."""
    networks: tuple[str, ...] = ()
    """More networks, each an arm of its name: models of the registry, ``local-dir:FOLDER``."""
    place: int | None = None
    """Choose so many taxels, and compare them with all and with others, in place of the arms."""
    draws: int = 10
    """Random placements of so many taxels."""

    def __post_init__(self) -> None:
        check_each("arm of a probe", self.arms, ARMS)
        check_once("networks of a probe", self.networks)
        if self.place is not None and (self.arms or self.networks):
            raise UsageError("A probe either compares arms or places taxels; received both.")
        if not (0.5 <= self.seconds <= 600 and min(self.reservoirs, self.untrained, self.draws) >= 1):
            raise UsageError(
                "A probe takes 0.5 to 600 seconds and at least one draw of what is random; received "
                f"{self.seconds:g} s, {self.reservoirs} reservoirs, {self.untrained} untrained networks and "
                f"{self.draws} placements."
            )


def check_environments(env: Env, parts: int = 1) -> int:
    """Return the fewest environments of a probe in so many parts; raise UsageError if there are fewer."""
    least = 2 * FOLDS * parts
    if env.num_envs < least:
        raise UsageError(f"A probe needs at least {least} environments; received {env.num_envs}.")
    return least


def roll_out(env: Env, policy: Acting, options: ProbeOptions, parts: int = 1) -> TouchRollout:
    """Roll a policy out once; what is read is known wherever ``valid`` is."""
    least = check_environments(env, parts)
    found = collect(env, policy, options.seconds)
    valid = found.valid & ~found.wanted.isnan().any(-1)
    if int((valid.sum(0) > 0).sum()) < least:
        raise UsageError("The object is touched in too few environments; take a policy that holds it, or more of them.")
    return replace(found, valid=valid)


@torch.no_grad()
def probe(env: Env, policy: Acting, options: ProbeOptions, progress: Progress | None = None) -> list[Readout]:
    """Roll a policy out once and read the targets from every arm."""
    check_environments(env)
    say = progress or (lambda done, total, what: None)
    names = (*(options.arms or ARMS), *options.networks)
    say(0, len(names) + 1, "rolling out")
    touch, layout = env.options, env.hand.layout(env.options.resolution, env.options.placement)
    grid = TaxelGrid(env.hand, placement=touch.placement, resolution=touch.resolution).to(env.device)
    for name in options.networks:
        FrontEnd(name, grid)  # refuses what no policy can step, before anything is slow
    calibration = calibrate(env, policy, grid, options.seed)
    rollout = roll_out(env, policy, options)
    links = tuple(int(probes.active.sum()) for probes in layout.values())
    draws = (options.reservoirs, options.untrained, options.seed)
    subject = Subject(rollout, grid, TaxelGraph(layout), calibration, links, *draws)
    found = []
    for index, name in enumerate(names):
        say(index + 1, len(names) + 1, f"reading {name}")
        features = ARMS[name](subject) if name in ARMS else networks("native", name, subject)
        found.append(read_arm(name, rollout, features))
    return found


def read_arm(name: str, rollout: TouchRollout, draws: Sequence[Features]) -> Readout:
    """Return what is read from an arm's features, once for each draw."""
    solved = [read_targets(rollout.proprio, draw, rollout.wanted, rollout.valid) for draw in draws]
    return Readout(name, draws[0].shape[-1], np.stack([one for one, _ in solved]), solved[0][1])


@torch.no_grad()
def place(
    env: Env, policy: Acting, options: ProbeOptions, progress: Progress | None = None
) -> tuple[list[Placed], Layout]:
    """Roll a policy out once, read the targets from placements of taxels, and return the layout chosen on all of it.

    Beside all, chosen, random and evenly spread taxels stand the hand's own placements (fingers, tips, palm).
    """
    count, layout = options.place, env.hand.layout(env.options.resolution, env.options.placement)
    if count is None:
        raise UsageError("Say how many taxels are to be placed.")
    check_count(layout, count)
    say = progress or (lambda done, total, what: None)
    say(0, 1, "rolling out")
    rollout = roll_out(env, policy, options, HALVES)
    owner = np.repeat(list(layout), [int(probes.active.sum()) for probes in layout.values()])
    own = {name: np.flatnonzero(np.isin(owner, env.hand.links(name))).tolist() for name in PLACEMENTS}
    others = {name: taxels for name, taxels in own.items() if 0 < len(taxels) < len(owner)}
    found = read_placements(
        rollout, layout, count, others=others, draws=options.draws, seed=options.seed, progress=progress
    )
    say(1, 1, "choosing taxels on all environments")
    features = taxel_features(rollout)
    best = choose_taxels(rollout.proprio, features, rollout.wanted, rollout.valid, count)
    return found, part_of_layout(layout, best)


CONTRASTS = (
    ("simclr", "untrained"), ("supervised", "untrained"), ("simclr", "reservoir"), ("supervised", "reservoir"),
    ("simclr, 45 ms", "untrained, 45 ms"), ("supervised, 45 ms", "untrained, 45 ms"), ("reservoir", "none, memory"),
    ("simclr", "taxels, memory"), ("simclr", "bits, memory"), ("grid, posture, memory", "grid, memory"),
    ("reservoir, posture", "reservoir"), ("simclr, posture", "simclr"),
    ("graph, memory", "grid, memory"), ("reservoir, graph", "reservoir"),
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
    """Return the differences of :data:`CONTRASTS` whose arms are there, and of other networks from the reservoir."""
    by_name = {one.arm: one for one in readouts}
    pairs = [*CONTRASTS, *((name, "reservoir") for name in by_name if name not in ARMS)]
    return [plain(by_name[a], by_name[b]) for a, b in pairs if a in by_name and b in by_name]


def placements(found: Sequence[Placed]) -> dict[str, Any]:
    """Return placements and their differences from all taxels as plain numbers."""
    every = next(one for one in found if one.name == "all")
    rows = [plain(one.readout) | {"taxels": len(one.taxels[0]), "indices": one.taxels} for one in found]
    return {"arms": rows, "differences": [plain(one.readout, every.readout) for one in found if one is not every]}
