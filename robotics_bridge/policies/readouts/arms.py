"""Features that a policy could have of what it felt: none, bits, forces, random and trained networks.

Letters: T control step, B environment, S sub-step, N taxel, F feature.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from brainbench.core.contracts import CHANNELS
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.registry import locate_model
from robotics_bridge.hands.observations import TAXELS_IN_CONTACT
from robotics_bridge.policies.encoders.calibration import HandCalibration
from robotics_bridge.policies.encoders.front_end import FrontEnd
from robotics_bridge.policies.encoders.posture import PostureTurn
from robotics_bridge.policies.encoders.reservoir import EchoState
from robotics_bridge.policies.encoders.taxel_graph import TaxelGraph
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.encoders.timing import Time
from robotics_bridge.policies.readouts.rollout import TouchRollout

NETWORK = "zhuang-intersection-ln-small"
"""Network of the arms ``untrained``, ``simclr`` and ``supervised``."""
_TRACES = (0.5, 0.9)
"""Share that traces of the short memory keep in a control step (time constants of 36 and 237 ms at 40 Hz)."""


Features = torch.Tensor
"""[T, B, F]."""


def traces(x: torch.Tensor, begun: torch.Tensor) -> Features:
    """Return values [T, B, F] and leaky averages of their past, which episodes begin without."""
    state = x.new_zeros(len(_TRACES), *x.shape[1:])
    keep, found = x.new_tensor(_TRACES)[:, None, None], []
    for now, first in zip(x, begun, strict=True):
        state = keep * torch.where(first[:, None], 0.0, state) + (1 - keep) * now
        found.append(torch.cat((now, *state), -1))
    return torch.stack(found)


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


def without_latency(model: str) -> dict[str, str]:
    """Return the options with which a network answers at once; only temporal graphs add latency."""
    graph = isinstance(getattr(locate_model(model).outline(), "encoder", None), TemporalGraph)
    return {"unroll": "full"} if graph else {}


def network(
    rollout: TouchRollout, grid: TaxelGrid, calibration: HandCalibration, *, model: str, time: Time, seed: int
) -> Features:
    """Return the features of a network that steps through the rollout, its memory forgotten where episodes begin."""
    front = FrontEnd(model, grid, time=time, calibration=calibration, seed=seed, options=without_latency(model))
    front = front.to(rollout.taxels.device)
    state, found = front.init_state(rollout.taxels.shape[1]), []
    for reading, first in zip(rollout.taxels, rollout.begun, strict=True):
        features, state = front(reading, torch.where(first[:, None], 0.0, state))
        found.append(features)
    return torch.stack(found)


def reservoir(
    rollout: TouchRollout, grid: TaxelGrid | TaxelGraph, calibration: HandCalibration, *, seed: int
) -> Features:
    """Return the state of a random recurrent network on a map (echo state: leak .5, spectral radius .9)."""
    unit = [calibration.force if name.startswith("F") else calibration.moment for name in CHANNELS]
    # The places last, as the units of a seed were drawn for.
    felt = (grid.wrenches(rollout.taxels.flatten(0, 1)).cpu() / torch.tensor(unit)).flatten(2, -2).mT.flatten(1)
    echo = EchoState(felt.shape[1], seed=seed)
    drive = echo.drive(felt).unflatten(0, rollout.taxels.shape[:2])
    state, found = drive.new_zeros(drive.shape[1:]), []
    for now, first in zip(drive, rollout.begun.cpu(), strict=True):
        state = echo(now, torch.where(first[:, None], 0.0, state))
        found.append(state)
    return torch.stack(found)


@dataclass(frozen=True)
class Subject:
    """What arms are made from."""

    rollout: TouchRollout
    grid: TaxelGrid
    graph: TaxelGraph
    calibration: HandCalibration
    """Of other episodes (:func:`~robotics_bridge.policies.readouts.rollout.calibrate`)."""
    links: tuple[int, ...]
    """Taxels of each link."""
    reservoirs: int
    """Random reservoirs that are drawn."""
    untrained: int
    """Initial states of the untrained network."""
    seed: int
    """Of the first reservoir."""


def networks(time: Time, name: str, one: Subject, seeds: Sequence[int] = (0,)) -> list[Features]:
    """Return the features of a network, once for each seed of weights that are drawn."""
    return [network(one.rollout, one.grid, one.calibration, model=name, time=time, seed=seed) for seed in seeds]


def mapped(rollout: TouchRollout, grid: TaxelGrid | TaxelGraph) -> Features:
    """Return a map of the touch [T, B, 6·35], averaged over the sub-steps."""
    felt = grid.wrenches(rollout.taxels.mean(2, keepdim=True).flatten(0, 1))
    return felt.flatten(1).unflatten(0, rollout.taxels.shape[:2])


def bent(one: Subject) -> Subject:
    """Return a subject whose map follows the posture of the fingers."""
    turn, rollout = PostureTurn(one.grid).to(one.rollout.taxels.device), one.rollout
    steps = zip(rollout.taxels, rollout.link_pose, strict=True)
    return replace(one, rollout=replace(rollout, taxels=torch.stack([turn(*step) for step in steps])))


def _reservoirs(one: Subject, grid: TaxelGrid | TaxelGraph) -> list[Features]:
    seeds = range(one.seed, one.seed + one.reservoirs)
    return [reservoir(one.rollout, grid, one.calibration, seed=seed) for seed in seeds]


def _with_traces(features: Callable[[Subject], Features]) -> Callable[[Subject], list[Features]]:
    return lambda one: [traces(features(one), one.rollout.begun)]


ARMS: Mapping[str, Callable[[Subject], list[Features]]] = {
    "none": lambda one: [one.rollout.proprio[..., :0]],
    "none, memory": _with_traces(lambda one: one.rollout.proprio),
    "bits": lambda one: [bits(one.rollout, one.links)],
    "bits, memory": _with_traces(lambda one: bits(one.rollout, one.links)),
    "force": lambda one: [force(one.rollout)],
    "force, memory": _with_traces(lambda one: force(one.rollout)),
    "taxels": lambda one: [raw(one.rollout)],
    "taxels, memory": _with_traces(lambda one: raw(one.rollout)),
    "grid, memory": _with_traces(lambda one: mapped(one.rollout, one.grid)),
    "grid, posture, memory": _with_traces(lambda one: mapped(bent(one).rollout, one.grid)),
    "graph, memory": _with_traces(lambda one: mapped(one.rollout, one.graph)),
    "reservoir": lambda one: _reservoirs(one, one.grid),
    "reservoir, posture": lambda one: _reservoirs(bent(one), one.grid),
    "reservoir, graph": lambda one: _reservoirs(one, one.graph),
    "untrained": lambda one: networks("native", NETWORK, one, range(one.untrained)),
    "simclr": lambda one: networks("native", f"{NETWORK}.simclr", one),
    "simclr, posture": lambda one: networks("native", f"{NETWORK}.simclr", bent(one)),
    "supervised": lambda one: networks("native", f"{NETWORK}.supervised", one),
    "untrained, 45 ms": lambda one: networks("resampled", NETWORK, one, range(one.untrained)),
    "simclr, 45 ms": lambda one: networks("resampled", f"{NETWORK}.simclr", one),
    "supervised, 45 ms": lambda one: networks("resampled", f"{NETWORK}.supervised", one),
}
"""Arm → its features, once for each draw; every arm has the joints beside them. ``none`` feels nothing, ``bits`` has
one bit per link, ``force`` and ``taxels`` every taxel's force, and force with torque; ``memory`` adds two leaky
averages. ``grid`` is the input of the networks, with ``posture`` along the fingers as they are bent; ``graph`` has as
many numbers, from the graph of taxels of each link. ``45 ms``: at the pace of training, else a step per control step.
"""
