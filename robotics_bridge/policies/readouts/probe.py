"""A probe: one rollout, every arm or placement, and their differences.

Letters: T control step, B environment, S sub-step, N taxel, F feature, D number of a target, K draw.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import stdtrit

from brainbench.core.errors import UsageError, check_each, check_number, check_once
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.progress import Progress
from robotics_bridge.envs.env import Env
from robotics_bridge.hands.layouts import PLACEMENTS, Layout, active_count
from robotics_bridge.policies.encoders.taxel_grid import FrontEnd, TaxelGraph, TaxelGrid
from robotics_bridge.policies.evaluate import Acting
from robotics_bridge.policies.readouts.features import (
    ARMS,
    TARGETS,
    Subject,
    TouchRollout,
    calibrate,
    collect,
    networks,
    traces,
)
from robotics_bridge.sensors.probes.placement import Probes, farthest_points

FOLDS = 5
FARTHEST = 10.0  # standard deviations to which features are cut
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)  # ridge penalties that are tried, per sample


@dataclass(frozen=True, eq=False)
class Readout:
    """How well targets are read from one arm on environments left out."""

    arm: str
    features: int
    """F, without the joints."""
    errors: NDArray[np.float64]
    """[K, B, D] sums of squared errors of each draw and environment; D runs over all numbers of all targets."""
    spread: NDArray[np.float64]
    """[B, D] sums of squares about the mean of the other folds."""

    def r2(self, target: str) -> float:
        """Return R², the mean of the target's three axes and of the draws."""
        return float(np.mean(self.per_draw(target)))

    def per_draw(self, target: str) -> list[float]:
        """Return R² of each draw."""
        lost, spread = self._of(target)
        return (1 - lost.sum(1) / spread.sum(0)).mean(-1).tolist()

    def _of(self, target: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        first = 3 * TARGETS.index(target)
        return self.errors[..., first : first + 3], self.spread[:, first : first + 3]

    def _without_each(self, target: str) -> NDArray[np.float64]:
        """Return R² [B] of all draws without each environment in turn."""
        errors, spread = self._of(target)
        lost = errors.mean(0)
        return (1 - (lost.sum(0) - lost) / (spread.sum(0) - spread)).mean(-1)

    def interval(self, target: str, *, less: Readout | None = None) -> tuple[float, float]:
        """Return the 95 % interval of R², or of the difference from another arm of the same rollout.

        Environments and draws are both sampled: the variances over environments (jackknife; both arms of a difference
        keep the same ones) and over the draws of each arm are added, with Welch and Satterthwaite's degrees of freedom.
        An arm of one draw is that network alone, whatever others would give.
        """
        value, left = self.r2(target), self._without_each(target)
        if less is not None:
            value, left = value - less.r2(target), left - less._without_each(target)
        count = len(left)
        parts = [((count - 1) / count * float(((left - left.mean()) ** 2).sum()), count - 1)]
        drawn = (one.per_draw(target) for one in (self, less) if one is not None and len(one.errors) > 1)
        parts += [(float(np.var(draws, ddof=1)) / len(draws), len(draws) - 1) for draws in drawn]
        total = sum(part for part, _ in parts)
        if total == 0:
            return value, value
        freedom = total**2 / sum(part**2 / own for part, own in parts)
        half = float(stdtrit(freedom, 0.975)) * math.sqrt(total)
        return value - half, value + half


def read_targets(
    proprio: torch.Tensor, features: torch.Tensor, wanted: torch.Tensor, valid: torch.Tensor
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return squared errors and squares about the mean [B, D], each environment read by the other folds."""
    x, y = torch.cat((proprio, features.to(proprio.device)), -1).float(), wanted.float()
    count = x.shape[1]
    fold = torch.arange(count, device=y.device) % FOLDS
    errors, spread = (torch.zeros(count, y.shape[-1], dtype=torch.float64, device=y.device) for _ in range(2))
    for number in range(FOLDS):
        train = fold != number
        # The penalty is chosen on one more fold of the others: what is left out has no say in it.
        inner = train & (fold != (number + 1) % FOLDS)
        tried = _ridge(x[:, inner], y[:, inner], valid[:, inner])
        aside = train & ~inner
        scores = torch.stack([_squares(tried(x[:, aside], p), y[:, aside], valid[:, aside]).sum(0) for p in PENALTIES])
        best = scores.argmin(0)
        final = _ridge(x[:, train], y[:, train], valid[:, train])
        out = fold == number
        guess = torch.stack([final(x[:, out], p) for p in PENALTIES], -1)
        guess = guess.gather(-1, best.expand(*guess.shape[:-1])[..., None]).squeeze(-1)
        mean = y[:, train][valid[:, train]].mean(0)
        errors[out] = _squares(guess, y[:, out], valid[:, out])
        spread[out] = _squares(mean.expand_as(guess), y[:, out], valid[:, out])
    return errors.cpu().numpy(), spread.cpu().numpy()


def _squares(guess: torch.Tensor, y: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
    return torch.where(valid[..., None], (guess - y).square(), 0.0).double().sum(0)


def _ridge(x: torch.Tensor, y: torch.Tensor, valid: torch.Tensor) -> Callable[[torch.Tensor, float], torch.Tensor]:
    """Return the regression [.., F], penalty → [.., D] on standardised features; constant features are left out."""
    rows, aim = x[valid], y[valid]
    mean, scale, centre = rows.mean(0), rows.std(0), aim.mean(0)
    used = scale > 1e-7 * scale.max().clamp(min=1e-30)

    def _standard(values: torch.Tensor) -> torch.Tensor:
        # A taxel that was hardly ever touched would otherwise throw a prediction where it is.
        return ((values[..., used] - mean[used]) / scale[used]).clamp(-FARTHEST, FARTHEST)

    z = _standard(rows)
    gram, products = z.T @ z / len(z), z.T @ (aim - centre) / len(z)
    solved: dict[float, torch.Tensor] = {}

    def _predict(values: torch.Tensor, penalty: float) -> torch.Tensor:
        if penalty not in solved:
            ridge = gram + penalty * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
            solved[penalty] = torch.cholesky_solve(products, torch.linalg.cholesky(ridge))
        return _standard(values) @ solved[penalty] + centre

    return _predict


HALVES = 2  # parts of the environments; what is chosen on the others is read on each
_INNER = 4  # folds of the environments on which a choice is made
_PENALTY = 1.0  # ridge penalty of the choice, per sample


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
            counted = valid[:, mine]
            z = ((x[:, mine][counted] - mean) / torch.where(used, scale, 1.0)).clamp(-FARTHEST, FARTHEST) * used
            y = (wanted[:, mine][counted] - centre) / size
            moments.append([part.double() / len(z) for part in (z.T @ z, z.T @ y, y.square().sum(0))])
        (self._gram, self._product, _), (self._test_gram, self._test_product, self._error) = moments
        self._gram.diagonal().add_(_PENALTY)
        self._spread = self._error.clone()

    def take(self, block: slice) -> None:
        """Put a block of features into the regression."""
        factor = torch.linalg.cholesky(_regular(self._gram[block, block]))
        explained = torch.cholesky_solve(self._gram[block], factor)  # B: features of the block → all features
        weights = torch.cholesky_solve(self._product[block], factor)
        # Schur complement on the learning side; x − x_S B and y − x_S w on the test side.
        column = self._gram[:, block].clone()
        self._product -= column @ weights
        self._gram.addmm_(column, explained, alpha=-1)
        inner, across = self._test_gram[block, block].clone(), self._test_gram[:, block].clone()
        self._error += (weights * (inner @ weights)).sum(0) - 2 * (weights * self._test_product[block]).sum(0)
        self._test_product -= across @ weights + explained.T @ (self._test_product[block] - inner @ weights)
        self._test_gram.addmm_(across, explained, alpha=-1).addmm_(explained.T, across.T - inner @ explained, alpha=-1)

    def gains(self, first: int, taxels: int, width: int) -> torch.Tensor:
        """Return by how much each taxel [N] would raise R² on the test environments."""
        blocks, own_test = (_blocks(gram[first:, first:], taxels, width) for gram in (self._gram, self._test_gram))
        product, test = (m[first:].unflatten(0, (taxels, width)) for m in (self._product, self._test_product))
        weights = torch.linalg.solve(_regular(blocks), product)
        lost = (weights * (own_test @ weights)).sum(1) - 2 * (weights * test).sum(1)
        return -(lost / self._spread).mean(1)


def _regular(blocks: torch.Tensor) -> torch.Tensor:
    """Return moments [..., F, F] that can be solved: of what is explained already only rounding is left."""
    return blocks + 1e-9 * torch.eye(blocks.shape[-1], dtype=blocks.dtype)


def _blocks(gram: torch.Tensor, taxels: int, width: int) -> torch.Tensor:
    """Return the blocks [N, F, F] on the diagonal of a matrix [N·F, N·F]."""
    return gram.unflatten(0, (taxels, width)).unflatten(2, (taxels, width)).diagonal(dim1=0, dim2=2).movedim(-1, 0)


def check_count(layout: Mapping[str, Probes], count: int) -> None:
    """Raise UsageError unless so many taxels can be chosen of a layout."""
    check_number("The number of taxels to choose of this hand", count, least=1, most=active_count(layout), whole=True)


def even_taxels(layout: Mapping[str, Probes], count: int) -> list[int]:
    """Return taxels spread over a hand: of every link its share of the count, of a link those farthest apart."""
    sizes = np.array([int(probes.active.sum()) for probes in layout.values()])
    # Largest remainders: shares are whole and add up.
    share = count * sizes / sizes.sum()
    whole = np.floor(share).astype(int)
    whole[np.argsort(whole - share, kind="stable")[: count - whole.sum()]] += 1
    taxels: list[int] = []
    for first, number, probes in zip(np.cumsum(sizes) - sizes, whole, layout.values(), strict=True):
        points = probes.position[probes.active]
        if number:
            middle = int(np.linalg.norm(points - points.mean(0), axis=1).argmin())
            taxels += [int(first) + one for one in farthest_points(points, number, middle)]
    return taxels


def part_of_layout(layout: Mapping[str, Probes], taxels: Iterable[int]) -> dict[str, Probes]:
    """Return a layout with these taxels alone, for :func:`robotics_bridge.hands.layouts.write_probes`."""
    wanted, first, part = set(taxels), 0, {}
    for link, probes in layout.items():
        active = np.flatnonzero(probes.active)
        cells = [cell for index, cell in enumerate(active) if first + index in wanted]
        if cells:
            radius = np.zeros_like(probes.radius)
            radius[cells] = probes.radius[cells]
            part[link] = Probes(probes.position, probes.normal, radius, probes.shape)
        first += len(active)
    return part


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
    :func:`~robotics_bridge.policies.readouts.probe.read_targets`, whose folds lie within the half.

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
    placed = []
    for name, read in parts.items():
        errors = np.stack([np.concatenate([one[0] for one in draw]) for draw in zip(*read, strict=True)])
        spread = np.concatenate([part[0][1] for part in read])
        sets = tuple(map(tuple, fixed[name])) if name in fixed else tuple(chosen)
        placed.append(Placed(name, Readout(name, len(sets[0]) * features.shape[-1], errors, spread), sets))
    return placed


@limited(of="{} of a probe", kw_only=True)
class ProbeOptions:
    """Extent of a probe."""

    seconds: Annotated[float, Limit(least=0.5, most=600, unit="s")] = 5.0
    """Simulated time per environment."""
    reservoirs: Count = 3
    """Random reservoirs that are drawn."""
    untrained: Count = 5
    """Initial states of the untrained network."""
    seed: int = 0
    """Seed of the episodes, of the reservoirs and of random placements."""
    arms: tuple[str, ...] = ()
    """Arms of :data:`ARMS`, once for each; all by default."""
    networks: tuple[str, ...] = ()
    """More networks, each an arm of its name, once for each: models of the registry, ``local-dir:FOLDER``."""
    place: int | None = None
    """Choose so many taxels, and compare them with all and with others, in place of the arms."""
    draws: Count = 10
    """Random placements of so many taxels."""

    def __post_init__(self) -> None:
        check_each("arm of a probe", self.arms, ARMS)
        check_once("networks of a probe", self.networks)
        if self.place is not None and (self.arms or self.networks):
            raise UsageError("A probe either compares arms or places taxels; received both.")


def check_environments(env: Env, parts: int = 1) -> int:
    """Return the fewest environments of a probe in so many parts; raise UsageError if there are fewer."""
    least = 2 * FOLDS * parts
    check_number("The number of environments of a probe", env.num_envs, least=least, whole=True)
    return least


def roll_out(env: Env, policy: Acting, options: ProbeOptions, parts: int = 1) -> TouchRollout:
    """Roll a policy out once; what is read is known wherever ``valid`` is."""
    least = check_environments(env, parts)
    rollout = collect(env, policy, options.seconds)
    valid = rollout.valid & ~rollout.wanted.isnan().any(-1)
    if int((valid.sum(0) > 0).sum()) < least:
        raise UsageError("The object is touched in too few environments; take a policy that holds it, or more of them.")
    return replace(rollout, valid=valid)


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
    readouts = []
    for index, name in enumerate(names):
        say(index + 1, len(names) + 1, f"reading {name}")
        features = ARMS[name](subject) if name in ARMS else networks("native", name, subject)
        solved = [read_targets(rollout.proprio, draw, rollout.wanted, rollout.valid) for draw in features]
        errors = np.stack([one for one, _ in solved])
        readouts.append(Readout(name, features[0].shape[-1], errors, solved[0][1]))
    return readouts


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
    placements = {name: np.flatnonzero(np.isin(owner, env.hand.links(name))).tolist() for name in PLACEMENTS}
    others = {name: taxels for name, taxels in placements.items() if 0 < len(taxels) < len(owner)}
    placed = read_placements(
        rollout, layout, count, others=others, draws=options.draws, seed=options.seed, progress=progress
    )
    say(1, 1, "choosing taxels on all environments")
    features = taxel_features(rollout)
    best = choose_taxels(rollout.proprio, features, rollout.wanted, rollout.valid, count)
    return placed, part_of_layout(layout, best)


CONTRASTS = (
    ("simclr", "untrained"), ("supervised", "untrained"), ("simclr", "reservoir"), ("supervised", "reservoir"),
    ("simclr, 45 ms", "untrained, 45 ms"), ("supervised, 45 ms", "untrained, 45 ms"), ("reservoir", "none, memory"),
    ("simclr", "taxels, memory"), ("simclr", "bits, memory"), ("grid, posture, memory", "grid, memory"),
    ("reservoir, posture", "reservoir"), ("simclr, posture", "simclr"),
    ("graph, memory", "grid, memory"), ("reservoir, graph", "reservoir"),
)  # fmt: skip
"""Arms that are compared."""


def plain(readout: Readout, less: Readout | None = None) -> dict[str, Any]:
    """Return R² of an arm with its interval by target as plain numbers, or its difference from another arm."""
    facts: dict[str, Any] = {"arm": readout.arm}
    facts |= {"features": readout.features, "draws": len(readout.errors)} if less is None else {"less": less.arm}
    for name in TARGETS:
        low, high = readout.interval(name, less=less)
        value = readout.r2(name) - (0.0 if less is None else less.r2(name))
        facts[name] = {"r2": value, "low": low, "high": high}
        if less is None:
            facts[name]["per_draw"] = readout.per_draw(name)
    return facts


def differences(readouts: Sequence[Readout]) -> list[dict[str, Any]]:
    """Return the differences of :data:`CONTRASTS` whose arms are there, and of other networks from the reservoir."""
    by_name = {one.arm: one for one in readouts}
    pairs = [*CONTRASTS, *((name, "reservoir") for name in by_name if name not in ARMS)]
    return [plain(by_name[a], by_name[b]) for a, b in pairs if a in by_name and b in by_name]


def placements(placed: Sequence[Placed]) -> dict[str, Any]:
    """Return placements and their differences from all taxels as plain numbers."""
    every = next(one for one in placed if one.name == "all")
    rows = [plain(one.readout) | {"taxels": len(one.taxels[0]), "indices": one.taxels} for one in placed]
    return {"arms": rows, "differences": [plain(one.readout, every.readout) for one in placed if one is not every]}
