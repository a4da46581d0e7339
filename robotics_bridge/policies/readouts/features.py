"""One rollout of a policy, which serves every arm of a probe.

Letters: T control step, B environment, S sub-step, N taxel.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import nn

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import UsageError
from brainbench.core.rotations import conjugate, from_matrices, multiply, rotate
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.registry import locate_model
from robotics_bridge.envs.env import Env
from robotics_bridge.hands.observations import TAXELS_IN_CONTACT
from robotics_bridge.policies.encoders.arms import EchoState, recur
from robotics_bridge.policies.encoders.taxel_grid import FrontEnd, HandCalibration, TaxelGraph, TaxelGrid, Time
from robotics_bridge.policies.evaluate import Acting, forget
from robotics_bridge.sensors.noise.model import PRESETS

TARGETS = ("position", "velocity", "spin", "contact")
"""Object that counts (m, m/s, rad/s), and the centre of the contact forces on it (m), [3] each, world axes."""
CALIBRATION_SECONDS = 2.0  # length of the episodes of a calibration
_SETTLING = 10  # control steps after an episode's start that are left out: the object falls onto the palm


@dataclass(frozen=True, eq=False)
class TouchRollout:
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
    link_pose: torch.Tensor
    """[T, B, L, 7] of the tactile links in the palm's frame (m, quaternion)."""
    floor: float = 0.0
    """Largest reading of a taxel that touches nothing (N, N·m)."""

    @property
    def ended(self) -> torch.Tensor:
        """[T, B] bool: last step of an episode."""
        return self.begun.roll(-1, 0)

    @property
    def wanted(self) -> torch.Tensor:
        """All targets side by side [T, B, D], in the order of :data:`TARGETS`."""
        return torch.cat([self.targets[name] for name in TARGETS], -1)


@torch.no_grad()
def collect(env: Env, policy: Acting, seconds: float) -> TouchRollout:
    """Run a policy and return what it felt, and what is to be read from it."""
    if env.options.observe != "force_torque" or env.touch is None:
        raise UsageError("A probe reads force and torque: make the environment with observe='force_torque'.")
    observations = env.reset()
    age = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
    # A policy may remember what it did before this rollout.
    forget(policy, age == 0)
    columns: dict[str, list[torch.Tensor]] = {}
    for _ in range(round(seconds / env.step_dt)):
        velocity, spin = env.state.target_velocity
        row = {"proprio": observations["proprio"], "taxels": observations["tactile"], "begun": age == 0}
        row["link_pose"] = env.link_pose
        row |= {"position": env.state.target_pose[:, :3], "velocity": velocity, "spin": spin}
        row |= {"contact": _centre(env, age), "valid": age >= _SETTLING}
        for name, value in row.items():
            columns.setdefault(name, []).append(value.clone())
        observations, _, terminated, truncated, _ = env.step(policy(observations))
        done = terminated | truncated
        forget(policy, done)
        age = torch.where(done, 0, age + 1)
    stacked = {name: torch.stack(rows) for name, rows in columns.items()}
    targets = {name: stacked.pop(name) for name in TARGETS}
    # Six standard deviations of white noise, which is 0 where taxels have none.
    floor = 6 * PRESETS["published-force_torque"].white * env.options.noisy
    return TouchRollout(targets=targets, floor=floor, **stacked)


@torch.no_grad()
def calibrate(env: Env, policy: Acting, grid: TaxelGrid, seed: int) -> HandCalibration:
    """Return the unit of force and moment of episodes of another seed, in which nothing is read; then begin anew.

    As students, encoders know their unit before the episodes in which they are tried.
    """
    env.seed(seed + 1)
    felt = collect(env, policy, CALIBRATION_SECONDS).taxels
    env.seed(seed)
    return HandCalibration.fit(grid(felt.flatten(0, 1)).cpu())


def _centre(env: Env, age: torch.Tensor) -> torch.Tensor:
    """Return the centre [B, 3] of the contact forces on the object that counts, in the last physics step, else NaN."""
    state, scene = env.simulation.state, env.simulation.engine.scene
    count = min(int(state.contact_count.numpy()[0]), state.contact_env.shape[0])
    names = ("env", "geom", "position", "force")
    row, geometries, position, force = (getattr(state, f"contact_{name}").numpy()[:count] for name in names)
    links = np.array([scene.link_index(name) for name in env.state.model.objects])
    link = links[env.state.episode.target.cpu().numpy()[row]]
    mine = (np.asarray(scene.link_of)[geometries] == link[:, None]).any(axis=1) & (force > 0)
    sums, total = np.zeros((env.num_envs, 3)), np.zeros(env.num_envs)
    np.add.at(sums, row[mine], position[mine] * force[mine, None])
    np.add.at(total, row[mine], force[mine])
    with np.errstate(invalid="ignore"):
        centre = torch.as_tensor(sums / np.where(total > 0, total, np.nan)[:, None], dtype=torch.float32)
    # What an ended episode touched last is no contact of the next one.
    return torch.where((age == 0)[:, None], torch.nan, centre.to(age.device))


class PostureTurn(nn.Module):
    """What is put before the fixed map of a hand whose taxels measure force and torque."""

    owner: torch.Tensor
    """[N] link of a taxel, in the layout's order."""
    reference: torch.Tensor
    """[N, 4] rotation of its link to the palm's axes at the reference."""
    lever: torch.Tensor
    """[N, 3] from the middle of its site to the origin of its link (m, palm axes at the reference)."""

    def __init__(self, grid: TaxelGrid) -> None:
        super().__init__()
        owner, reference, lever = [], [], []
        for number, (link, probes) in enumerate(grid.layout.items()):
            points = probes.position[probes.active]
            turn, origin = grid.axes.place[link]
            owner += [number] * len(points)
            reference += [from_matrices(turn)] * len(points)
            lever.append(origin - grid.axes.centers[grid.axes.sites(link, points)])
        self.register_buffer("owner", torch.tensor(owner), persistent=False)
        self.register_buffer("reference", torch.from_numpy(np.array(reference)).float(), persistent=False)
        self.register_buffer("lever", torch.from_numpy(np.concatenate(lever)).float(), persistent=False)

    def forward(self, taxels: torch.Tensor, link_pose: torch.Tensor) -> torch.Tensor:
        """Return readings [B, S, N, 6] for the map, of readings [B, S, N, 6] and poses [B, L, 7] of the links.

        Poses are those of the observation ``link_pose``, in the palm's frame (x y z, qw qx qy qz).
        """
        shape = (*taxels.shape[:-1], 4)
        reference = self.reference.expand(shape)
        now = link_pose[:, self.owner, 3:][:, None].expand(shape)
        bent, back = multiply(now, conjugate(reference)), conjugate(reference)
        lever = self.lever.expand(*shape[:-1], 3)
        force, moment = rotate(reference, taxels[..., :3]), rotate(reference, taxels[..., 3:])
        moment = rotate(bent, moment + torch.linalg.cross(lever, force))
        force = rotate(bent, force)
        moment = moment - torch.linalg.cross(lever, force)
        return torch.cat((rotate(back, force), rotate(back, moment)), -1)


NETWORK = "zhuang-intersection-ln-small"  # network of the arms `untrained`, `simclr` and `supervised`
_TRACES = (0.5, 0.9)
"""Share that traces of the short memory keep in a control step (time constants of 36 and 237 ms at 40 Hz)."""

Features = torch.Tensor
"""[T, B, F]."""


def traces(x: torch.Tensor, begun: torch.Tensor) -> Features:
    """Return values [T, B, F] and leaky averages of their past, which episodes begin without."""
    state = x.new_zeros(len(_TRACES), *x.shape[1:])
    keep, values = x.new_tensor(_TRACES)[:, None, None], []
    for now, first in zip(x, begun, strict=True):
        state = keep * torch.where(first[:, None], 0.0, state) + (1 - keep) * now
        values.append(torch.cat((now, *state), -1))
    return torch.stack(values)


def raw(rollout: TouchRollout) -> Features:
    """Return force and torque of every taxel, averaged over the sub-steps."""
    return rollout.taxels.mean(2).flatten(2)


def force(rollout: TouchRollout) -> Features:
    """Return the force of every taxel, averaged over the sub-steps."""
    return rollout.taxels[..., :3].mean(2).flatten(2)


def bits(rollout: TouchRollout, links: Sequence[int]) -> Features:
    """Return one bit per link and sub-step: more than two taxels touch (table 4.6)."""
    touch = (rollout.taxels.abs().amax(-1) > rollout.floor).float()
    parts = [part.sum(-1) > TAXELS_IN_CONTACT for part in touch.split(list(links), dim=-1)]
    return torch.stack(parts, -1).float().flatten(2)


def reservoir(
    rollout: TouchRollout, grid: TaxelGrid | TaxelGraph, calibration: HandCalibration, *, seed: int
) -> Features:
    """Return the state of a random recurrent network on a map (echo state: leak .5, spectral radius .9)."""
    unit = [calibration.force if name.startswith("F") else calibration.moment for name in CHANNELS]
    # The places last, as the units of a seed were drawn for.
    felt = (grid.wrenches(rollout.taxels.flatten(0, 1)).cpu() / torch.tensor(unit)).flatten(2, -2).mT.flatten(1)
    echo = EchoState(felt.shape[1], seed=seed)
    drive = echo.drive(felt).unflatten(0, rollout.taxels.shape[:2])
    return recur(lambda u, x: (echo(u, x),) * 2, drive, drive.new_zeros(drive.shape[1:]), rollout.ended.cpu())[0]


@dataclass(frozen=True)
class Subject:
    """What arms are made from."""

    rollout: TouchRollout
    grid: TaxelGrid
    graph: TaxelGraph
    calibration: HandCalibration
    """Of other episodes (:func:`~robotics_bridge.policies.readouts.features.calibrate`)."""
    links: tuple[int, ...]
    """Taxels of each link."""
    reservoirs: int
    """Random reservoirs that are drawn."""
    untrained: int
    """Initial states of the untrained network."""
    seed: int
    """Of the first reservoir."""


def networks(time: Time, name: str, subject: Subject, seeds: Sequence[int] = (0,)) -> list[Features]:
    """Return the features of a network, once for each seed of weights that are drawn.

    It steps through the rollout, its memory forgotten where episodes begin.
    """
    taxels, features = subject.rollout.taxels, []
    # Networks answer at once here; only temporal graphs add latency.
    graph = isinstance(getattr(locate_model(name).outline(), "encoder", None), TemporalGraph)
    how = {"time": time, "calibration": subject.calibration, "options": {"unroll": "full"} if graph else {}}
    for seed in seeds:
        front = FrontEnd(name, subject.grid, seed=seed, **how).to(taxels.device)
        features.append(recur(front, taxels, front.init_state(taxels.shape[1]), subject.rollout.ended)[0])
    return features


def mapped(rollout: TouchRollout, grid: TaxelGrid | TaxelGraph) -> Features:
    """Return a map of the touch [T, B, 6·35], averaged over the sub-steps."""
    felt = grid.wrenches(rollout.taxels.mean(2, keepdim=True).flatten(0, 1))
    return felt.flatten(1).unflatten(0, rollout.taxels.shape[:2])


def bent(subject: Subject) -> Subject:
    """Return a subject whose map follows the posture of the fingers."""
    turn, rollout = PostureTurn(subject.grid).to(subject.rollout.taxels.device), subject.rollout
    steps = zip(rollout.taxels, rollout.link_pose, strict=True)
    return replace(subject, rollout=replace(rollout, taxels=torch.stack([turn(*step) for step in steps])))


def _reservoirs(subject: Subject, grid: TaxelGrid | TaxelGraph) -> list[Features]:
    seeds = range(subject.seed, subject.seed + subject.reservoirs)
    return [reservoir(subject.rollout, grid, subject.calibration, seed=seed) for seed in seeds]


def _with_traces(features: Callable[[Subject], Features]) -> Callable[[Subject], list[Features]]:
    return lambda subject: [traces(features(subject), subject.rollout.begun)]


ARMS: Mapping[str, Callable[[Subject], list[Features]]] = {
    "none": lambda subject: [subject.rollout.proprio[..., :0]],
    "none, memory": _with_traces(lambda subject: subject.rollout.proprio),
    "bits": lambda subject: [bits(subject.rollout, subject.links)],
    "bits, memory": _with_traces(lambda subject: bits(subject.rollout, subject.links)),
    "force": lambda subject: [force(subject.rollout)],
    "force, memory": _with_traces(lambda subject: force(subject.rollout)),
    "taxels": lambda subject: [raw(subject.rollout)],
    "taxels, memory": _with_traces(lambda subject: raw(subject.rollout)),
    "grid, memory": _with_traces(lambda subject: mapped(subject.rollout, subject.grid)),
    "grid, posture, memory": _with_traces(lambda subject: mapped(bent(subject).rollout, subject.grid)),
    "graph, memory": _with_traces(lambda subject: mapped(subject.rollout, subject.graph)),
    "reservoir": lambda subject: _reservoirs(subject, subject.grid),
    "reservoir, posture": lambda subject: _reservoirs(bent(subject), subject.grid),
    "reservoir, graph": lambda subject: _reservoirs(subject, subject.graph),
    "untrained": lambda subject: networks("native", NETWORK, subject, range(subject.untrained)),
    "simclr": lambda subject: networks("native", f"{NETWORK}.simclr", subject),
    "simclr, posture": lambda subject: networks("native", f"{NETWORK}.simclr", bent(subject)),
    "supervised": lambda subject: networks("native", f"{NETWORK}.supervised", subject),
    "untrained, 45 ms": lambda subject: networks("resampled", NETWORK, subject, range(subject.untrained)),
    "simclr, 45 ms": lambda subject: networks("resampled", f"{NETWORK}.simclr", subject),
    "supervised, 45 ms": lambda subject: networks("resampled", f"{NETWORK}.supervised", subject),
}
"""Arm → its features, once for each draw; every arm has the joints beside them. ``none`` feels nothing, ``bits`` has
one bit per link, ``force`` and ``taxels`` every taxel's force, and force with torque; ``memory`` adds two leaky
averages. ``grid`` is the input of the networks, with ``posture`` along the fingers as they are bent; ``graph`` has as
many numbers, from the graph of taxels of each link. ``45 ms``: at the pace of training, else a step per control step.
"""
