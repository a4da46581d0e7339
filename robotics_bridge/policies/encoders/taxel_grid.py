"""From the taxels of a hand to the input of an encoder: one fixed linear map [B, S, N, C] → [B, S·6, 5, 7].

Rows are fingers (thumb, index, middle, ring, pinky; the row of an absent finger stays zero), columns seven sites along
each finger's axis from its tip to the wrist. Sites are quantiles of the arc length of the taxels of the whole hand at
medium resolution, so a spot of skin lights one and the same cell at every placement and resolution; taxels of the palm
belong to the nearest axis. A site carries the sum of its taxels' forces and their moments about its centre,

    F_site = Σ f_i,    M_site = Σ m_i + (x_i − x_site) × f_i,

in the axes of the hand's base (the palm) with the joints at their reference position: a touch gives the same image
however the finger is bent, as a whisker's does, and the map is one matrix product. Channels are
:data:`brainbench.core.contracts.CHANNELS` within sub-steps, as encoders expect: the action of the world on the skin
(N, N·m).

A network that was scored against a brain reads the grid as the tactile front end of a policy (:class:`FrontEnd`):
readings [B, S, N, C] → :class:`TaxelGrid` → the encoder's clock → hand calibration → the network's own normaliser,
encoder and attender → features [B, F], one step at a time, with all memory in one array [B, H]: zeros are the state
before the first step and rows are independent. An encoder has sub-steps of 9 ms in steps of 45 ms, control steps have
five sub-steps of 5 ms: ``native`` time gives it every control step as one of its own (time runs 1.8 times faster than
in its training), ``resampled`` time its own sub-steps (:class:`Resampler`).

Letters: B batch, S sub-step, N item (an active taxel, or a link of the ``agg_`` types), C channel of the observation,
K sub-steps remembered, V values of a sub-step.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse.csgraph import laplacian
from scipy.spatial.distance import cdist
from torch import nn

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, SUB_STEP_SECONDS
from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError, UsageError, check_name, listing
from brainbench.core.limits import Positive, limited
from brainbench.models.export import StreamingStep
from brainbench.models.network import FORCE_SCALE, MOMENT_SCALE, EncoderAttenderDecoder
from brainbench.models.registry import load_model
from robotics_bridge import hands
from robotics_bridge.hands import Hand, layouts
from robotics_bridge.hands.layouts import Layout
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.sensors.probes.placement import Probes

mujoco = mujoco_module()

FINGERS = ("thumb", "index", "middle", "ring", "pinky")  # rows of the grid, from the radial side on
_WORDS = {
    "thumb": ("thumb", "th"),
    "index": ("index", "ff", "fore"),
    "middle": ("middle", "mid", "mf"),
    "ring": ("ring", "rf"),
    "pinky": ("pinky", "little", "lf", "small"),
}
_log = logging.getLogger(__name__)
_SAME = 1e-4  # points nearer along a finger axis than this (m) are never parted


def finger_rows(fingers: Mapping[str, Sequence[str]]) -> dict[str, int]:
    """Return finger → row of the grid; a finger that the hand lacks leaves its row empty.

    Names are read in English or as the usual two letters (``ff``, ``mf``, ``rf``, ``lf``, ``th``). If one of them says
    nothing, the fingers take the rows in their own order.

    >>> finger_rows({"index": (), "thumb": ()})
    {'index': 1, 'thumb': 0}
    """
    if len(fingers) > GRID_SHAPE[0]:
        raise UsageError(f"The grid has rows for {GRID_SHAPE[0]} fingers; this hand has {len(fingers)}.")
    rows: dict[str, int] = {}
    for finger in fingers:
        # Fingers of files are named by their tips: rh_ffdistal, thumbtip.
        parts = [part.removesuffix("distal").removesuffix("tip") for part in re.findall("[a-z]+", finger.lower())]
        matches = [row for row, name in enumerate(FINGERS) if any(word in parts for word in _WORDS[name])]
        if len(matches) != 1 or matches[0] in rows.values():
            _log.warning(
                "The names of the fingers %s do not all tell which they are: they take the rows of the grid in their "
                "order, the thumb's first, where networks may expect other fingers.", listing([*fingers]),
            )  # fmt: skip
            return {name: row for row, name in enumerate(fingers)}
        rows[finger] = matches[0]
    return rows


@dataclass(frozen=True, eq=False)
class FingerAxes:
    """The fingers of a hand in its reference posture, and where their sites begin (:func:`finger_axes_of`)."""

    place: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
    """Link → rotation [3, 3] to the palm's axes and origin [3] (m)."""
    chains: Mapping[int, tuple[str, ...]]
    """Row → links from palm to tip."""
    joints: Mapping[int, NDArray[np.float64]]
    """Row → corners [n, 3] of its axis: the wrist, the origins of its links, and a point beyond the tip."""
    palm: str
    edges: NDArray[np.float64]
    """[5, 6]: lengths along the axis, counted from the far end, at which one site ends and the next begins."""
    centers: NDArray[np.float64]
    """[5, 7, 3]: middle of every site; the palm's origin where a site is empty."""

    def to_palm(self, link: str, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points [N, 3] of a link's frame in that of the palm."""
        turn, origin = self.place[link]
        return points @ turn.T + origin

    def sites(self, link: str, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows [N] and columns [N] of points [N, 3] on a link (its frame)."""
        rows, lengths = self.locate(link, self.to_palm(link, points))
        # The number of edges that a length lies beyond.
        return rows, (self.edges[rows] <= lengths[:, None]).sum(axis=1)

    def locate(self, link: str, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the row [N] of points (palm frame) and their lengths [N] along it from its far end."""
        for row, chain in self.chains.items():
            if link in chain:
                start = 1 + chain.index(link)
                return np.full(len(points), row), _along(self.joints[row], start, points)[0]
        if link != self.palm:
            raise UsageError(f"The link {link!r} is neither the palm {self.palm!r} nor part of a finger.")
        # A taxel of the palm belongs to the finger axis nearest to it, whose first segment leads over the palm.
        order = sorted(self.chains)
        along = [_along(self.joints[row], 0, points) for row in order]
        nearest = np.argmin([distance for _, distance in along], axis=0)
        lengths = np.stack([length for length, _ in along])[nearest, np.arange(len(points))]
        return np.array(order)[nearest], lengths


def finger_axes_of(hand: Hand, reference: Layout) -> FingerAxes:
    """Return the finger axes of a hand; sites are the seven quantiles of a reference layout's taxels along it."""
    data = mujoco.MjData(hand.model)
    mujoco.mj_kinematics(hand.model, data)
    palm = hand.model.body(hand.palm).id
    turn, origin = data.xmat[palm].reshape(3, 3), data.xpos[palm]
    place = {}
    for link in (hand.palm, *(name for chain in hand.fingers.values() for name in chain)):
        body = hand.model.body(link).id
        place[link] = (turn.T @ data.xmat[body].reshape(3, 3), (data.xpos[body] - origin) @ turn)
    rows = finger_rows(hand.fingers)
    chains = {rows[finger]: tuple(chain) for finger, chain in hand.fingers.items()}
    joints = {row: _corners(chain, place, reference) for row, chain in chains.items()}
    edges = np.full((GRID_SHAPE[0], GRID_SHAPE[1] - 1), np.inf)
    axes = FingerAxes(place, chains, joints, hand.palm, edges, np.zeros((*GRID_SHAPE, 3)))
    _lay_sites(axes, reference)
    return axes


def _corners(chain: tuple[str, ...], place: Mapping[str, Any], reference: Layout) -> NDArray[np.float64]:
    """Return the corners of a finger axis: wrist, joints, and a point beyond the tip in line with the last phalanx."""
    corners = [np.zeros(3), *(place[link][1] for link in chain)]
    steps = [after - before for before, after in pairwise(corners[1:])]
    # Links whose origins coincide have no direction; the last two that differ show where the finger points.
    long = [step for step in steps if np.linalg.norm(step) > _SAME]
    direction = long[-1] if long else corners[-1] - corners[0]
    tip = reference.get(chain[-1])
    if not long and tip is not None:
        turn, origin = place[chain[-1]]
        direction = tip.position[tip.active].mean(axis=0) @ turn.T + origin - corners[-1]
    length = np.linalg.norm(direction)
    unit = direction / length if length > 0 else np.array([0.0, 0.0, 1.0])
    # Half a metre is beyond the tip of any hand, and sites are quantiles: the origin of the length is free.
    return np.array([*corners, corners[-1] + 0.5 * unit])


def _along(
    corners: NDArray[np.float64], segment: int, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far along one segment points [N, 3] lie from the axis's far end, and their distance from it."""
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    rest = lengths[segment + 1 :].sum()
    step = corners[segment + 1] - corners[segment]
    size = lengths[segment]
    # Nearest point of the segment: projection on it, held between its ends.
    share = np.clip((points - corners[segment]) @ step / size**2, 0, 1) if size > 0 else np.zeros(len(points))
    distance = np.linalg.norm(points - corners[segment] - share[:, None] * step, axis=1)
    return rest + (1 - share) * size, distance


def _lay_sites(axes: FingerAxes, reference: Layout) -> None:
    """Fill edges and centres of the sites: quantiles of a layout's taxels along each axis."""
    columns = GRID_SHAPE[1]
    parts = []
    for link, probes in reference.items():
        points = axes.to_palm(link, probes.position[probes.active])
        row, length = axes.locate(link, points)
        parts.append(np.column_stack([row, length, points]))
    table = np.concatenate(parts) if parts else np.zeros((0, 5))
    for row in axes.chains:
        mine = table[table[:, 0] == row]
        if not len(mine):
            continue
        steps = np.round(mine[:, 1] / _SAME)
        values, inverse, counts = np.unique(steps, return_inverse=True, return_counts=True)
        # Taxels at one length stay together, so a quantile is that of their middle rank.
        site = np.floor(columns * (np.cumsum(counts) - counts / 2) / counts.sum()).astype(int)
        # An edge lies half way between the last taxel before it and the first behind, so that rounding parts no taxels.
        ends, first = np.append(values, np.inf), np.searchsorted(site, np.arange(1, columns))
        axes.edges[row] = np.where(first > 0, _SAME * (ends[first - 1] + ends[first]) / 2, 0.0)
        for column in np.unique(site):
            axes.centers[row, column] = mine[site[inverse] == column, 2:].mean(axis=0)


SITES = GRID_SHAPE[0] * GRID_SHAPE[1]  # cells of the grid


class TaxelGrid(nn.Module):
    """The map of one hand, with taxels at a placement and resolution (:meth:`~robotics_bridge.hands.Hand.layout`).

    Of what they ``observe``, ``force_torque`` and ``proximity`` are wrenches already; the force of ``force`` and the
    displacement of ``elastomer`` act at their taxel; ``bool`` and ``depth`` push there against the normal; values per
    link act at the middle of its taxels.
    """

    matrix: torch.Tensor
    """[SITES·6, N·C]."""
    cells: int = SITES

    def __init__(
        self,
        hand: Hand | str | os.PathLike[str],
        *,
        placement: str = "hand",
        resolution: str = "med",
        observe: str = "force_torque",
    ) -> None:
        super().__init__()
        kind = observation_type(observe)
        if kind.sensor is None:
            raise UsageError(f"The observation type {observe!r} has no touch, so there is nothing to lay on a grid.")
        body: Hand = hand if isinstance(hand, hands.Hand) else hands.load(hand)
        self.layout: Layout = body.layout(resolution, placement)
        """Link → probes, in the order of the items."""
        self.observe = observe
        self.channels: int = kind.channels
        """C."""
        custom = resolution not in layouts.RESOLUTIONS
        self.axes: FingerAxes = finger_axes_of(body, body.layout(resolution if custom else "med", "hand"))
        parts = [_scatter(self.axes, link, probes, observe) for link, probes in self.layout.items()]
        if not parts:
            raise UsageError(f"The hand {body.name!r} has no taxels at the placement {placement!r}.")
        full = np.concatenate(parts, axis=2)
        self.items: int = full.shape[2]
        """N."""
        matrix = torch.from_numpy(full.reshape(SITES * len(CHANNELS), -1)).float()
        # Not a weight: it follows from the names above, so files of weights need not hold it.
        self.register_buffer("matrix", matrix, persistent=False)

    @property
    def occupied(self) -> torch.Tensor:
        """Cells [5, 7] that any item reaches."""
        return self.matrix.abs().sum(1).view(SITES, len(CHANNELS)).sum(1).view(GRID_SHAPE) > 0

    def forward(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the grid [B, S·6, 5, 7] of readings [B, S, N, C], links in the layout's order and fillers left out."""
        if taxels.ndim != 4 or taxels.shape[2:] != (self.items, self.channels):
            raise UsageError(
                f"The grid reads [batch, sub-step, {self.items} items, {self.channels} channels] of "
                f"{self.observe!r}; received {list(taxels.shape)}."
            )
        # One product for all sites, channels and sub-steps; the transpose puts channels before sites, as encoders read
        # them.
        sites = nn.functional.linear(taxels.flatten(2), self.matrix)
        grid = sites.unflatten(2, (SITES, len(CHANNELS))).transpose(2, 3)
        return grid.reshape(taxels.shape[0], -1, *GRID_SHAPE)

    def wrenches(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the grid as wrenches [B, S, 5, 7, 6]."""
        return self(taxels).unflatten(1, (-1, len(CHANNELS))).movedim(2, -1)


def _scatter(axes: FingerAxes, link: str, probes: Probes, observe: str) -> NDArray[np.float64]:
    """Return the part [SITES, 6, items, C] of a link's items."""
    points, normals = probes.position[probes.active], probes.normal[probes.active]
    if not len(points):
        return np.zeros((SITES, 6, 0, observation_type(observe).channels))
    if observation_type(observe).per_link:
        normal = normals.mean(axis=0, keepdims=True)
        length = np.linalg.norm(normal)
        points, normals = points.mean(axis=0, keepdims=True), normal / length if length > 1e-9 else normals[:1]
    turn, origin = axes.place[link]
    rows, columns = axes.sites(link, points)
    wrench = _WRENCHES[observe](points, normals)
    # F = R f and M = R m + (x₀ − x_site) × F: the wrench about the link's origin moved to the middle of its site.
    force, lever = turn @ wrench[:, :3], origin - axes.centers[rows, columns]
    moment = turn @ wrench[:, 3:] + np.cross(lever[:, :, None], force, axis=1)
    part = np.zeros((SITES, 6, len(points), wrench.shape[2]))
    part[rows * GRID_SHAPE[1] + columns, :, np.arange(len(points))] = np.concatenate([force, moment], axis=1)
    return part


def _of_force(points: NDArray[np.float64], force: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the maps [N, 6, C] to a wrench about the link's origin of forces [N, 3, C] that act at points [N, 3]."""
    force = np.broadcast_to(force, (len(points), *force.shape[-2:]))
    return np.concatenate([force, np.cross(points[:, :, None], force, axis=1)], axis=1)


_WRENCHES: Mapping[str, Any] = {
    **dict.fromkeys(("force_torque", "proximity"), lambda points, normals: np.tile(np.eye(6), (len(points), 1, 1))),
    **dict.fromkeys(("force", "elastomer"), lambda points, normals: _of_force(points, np.eye(3))),
    **dict.fromkeys(("bool", "depth", "agg_bool"), lambda points, normals: _of_force(points, -normals[:, :, None])),
    # Undoes equation 4.29: axes z, y, x, and outward; its scale is left to the calibration.
    "agg_force": lambda points, normals: _of_force(points, -np.eye(3)[::-1]),
    # A linear map has no use for the point: the force acts in the middle of the link's taxels.
    "center_of_pressure": lambda points, normals: np.concatenate(
        [_of_force(points, np.eye(3)), np.zeros((len(points), 6, 3)), np.pad(normals, ((0, 0), (3, 0)))[:, :, None]],
        axis=2,
    ),
}
"""Observation type → the maps [N, 6, C] from its values to wrenches about the link's origin, in its axes."""


class TaxelGraph(nn.Module):
    """Taxels by the graph of each link instead of the grid: its :data:`SITES` smoothest patterns, or all if fewer.

    A graph joins the taxels of a link, each pair with the weight exp(−d²/2ℓ²) of its distance d, where ℓ is the
    distance to the nearest taxel in the median of the link. Eigenvectors φ of its Laplacian D − W are patterns over the
    link: first the mean of all taxels, then ever finer ones. A pattern carries Σ √n φ_i (f_i, m_i) of the n taxels of
    its link, so that the first one is the link's wrench. No link knows of another. Letter: K pattern.
    """

    patterns: torch.Tensor
    """[K, N]."""
    middle: torch.Tensor
    """[N, 3]: mean of the taxels of a taxel's link, about which moments are taken (m, axes of the link)."""

    def __init__(self, layout: Layout, observe: str = "force_torque") -> None:
        super().__init__()
        if observe != "force_torque":
            observation_type(observe)  # an unknown name has an error of its own
            raise UsageError(f"The graph of taxels reads 'force_torque'; received {observe!r}.")
        points = [probes.position[probes.active] for probes in layout.values()]
        values, patterns = zip(*map(_patterns, points), strict=True)
        # Stable: patterns that are equally smooth keep the order of the links.
        smoothest = np.argsort(np.concatenate(values), kind="stable")[:SITES]
        rows = np.asarray(block_diag(*(np.sqrt(len(each)) * each for each in patterns)))[smoothest]
        middle = np.concatenate([np.tile(one.mean(0), (len(one), 1)) for one in points if len(one)])
        # Not weights: they follow from the layout, so files of weights need not hold them.
        self.cells: int = len(rows)
        """K."""
        self.register_buffer("patterns", torch.from_numpy(rows).float(), persistent=False)
        self.register_buffer("middle", torch.from_numpy(middle).float(), persistent=False)

    def wrenches(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the patterns [B, S, K, 6] of readings [B, S, N, 6] (N, N·m)."""
        force, moment = taxels.split(3, -1)
        moment = moment - torch.linalg.cross(self.middle.expand_as(force), force)
        return self.patterns @ torch.cat((force, moment), -1)


def _patterns(points: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return eigenvalues [n], from 0 up, and patterns [n, n] of a link's taxels [n, 3]."""
    if len(points) < 2:
        return np.zeros(len(points)), np.eye(len(points))
    distance = cdist(points, points)
    spacing = np.median(np.sort(distance, axis=1)[:, 1])
    weight = np.exp(-0.5 * (distance / spacing) ** 2)
    np.fill_diagonal(weight, 0.0)
    values, vectors = np.linalg.eigh(laplacian(weight))
    return np.round(values, 9), vectors.T


_TOUCHING = 1e-3  # cells below this share of the strongest one do not count as touched


@limited(of="{} of a hand calibration")
class HandCalibration:
    """Force and moment of one site of a hand that look to the encoder as its own unit.

    One number for all three axes of each kind, so that directions are kept. The encoder's own normaliser, per channel,
    follows; one that was fitted to whiskers therefore sees values of the size that it was fitted to.
    """

    force: Positive = 0.5
    """N that count as :data:`~brainbench.models.network.FORCE_SCALE`."""
    moment: Positive = 5e-3
    """N·m that count as :data:`~brainbench.models.network.MOMENT_SCALE`."""

    @classmethod
    def fit(cls, grid: torch.Tensor) -> HandCalibration:
        """Return the calibration at which touched sites of recorded grids [..., S·6, 5, 7] have an rms of one unit."""
        if grid.ndim < 3 or grid.shape[-2:] != GRID_SHAPE or grid.shape[-3] % len(CHANNELS):
            raise UsageError(f"A recording has the shape [..., S·6, 5, 7]; received {list(grid.shape)}.")
        if not torch.isfinite(grid).all():
            raise DataError("The recording holds values that are not finite, so the hand cannot be calibrated on it.")
        cells = grid.double().reshape(-1, len(CHANNELS), GRID_SHAPE[0] * GRID_SHAPE[1]).transpose(1, 2).flatten(0, 1)
        # Silent sites are left out: their share depends on the recording and would set the unit.
        strength = cells[:, :3].norm(dim=1)
        touched = cells[strength > _TOUCHING * strength.max()]
        if not len(touched):
            raise DataError("Nothing touches the hand in this recording, so it cannot be calibrated on it.")
        force, moment = (float(part.pow(2).mean().sqrt()) for part in (touched[:, :3], touched[:, 3:]))
        if not moment > 0:
            raise DataError("The recording holds forces without any moment; calibrate on readings of a whole grid.")
        return cls(force, moment)

    def gains(self, sub_steps: int) -> list[float]:
        """Return the factor of each channel (sub-step-major) from SI on the hand to SI at a whisker's base."""
        force, moment = FORCE_SCALE / self.force, MOMENT_SCALE / self.moment
        return [force if name.startswith("F") else moment for name in CHANNELS] * sub_steps


Time = Literal["native", "resampled"]
CONTROL_SUB_STEP = 0.005  # seconds between readings of the tactile sensors (200 Hz physics)


class Resampler(nn.Module):
    """Turns control steps [B, S, V] into an encoder's steps [B, S, V], with all memory in one array per row.

    Row by row, time starts at the reset (a state of zeros); before it nothing touches. Of q control steps p complete a
    step of the encoder (5 of 9). A step shows what was felt up to 45 ms · (its number).
    """

    weights: torch.Tensor
    """[q, S, K]: interpolation at each phase; zeros where no step ends."""

    def __init__(self, values: int, *, sub_steps: int = 5) -> None:
        super().__init__()
        ratio = Fraction(CONTROL_SUB_STEP / SUB_STEP_SECONDS).limit_denominator(1000)
        self.values, self.sub_steps = values, sub_steps
        self.advance, self.cycle = ratio.numerator, ratio.denominator
        # How far before the last reading sample i of a step lies, counted in readings.
        oldest = (self.advance - 1) * sub_steps / self.advance + (sub_steps - 1) * self.cycle / self.advance
        remembered = max(int(oldest) + 2, sub_steps)
        self.past = remembered - sub_steps
        # Times before the last reading as whole numbers of 1/p readings: no rounding decides which readings a sample
        # lies between. Its weights fall to zero over one reading on either side.
        phase, sample, reading = np.ogrid[: self.cycle, :sub_steps, :remembered]
        before = phase * sub_steps + (sub_steps - 1 - sample) * self.cycle
        share = np.clip(self.advance - np.abs(self.advance * (remembered - 1 - reading) - before), 0, None)
        weights = torch.from_numpy(np.where(phase < self.advance, share / self.advance, 0.0)).float()
        self.register_buffer("weights", weights, persistent=False)
        self.state_size: int = 1 + self.past * values
        """Numbers of state per row: the phase and the readings before."""

    def forward(self, x: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return (step [B, S, V], whether it is a new one [B, 1] bool, state [B, state_size])."""
        # The phase advances by p of q per control step; a step of the encoder is complete where it wraps around.
        phase = torch.remainder(state[:, :1] + self.advance, self.cycle)
        past = state[:, 1:].unflatten(1, (self.past, self.values))
        window = torch.cat((past, x), 1)
        chosen = self.weights[phase[:, 0].round().long()]
        after = torch.cat((phase, window[:, self.sub_steps :].flatten(1)), 1)
        return chosen @ window, phase < self.advance - 0.5, after


Learning = Literal["frozen", "finetuned"]


class FrontEnd(nn.Module):
    """A network of :func:`brainbench.load_model` that reads a hand.

    Args:
        model: The network, or its name for :func:`brainbench.load_model` with seed, pretrained weights and options.
        grid: The map from taxels to its input.
        time: ``native`` or ``resampled``.
        learning: ``frozen`` computes no gradients and never leaves evaluation mode.
        calibration: What a unit of force is to the network.
    """

    gain: torch.Tensor
    """[30, 1, 1]: factor of each channel, of the hand calibration."""

    def __init__(
        self,
        model: nn.Module | str,
        grid: TaxelGrid,
        *,
        time: Time = "native",
        learning: Learning = "frozen",
        calibration: HandCalibration | None = None,
        seed: int = 0,
        pretrained: str | os.PathLike[str] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        check_name("time of an encoder", time, get_args(Time))
        check_name("way of learning of an encoder", learning, get_args(Learning))
        network, name = model, type(model).__name__
        if isinstance(model, str):
            network, name = load_model(model, seed=seed, pretrained=pretrained, **(options or {})), model
        if not isinstance(network, EncoderAttenderDecoder) or network.spec.input_shape[1:] != GRID_SHAPE:
            raise UsageError(
                f"A front end needs an encoder-attender-decoder network of steps [30, 5, 7]; received {name!r}."
            )
        if network.spec.max_steps is not None:
            raise UsageError(
                f"A policy runs without end, but this network remembers at most {network.spec.max_steps} steps; "
                "use one without a 'gpt' attender."
            )
        self.grid: TaxelGrid = grid
        self.learning: Learning = learning
        self.step: StreamingStep = StreamingStep(network)
        self.sub_steps: int = network.spec.sub_steps
        gains = torch.tensor((calibration or HandCalibration()).gains(self.sub_steps)).view(-1, 1, 1)
        self.register_buffer("gain", gains, persistent=False)
        values = network.spec.input_shape[0] // self.sub_steps * GRID_SHAPE[0] * GRID_SHAPE[1]
        self.resampler = Resampler(values, sub_steps=self.sub_steps) if time == "resampled" else None
        self.features: int = network.features
        """F."""
        held = self.features + self.resampler.state_size if self.resampler is not None else 0
        self.state_size: int = self.step.state_size + held
        """H."""
        # What classifies is no part of the features.
        network.decoder.requires_grad_(False)
        if learning == "frozen":
            self.step.requires_grad_(False)
            self.train(False)

    def train(self, mode: bool = True) -> FrontEnd:
        """Set training mode; a frozen network stays in evaluation mode."""
        super().train(mode and self.learning != "frozen")
        return self

    def stimulus(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return the network's input [B, 30, 5, 7] of readings [B, S, N, C], in the units of its own stimuli."""
        if taxels.ndim == 4 and taxels.shape[1] != self.sub_steps:
            raise UsageError(f"The encoder takes {self.sub_steps} sub-steps; received {taxels.shape[1]} readings.")
        return self.grid(taxels) * self.gain

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (features [B, F], h_out [B, H]) of one control step.

        With ``resampled`` time the features are those of the last step that the encoder completed, zeros before.
        """
        with torch.set_grad_enabled(torch.is_grad_enabled() and self.learning != "frozen"):
            stimulus = self.stimulus(taxels)
            if self.resampler is None:
                return self.step(stimulus, h_in)
            sizes = [self.step.state_size, self.features, self.resampler.state_size]
            state, held, clock = h_in.split(sizes, 1)
            readings, new, clock = self.resampler(stimulus.unflatten(1, (self.sub_steps, -1)).flatten(2), clock)
            features, after = self.step(readings.reshape(stimulus.shape), state)
            # The network is stepped in every row; rows whose resampled step is not complete keep their old state. A
            # branch would make rows depend on each other.
            features, state = torch.where(new, features, held), torch.where(new, after, state)
            return features, torch.cat((state, features, clock), 1)

    def init_state(self, batch: int) -> torch.Tensor:
        """Return the state [B, H] before the first step: zeros."""
        return self.gain.new_zeros(batch, self.state_size)
