"""What can be read linearly from the features of a tactile encoder: ridge regression on environments left out.

One rollout of a policy serves every arm, so all see the same touch. An arm has the joints (``proprio``) and features of
its own, each standardised; targets are the object's position, velocity, spin and the centre of its contacts, in world
axes (the palm is fixed). Environments are split into folds: a fold is predicted by a regression on the others, whose
penalty is chosen among these alone. Letters: T control step, B environment, S sub-step, N taxel, F feature, D number of
a target, K draw.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import UsageError, check_name
from brainbench.core.progress import Progress
from robotics_bridge.envs.env import Env
from robotics_bridge.hands.observations import TAXELS_IN_CONTACT
from robotics_bridge.policies.encoders.calibration import HandCalibration
from robotics_bridge.policies.encoders.front_end import FrontEnd
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.evaluate import Acting

NETWORK = "zhuang-intersection-ln-small"
"""Network of the arms ``untrained``, ``simclr`` and ``supervised``."""
TARGETS = ("position", "velocity", "spin", "contact")
"""Object (m, m/s, rad/s), and the centre of the contact forces on it (m), [3] each."""
FOLDS = 5
PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
"""Ridge penalties that are tried, per sample."""
_SETTLING = 10
"""Control steps after an episode's start that are left out: the object falls onto the palm."""
_TRACES = (0.5, 0.9)
"""Share that traces of the short memory keep in a control step (time constants of 36 and 237 ms at 40 Hz)."""
_DRAWS = 2000
"""Bootstrap draws of an interval."""


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


@dataclass(frozen=True, eq=False)
class Rollout:
    """What a policy did and felt."""

    proprio: torch.Tensor
    """[T, B, n]."""
    taxels: torch.Tensor
    """[T, B, S, N, 6] (N, N·m)."""
    begun: torch.Tensor
    """[T, B] bool: first step of an episode."""
    targets: Mapping[str, torch.Tensor]
    """Name → [T, B, 3]; NaN where undefined."""
    valid: torch.Tensor
    """[T, B] bool: past the settling of its episode."""


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
        return float(self._r2(target, np.arange(len(self.errors)), np.arange(self.spread.shape[0])))

    def per_draw(self, target: str) -> list[float]:
        """Return R² of each draw."""
        every = np.arange(self.spread.shape[0])
        return [float(self._r2(target, np.array([draw]), every)) for draw in range(len(self.errors))]

    def _r2(self, target: str, draws: NDArray[np.int64], rows: NDArray[np.int64]) -> float:
        first = 3 * TARGETS.index(target)
        columns = slice(first, first + 3)
        lost = self.errors[draws][:, rows, columns].sum(axis=1)
        return float((1 - lost / self.spread[rows, columns].sum(axis=0)).mean())

    def interval(self, target: str, *, less: Readout | None = None, seed: int = 0) -> tuple[float, float]:
        """Return the 95 % interval of R², or of the difference from another arm of the same rollout.

        Bootstrap over environments and draws; both arms of a difference keep the same environments.
        """
        rng, found = np.random.default_rng(seed), []
        for _ in range(_DRAWS):
            rows = rng.integers(self.spread.shape[0], size=self.spread.shape[0])
            value = self._r2(target, rng.integers(len(self.errors), size=len(self.errors)), rows)
            if less is not None:
                value -= less._r2(target, rng.integers(len(less.errors), size=len(less.errors)), rows)
            found.append(value)
        low, high = np.quantile(found, (0.025, 0.975))
        return float(low), float(high)


@torch.no_grad()
def collect(env: Env, policy: Acting, seconds: float) -> Rollout:
    """Run a policy and return what it felt, and what is to be read from it.

    Raises:
        UsageError: the environment has no force and torque on its taxels.
    """
    if env.options.observe != "force_torque" or env.touch is None:
        raise UsageError("A probe reads force and torque: make the environment with observe='force_torque'.")
    # Episodes begin at different times, so that no step holds only beginnings.
    observations = env.reset()
    age = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
    kept: dict[str, list[torch.Tensor]] = {}
    for _ in range(round(seconds / env.step_dt)):
        velocity, spin = env.state.target_velocity
        row = {"proprio": observations["proprio"], "taxels": observations["tactile"], "begun": age == 0}
        row |= {"position": env.state.target_pose[:, :3], "velocity": velocity, "spin": spin}
        row |= {"contact": _centre(env, age), "valid": age >= _SETTLING}
        for name, value in row.items():
            kept.setdefault(name, []).append(value.clone())
        observations, _, terminated, truncated, _ = env.step(policy(observations))
        done = terminated | truncated
        if (forget := getattr(policy, "reset", None)) is not None:
            forget(done)
        age = torch.where(done, 0, age + 1)
    stacked = {name: torch.stack(rows) for name, rows in kept.items()}
    targets = {name: stacked.pop(name) for name in TARGETS}
    return Rollout(targets=targets, **stacked)


def _centre(env: Env, age: torch.Tensor) -> torch.Tensor:
    """Return the centre [B, 3] of the contact forces on the object in the last physics step, NaN without contact."""
    state, scene = env.simulation.state, env.simulation.engine.scene
    count = min(int(state.contact_count.numpy()[0]), state.contact_env.shape[0])
    names = ("env", "geom", "position", "force")
    row, geometries, position, force = (getattr(state, f"contact_{name}").numpy()[:count] for name in names)
    link = scene.link_index(env.state.model.objects[0])
    mine = (np.asarray(scene.link_of)[geometries] == link).any(axis=1) & (force > 0)
    sums, total = np.zeros((env.num_envs, 3)), np.zeros(env.num_envs)
    np.add.at(sums, row[mine], position[mine] * force[mine, None])
    np.add.at(total, row[mine], force[mine])
    with np.errstate(invalid="ignore"):
        centre = torch.as_tensor(sums / np.where(total > 0, total, np.nan)[:, None], dtype=torch.float32)
    # What an ended episode touched last is no contact of the next one.
    return torch.where((age == 0)[:, None], torch.nan, centre.to(age.device))


Features = torch.Tensor
"""[T, B, F]."""


def _traces(x: torch.Tensor, begun: torch.Tensor) -> Features:
    """Return values [T, B, F] and leaky averages of their past, which episodes begin without."""
    state = x.new_zeros(len(_TRACES), *x.shape[1:])
    keep, found = x.new_tensor(_TRACES)[:, None, None], []
    for now, first in zip(x, begun, strict=True):
        state = keep * torch.where(first[:, None], 0.0, state) + (1 - keep) * now
        found.append(torch.cat((now, *state), -1))
    return torch.stack(found)


def _raw(rollout: Rollout) -> Features:
    return rollout.taxels.mean(2).flatten(2)


def _force(rollout: Rollout) -> Features:
    return rollout.taxels[..., :3].mean(2).flatten(2)


def _bits(rollout: Rollout, links: Sequence[int]) -> Features:
    """Return one bit per link and sub-step: more than two taxels touch (table 4.6)."""
    touch = (rollout.taxels != 0).any(-1).float()
    parts = [part.sum(-1) > TAXELS_IN_CONTACT for part in touch.split(list(links), dim=-1)]
    return torch.stack(parts, -1).float().flatten(2)


def _network(rollout: Rollout, grid: TaxelGrid, calibration: HandCalibration, **options: Any) -> Features:
    """Return the features of a network that steps through the rollout, its memory forgotten where episodes begin."""
    time = options.pop("time", "native")
    front = FrontEnd(
        options.pop("model"), grid, time=time, calibration=calibration, options={"unroll": "full"}, **options
    ).to(rollout.taxels.device)
    state, found = front.init_state(rollout.taxels.shape[1]), []
    for reading, first in zip(rollout.taxels, rollout.begun, strict=True):
        features, state = front(reading, torch.where(first[:, None], 0.0, state))
        found.append(features)
    return torch.stack(found)


def _reservoir(rollout: Rollout, grid: TaxelGrid, calibration: HandCalibration, *, units: int, seed: int) -> Features:
    """Return the state of a random recurrent network on the same grid (echo state: leak .5, spectral radius .9)."""
    generator = torch.Generator().manual_seed(seed)
    slots = rollout.taxels.shape[2]
    unit = [calibration.force if name.startswith("F") else calibration.moment for name in CHANNELS] * slots
    felt = grid(rollout.taxels.flatten(0, 1)).cpu() / torch.tensor(unit).view(-1, 1, 1)
    felt = felt.flatten(1)
    drive = felt @ torch.randn(felt.shape[1], units, generator=generator)
    drive = (drive / drive.square().mean().sqrt().clamp(min=1e-12)).unflatten(0, rollout.taxels.shape[:2])
    inner = torch.randn(units, units, generator=generator)
    inner *= 0.9 / torch.linalg.eigvals(inner).abs().max()
    offset = 0.1 * torch.randn(units, generator=generator)
    state, found = drive.new_zeros(drive.shape[1], units), []
    for now, first in zip(drive, rollout.begun.cpu(), strict=True):
        state = torch.where(first[:, None], 0.0, state)
        state = 0.5 * state + 0.5 * torch.tanh(now + state @ inner + offset)
        found.append(state)
    return torch.stack(found)


@dataclass(frozen=True)
class Subject:
    """What arms are made from."""

    rollout: Rollout
    grid: TaxelGrid
    calibration: HandCalibration
    links: tuple[int, ...]
    """Taxels of each link."""
    options: ProbeOptions


def _networks(time: str, name: str, one: Subject, seeds: Sequence[int] = (0,)) -> list[Features]:
    made = {"model": name, "time": time}
    return [_network(one.rollout, one.grid, one.calibration, seed=seed, **made) for seed in seeds]


def _with_traces(features: Callable[[Subject], Features]) -> Callable[[Subject], list[Features]]:
    return lambda one: [_traces(features(one), one.rollout.begun)]


ARMS: Mapping[str, Callable[[Subject], list[Features]]] = {
    "none": lambda one: [one.rollout.proprio[..., :0]],
    "none, memory": _with_traces(lambda one: one.rollout.proprio),
    "bits": lambda one: [_bits(one.rollout, one.links)],
    "bits, memory": _with_traces(lambda one: _bits(one.rollout, one.links)),
    "force": lambda one: [_force(one.rollout)],
    "force, memory": _with_traces(lambda one: _force(one.rollout)),
    "taxels": lambda one: [_raw(one.rollout)],
    "taxels, memory": _with_traces(lambda one: _raw(one.rollout)),
    "grid, memory": _with_traces(lambda one: _grid(one)),
    "reservoir": lambda one: [
        _reservoir(one.rollout, one.grid, one.calibration, units=96, seed=one.options.seed + draw)
        for draw in range(one.options.reservoirs)
    ],
    "untrained": lambda one: _networks("native", NETWORK, one, range(one.options.untrained)),
    "simclr": lambda one: _networks("native", f"{NETWORK}.simclr", one),
    "supervised": lambda one: _networks("native", f"{NETWORK}.supervised", one),
    "untrained, 45 ms": lambda one: _networks("resampled", NETWORK, one, range(one.options.untrained)),
    "simclr, 45 ms": lambda one: _networks("resampled", f"{NETWORK}.simclr", one),
    "supervised, 45 ms": lambda one: _networks("resampled", f"{NETWORK}.supervised", one),
}
"""Arm → its features, once for each draw; every arm has the joints beside them. ``none`` feels nothing, ``bits`` has
one bit per link, ``force`` and ``taxels`` every taxel's force, and force with torque; ``memory`` adds two leaky
averages. ``grid`` is the input of the networks. ``45 ms``: at the pace of training, else a step per control step."""


def _grid(one: Subject) -> Features:
    """Return the networks' input [T, B, 6·35], averaged over the sub-steps."""
    felt = one.grid(one.rollout.taxels.mean(2, keepdim=True).flatten(0, 1))
    return felt.flatten(1).unflatten(0, one.rollout.taxels.shape[:2])


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
    subject = Subject(rollout, grid, calibration, links, options)
    wanted = torch.cat([rollout.targets[name] for name in TARGETS], -1)
    valid = rollout.valid & ~wanted.isnan().any(-1)
    if int((valid.sum(0) > 0).sum()) < 2 * FOLDS:
        raise UsageError("The object is touched in too few environments; take a policy that holds it, or more of them.")
    found = []
    for index, name in enumerate(names):
        say(index + 1, len(names) + 1, f"reading {name}")
        draws = ARMS[name](subject)
        solved = [_read(rollout.proprio, draw, wanted, valid) for draw in draws]
        found.append(Readout(name, draws[0].shape[-1], np.stack([one for one, _ in solved]), solved[0][1]))
    return found


def _read(
    proprio: torch.Tensor, features: Features, wanted: torch.Tensor, valid: torch.Tensor
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

    def standard(values: torch.Tensor) -> torch.Tensor:
        # A taxel that was hardly ever touched would otherwise throw a prediction where it is.
        return ((values[..., used] - mean[used]) / scale[used]).clamp(-10, 10)

    z = standard(rows)
    gram, products = z.T @ z / len(z), z.T @ (aim - centre) / len(z)
    solved: dict[float, torch.Tensor] = {}

    def predict(values: torch.Tensor, penalty: float) -> torch.Tensor:
        if penalty not in solved:
            ridge = gram + penalty * torch.eye(len(gram), dtype=gram.dtype, device=gram.device)
            solved[penalty] = torch.cholesky_solve(products, torch.linalg.cholesky(ridge))
        return standard(values) @ solved[penalty] + centre

    return predict


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
