"""All tactile encoders of the comparison under one form: (readings [B, S, N, C], h_in [B, H]) → ([B, F], h_out).

Small ones are learned with the policy; any other name is a network of :func:`brainbench.load_model`, the same object
that a leaderboard ranks. A state of zeros is the one before the first step, and rows are independent. ``published``
sizes are those of the thesis (section 4.3.4). Letters: B batch, S sub-step, N item, C channel, F feature, H state.

Recurrent parts: a convolutional GRU as matrix products, a random echo-state network, norms of features. Letters:
N picture, C channel, P = rows × columns cell, L step, B batch, I input, U unit, F feature.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, field, fields
from functools import partial
from typing import Annotated, Any

import torch
from torch import nn

from brainbench.core.contracts import GRID_SHAPE
from brainbench.core.errors import UsageError, brief, check_each, check_kind, unknown_name
from brainbench.core.limits import Limit, Seed, limited
from brainbench.models.cells import FORGET_BIAS, GRU
from brainbench.models.recipes import Architecture
from brainbench.models.registry import list_models
from robotics_bridge import hands
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.policies.encoders.taxel_grid import (
    FrontEnd,
    HandCalibration,
    Learning,
    TaxelGraph,
    TaxelGrid,
    Time,
)

MOST_CELLS = 64
"""Cells of a picture beyond which the products outweigh what they save (they grow with the square of P)."""


class ConvGRUProducts(nn.Module):
    """Steps of a :class:`~brainbench.models.cells.GRU` with layer norm and an odd square kernel; it has no weights.

    On pictures of a few cells a convolution reads little and launches much, and layer norm over 16 channels takes
    longer than both. Here each convolution is one product with a matrix that holds its kernel at every place; the mean
    over channels, which layer norm takes away, is taken out of that matrix once. Weights are those of the cell itself.
    """

    places: torch.Tensor
    """[kernel², P, P]: whether cell p stands at this place of the kernel around cell q."""

    def __init__(self, rows: int, columns: int, kernel: int) -> None:
        super().__init__()
        cells = torch.arange(rows * columns)
        # Offset from cell q to cell p as a place of the kernel; places outside belong to no product, which pads with
        # zeros.
        down = cells[:, None] // columns - cells[None, :] // columns + kernel // 2
        right = cells[:, None] % columns - cells[None, :] % columns + kernel // 2
        inside = (down >= 0) & (down < kernel) & (right >= 0) & (right < kernel)
        place = torch.where(inside, down * kernel + right, -1)
        places = torch.stack([(place == index).float() for index in range(kernel**2)])
        self.register_buffer("places", places, persistent=False)

    def forward(
        self, cell: GRU, x: torch.Tensor, state: torch.Tensor, ended: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (y [L, N, C·P], state [N, C·P] single) of pictures x [L, N, inputs·P] from a state.

        The state is forgotten after a step where ``ended`` [L, N]; None for nowhere.
        """
        gates, candidate = self._gates(cell, ("r", "u")), self._gates(cell, ("c",))
        kind = torch.get_autocast_dtype(x.device.type) if torch.is_autocast_enabled(x.device.type) else x.dtype
        with torch.autocast(x.device.type, enabled=False):
            inputs = cell.in_channels * len(self.places[0])
            split = [matrix.to(kind).split([inputs, len(matrix) - inputs]) for matrix, _ in (gates, candidate)]
            flat, states = x.flatten(0, 1).to(kind), []
            shares = [
                torch.addmm(bias.to(kind), flat, parts[0]).unflatten(0, x.shape[:2])
                for parts, (_, bias) in zip(split, (gates, candidate), strict=True)
            ]
            for step in range(len(x)):
                fused = torch.addmm(shares[0][step], state.to(kind), split[0][1])
                reset, keep = self._normalised(cell, fused, ("r", "u"))
                remembered = torch.sigmoid(reset + FORGET_BIAS) * state.to(kind)
                new = self._normalised(cell, torch.addmm(shares[1][step], remembered, split[1][1]), ("c",))[0]
                # h = u h + (1 − u) c. The state stays in single precision, since small updates vanish in half
                # precision.
                state = torch.lerp(torch.tanh(new).float(), state.float(), torch.sigmoid(keep).float())
                states.append(state)
                if ended is not None:
                    state = torch.where(ended[step][:, None], 0.0, state)
        return torch.stack(states), state

    def _gates(self, cell: GRU, names: tuple[str, ...]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the matrix [(inputs + C)·P, gates·C·P] and bias of some gates, without their mean over channels."""
        conv = cell.candidate if names == ("c",) else cell.conv
        assert conv.bias is not None
        weight = conv.weight.float().unflatten(0, (len(names), -1))
        bias = conv.bias.float().unflatten(0, (len(names), -1))
        # Layer norm subtracts the mean over channels, which is linear: taken out of the weights, it costs nothing per
        # step.
        weight, bias = weight - weight.mean(1, keepdim=True), bias - bias.mean(1, keepdim=True)
        # The convolution as a dense matrix over all pairs of cells, in one product with the places of the kernel.
        everywhere = weight.flatten(3).flatten(0, 1) @ self.places.flatten(1)  # [O, I, P·P]
        cells = len(self.places[0])
        matrix = everywhere.unflatten(2, (cells, cells)).permute(1, 2, 0, 3).flatten(2).flatten(0, 1)
        return matrix, bias.flatten().repeat_interleave(cells)

    def _normalised(self, cell: GRU, fused: torch.Tensor, names: tuple[str, ...]) -> list[torch.Tensor]:
        """Return the gates [N, C·P] of centred pre-activations [N, gates·C·P] (Ba et al. 2016)."""
        norms = [cell.norms[name] for name in names]
        parts = fused.unflatten(1, (len(names), cell.out_channels, -1))
        # The mean is gone already, so the variance is the mean square; its sum is taken in single precision.
        size = torch.linalg.vector_norm(parts, dim=2, keepdim=True, dtype=torch.float32)
        scale = torch.rsqrt(size.square() / cell.out_channels + norms[0].eps).to(fused.dtype)  # type: ignore[operator]
        gain, bias = (torch.stack([getattr(norm, name) for norm in norms])[..., None] for name in ("weight", "bias"))
        whole = torch.addcmul(bias.to(fused.dtype), parts * scale, gain.to(fused.dtype))
        return [part.flatten(1) for part in whole.unbind(1)]


UNITS = 96
"""Units of a reservoir, as many as the features of the small networks."""
_LEAK, _RADIUS, _OFFSET = 0.5, 0.9, 0.1
_FARTHEST = 10.0  # standard deviations to which features are cut


class EchoState(nn.Module):
    """A random recurrent network that learns nothing: x ← (1 − a) x + a tanh(u + W x + b), spectral radius .9.

    The same seed gives the same network on every machine.
    """

    inputs: torch.Tensor
    """[I, U]: standard normal."""
    inner: torch.Tensor
    offset: torch.Tensor

    def __init__(self, inputs: int, units: int = UNITS, *, seed: int = 0) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randn(inputs, units, generator=generator)
        inner = torch.randn(units, units, generator=generator)
        inner *= _RADIUS / torch.linalg.eigvals(inner).abs().max()
        offset = _OFFSET * torch.randn(units, generator=generator)
        for name, value in (("inputs", drawn), ("inner", inner), ("offset", offset)):
            # Not weights: they follow from the seed, so files of weights need not hold them.
            self.register_buffer(name, value, persistent=False)

    def drive(self, x: torch.Tensor) -> torch.Tensor:
        """Return the drive u [B, U] of inputs [B, I] of which those that are not silent have an rms of 1.

        A quarter of a hand's sites or fewer are touched at a time, so that it is of the order of 1.
        """
        return 2.0 * x.shape[-1] ** -0.5 * (x @ self.inputs)

    def forward(self, drive: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Return the state [B, U] after one step of a drive u [B, U]."""
        return (1 - _LEAK) * state + _LEAK * torch.tanh(drive + state @ self.inner + self.offset)


class FeatureNorm(nn.Module):
    """Features [..., F] less their mean over their standard deviation, over all that was counted in training mode.

    Unlike layer norm it takes away what is the same in every step, and unlike batch norm it acts alike in training and
    after it. Features are counted as they come, or with :attr:`held` at the next :meth:`settle`.
    """

    count: torch.Tensor
    mean: torch.Tensor
    square: torch.Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(1, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(features, dtype=torch.float64))
        self.register_buffer("square", torch.ones(features, dtype=torch.float64))
        self.held: list[torch.Tensor] | None = None
        """Features that are yet to be counted; None counts each at once."""

    def settle(self) -> None:
        """Count what was held."""
        while self.held:
            self._count(self.held.pop(0))

    @torch.no_grad()
    def _count(self, x: torch.Tensor) -> None:
        flat = x.reshape(-1, x.shape[-1]).double()
        self.count += len(flat)
        share = len(flat) / self.count
        self.mean += share * (flat.mean(0) - self.mean)
        self.square += share * (flat.square().mean(0) - self.square)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the standardised features [B, F]; in training mode they are counted first, or held."""
        if self.training:
            count = self._count if self.held is None else self.held.append
            count(x.detach())
        spread = (self.square - self.mean.square()).clamp(min=0).sqrt()
        # Features of untrained networks are small by orders of magnitude, so what counts as constant is relative: to
        # the other features, and to the feature's own mean, of which single precision keeps seven digits.
        spread = torch.maximum(spread, 1e-6 * spread.max())
        spread = torch.maximum(spread, 1e-2 * self.mean.abs()).clamp(min=1e-30)
        return ((x.float() - self.mean.float()) / spread.float()).clamp(-_FARTHEST, _FARTHEST)


AUTO = "auto"  # the published choice: `tactile_convrnn` where every link has a grid of taxels, `rnn` elsewhere
_HIDDEN, _CHANNELS, _KERNEL = 64, (16, 32), 3
_OF_NETWORKS = ("time", "learning", "pretrained", "options", "calibration")
"""Settings that encoders which are learned with the policy, and the reservoir, do not have."""
_COUNTED = 1 << 24  # values per channel whose squares are added up at a time
_Width = Annotated[int, Limit(least=1, most=8192)]
Stepped = tuple[torch.Tensor, torch.Tensor]  # what a step gives, and the memory after it


@limited(of="'{}' of a tactile encoder", kw_only=True)
class EncoderConfig:
    """A tactile encoder and what it reads; plain values only, so that it can stand in a file."""

    name: str = AUTO
    """An arm (:data:`ARMS`), or the name of a network."""
    hand: str = "xhand1"
    """Name or file of the hand whose taxels it reads; the next three as of a student."""
    observe: str = "force_torque"
    placement: str = "hand"
    resolution: str = "med"
    slots: Annotated[int, Limit(least=1, most=1000)] = 5
    """S, physics steps in a control step."""
    features: _Width = 32
    """F: size of the embedding that the head gets."""
    units: _Width = _HIDDEN
    """Units of the LSTM of the arm ``rnn``."""
    time: Time = "native"
    """Clock of a network: ``native``, or ``resampled`` to its own 9 ms."""
    learning: Learning = "frozen"
    """Learning of a network: ``frozen`` or ``finetuned``."""
    seed: Seed = 0
    """Seed of an untrained network or of a reservoir; by default that of the student."""
    pretrained: str | None = None
    """Weights of a network with a tag."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the builder of a network, such as ``{"unroll": "full"}``."""
    calibration: HandCalibration = field(default_factory=HandCalibration)
    """Force and moment that are one unit to a network."""

    def __post_init__(self) -> None:
        # Equal to its default a setting may stand anywhere: a configuration in a file holds them all.
        owner = {"units": "'rnn'"} if self.arm != "rnn" else {}
        owner |= dict.fromkeys(_OF_NETWORKS, "a network (brainbench models list)") if self.arm in ARMS else {}
        for setting in fields(self):
            value, default = getattr(self, setting.name), setting.default
            if setting.default_factory is not MISSING:
                default = setting.default_factory()
            if setting.name in owner and value != default:
                raise UsageError(
                    f"{setting.name!r} = {brief(value)} is for the tactile encoder {owner[setting.name]}; {self.arm!r} "
                    "has no such setting. Leave it out."
                )

    @classmethod
    def of(cls, value: Mapping[str, Any] | EncoderConfig) -> EncoderConfig:
        """Return a configuration from a mapping of its fields; raise UsageError for a field that does not exist."""
        if isinstance(value, EncoderConfig):
            return value
        check_each("setting of a tactile encoder", value, cls.__dataclass_fields__)
        unit = value.get("calibration") or {}
        if not isinstance(unit, HandCalibration):
            check_kind("calibration of a tactile encoder", unit, Mapping, "a mapping of 'force' and 'moment'")
            check_each("field of a hand calibration", unit, HandCalibration.__dataclass_fields__)
            unit = HandCalibration(**unit)
        return cls(**{**value, "calibration": unit})

    @property
    def arm(self) -> str:
        """The name, with ``auto`` resolved."""
        if self.name != AUTO:
            return self.name
        return "rnn" if observation_type(self.observe).per_link else "tactile_convrnn"

    def grid(self) -> TaxelGrid:
        """Return the map from these readings to the grid of the hand."""
        return TaxelGrid(self.hand, placement=self.placement, resolution=self.resolution, observe=self.observe)

    def graph(self) -> TaxelGraph:
        """Return the map from these readings to the patterns of the graph of taxels."""
        return TaxelGraph(hands.load(self.hand).layout(self.resolution, self.placement), self.observe)

    def build(self) -> TactileEncoder:
        """Return the encoder with new weights (the global random state), or a network's own."""
        if self.arm in ARMS:
            return ARMS[self.arm](self)
        if ":" not in self.arm and Architecture.parse(self.arm).untrained not in list_models():
            raise unknown_name(
                "tactile encoder", self.arm, (*ARMS, *list_models()), hint="See networks with: brainbench models list"
            )
        return _Network(self)


def elu_perceptron(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    """Return a multilayer perceptron with ELU between its layers."""
    sizes = (inputs, *hidden)
    layers = [part for a, b in zip(sizes, hidden, strict=False) for part in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


def recur(step: Callable[..., Stepped], x: torch.Tensor, state: torch.Tensor, ended: torch.Tensor | None) -> Stepped:
    """Return what a step (x, state) → (y, state) gives of inputs x [L, B, …], and the state [B, H] after the last.

    The state is forgotten after a step where ``ended`` [L, B]; None for nowhere.
    """
    outputs = []
    for index, each in enumerate(x):
        y, state = step(each, state)
        outputs.append(y)
        if ended is not None:
            state = torch.where(ended[index][:, None], 0.0, state)
    return torch.stack(outputs), state


class TactileEncoder(nn.Module):
    """Base of all arms; the configuration fixes :attr:`shape` and the state."""

    state_size: int = 0
    """H."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.config = config
        self.features: int = config.features
        kind = observation_type(config.observe)
        layout = hands.load(config.hand).layout(config.resolution, config.placement)
        counts = [1 if kind.per_link else int(probes.active.sum()) for probes in layout.values()]
        self.shape: tuple[int, int, int] = (config.slots, sum(counts), kind.channels)
        """(S, N, C)."""

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> Stepped:
        """Return (embedding [B, F], h_out [B, H])."""
        raise NotImplementedError

    def unroll(self, taxels: torch.Tensor, h_in: torch.Tensor, ended: torch.Tensor | None = None) -> Stepped:
        """Return (embeddings [L, B, F], h_out [B, H]) of readings [L, B, S, N, C], in few and large products.

        The memory is forgotten after a step where ``ended`` [L, B]; None for nowhere.
        """
        return recur(self, taxels, h_in, ended)

    @property
    def frozen_part(self) -> FrontEnd | None:
        """The part without gradients, None without one; :meth:`unroll` takes its features [L, B, F] for readings too.

        So they can be computed once and kept.
        """
        return None

    def observe_scale(self, taxels: torch.Tensor) -> None:
        """Take readings [T, B, S, N, C] into account in the scale of the input."""


class RunningScale(nn.Module):
    """x / rms per channel (last axis), with that of all values seen that are not zero; silence stays silence."""

    total: torch.Tensor
    count: torch.Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name in ("total", "count"):
            self.register_buffer(name, torch.zeros(channels, dtype=torch.float64))

    def update(self, x: torch.Tensor) -> None:
        """Count values [..., C]; those that are not finite are left out."""
        # In parts: in double precision, a rollout of many taxels would fill a GPU.
        for flat in x.detach().reshape(-1, x.shape[-1]).split(_COUNTED):
            used = (flat != 0) & torch.isfinite(flat)
            self.total += torch.where(used, flat, 0).double().pow(2).sum(0)
            self.count += used.sum(0)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the values divided by their root mean square, in their shape."""
        # Root mean square instead of a standard deviation: taxels rest at zero, and the zero must stay where it is.
        mean = torch.where(self.count > 0, self.total / self.count.clamp(min=1), 1.0).clamp(min=1e-24)
        return x / mean.sqrt().to(x.dtype)


class _Learned(TactileEncoder):
    def __init__(self, config: EncoderConfig) -> None:
        super().__init__(config)
        self.scale = RunningScale(self.shape[2])

    def observe_scale(self, taxels: torch.Tensor) -> None:
        """Count readings [..., C], each channel by itself."""
        self.scale.update(taxels)

    def unroll(self, taxels: torch.Tensor, h_in: torch.Tensor, ended: torch.Tensor | None = None) -> Stepped:
        """Return (embeddings [L, B, F], h_out [B, H]); without memory from one batch of L · B readings."""
        if self.state_size:
            return super().unroll(taxels, h_in, ended)
        # Without memory all steps are one batch.
        y, _ = self(taxels.flatten(0, 1), h_in)
        return y.unflatten(0, taxels.shape[:2]), h_in


class _Flat(_Learned):
    """A multilayer perceptron on all values; published hidden sizes 64 and 64."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__(config)
        slots, items, channels = self.shape
        self.net = elu_perceptron(slots * items * channels, (_HIDDEN, _HIDDEN), self.features)

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (embedding [B, F], ``h_in`` [B, 0]) of readings [B, S, N, C]."""
        return self.net(self.scale(taxels).flatten(1)), h_in


class _Recurrent(_Learned):
    """An LSTM on all values; published hidden size 64."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__(config)
        slots, items, channels = self.shape
        self.state_size = 2 * config.units
        self.cell = nn.LSTMCell(slots * items * channels, config.units)
        self.head = nn.Linear(config.units, self.features)

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (embedding [B, F], h_out [B, 2 · units]), hidden state and memory side by side."""
        # Both states of the LSTM travel in one array, as exported policies pass all memory through one input.
        hidden, memory = h_in.chunk(2, 1)
        hidden, memory = self.cell(self.scale(taxels).flatten(1), (hidden, memory))
        return self.head(hidden), torch.cat((hidden, memory), 1)


class _Images(_Learned):
    """Base of the convolutional arms: the readings as images, one per link, or one of the whole hand."""

    index: torch.Tensor  # item in every cell of every link's image; N for none
    head: nn.Linear

    def __init__(self, config: EncoderConfig, *, canvas: bool = False) -> None:
        super().__init__(config)
        self.canvas = canvas
        slots, items, channels = self.shape
        if self.canvas:
            # Wrenches of sites differ from readings of taxels, so they have a scale of their own.
            self.grid, self.scale = config.grid(), RunningScale(6)
            self.images, self.rows, self.columns, self.planes = 1, *GRID_SHAPE, 6 * slots
            return
        layout = hands.load(config.hand).layout(config.resolution, config.placement)
        shapes = [probes.shape for probes in layout.values()]
        if observation_type(config.observe).per_link or any(len(shape) != 2 for shape in shapes):
            raise UsageError(
                f"{config.arm!r} needs a grid of taxels on every link, which {config.observe!r} of this layout does "
                "not give; use 'mlp', 'rnn' or a canvas."
            )
        self.images, self.planes = len(layout), slots * channels
        self.rows, self.columns = map(max, zip(*shapes, strict=True))
        index = torch.full((self.images, self.rows, self.columns), items, dtype=torch.long)
        first = 0
        for image, probes in enumerate(layout.values()):
            active = torch.from_numpy(probes.active.copy()).view(probes.shape)
            rows, columns = probes.shape
            index[image, :rows, :columns][active] = torch.arange(first, first + int(active.sum()))
            first += int(active.sum())
        self.register_buffer("index", index.flatten(), persistent=False)

    def observe_scale(self, taxels: torch.Tensor) -> None:
        """Count readings [..., C], or on a canvas the six components of their wrenches."""
        self.scale.update(self.grid.wrenches(taxels.flatten(0, -4)) if self.canvas else taxels)

    def pictures(self, taxels: torch.Tensor) -> torch.Tensor:
        """Return images [B·images, planes, rows, columns]."""
        if self.canvas:
            return self.scale(self.grid.wrenches(taxels)).movedim(-1, 2).flatten(1, 2)
        planes = self.scale(taxels).permute(0, 1, 3, 2).flatten(1, 2)
        # Fillers point at one item more than there are, a zero: a single gather lays out all links.
        cells = torch.cat((planes, torch.zeros_like(planes[..., :1])), 2)[..., self.index]
        return cells.unflatten(2, (self.images, self.rows, self.columns)).transpose(1, 2).flatten(0, 1)

    def _head_of(self, channels: int) -> nn.Linear:
        # A canvas is one picture whose places differ in meaning; a link's grid is read as a whole.
        return nn.Linear(channels * (self.rows * self.columns if self.canvas else self.images), self.features)

    def answer(self, maps: torch.Tensor, batch: int) -> torch.Tensor:
        """Return the embedding [batch, F] of maps [batch·images, channels, rows, columns]."""
        return self.head((maps if self.canvas else maps.mean((2, 3))).reshape(batch, -1))


class _Convolution(_Images):
    """Two convolutions (published channels 16 and 32, kernel 3) on each link's grid, averaged over it."""

    def __init__(self, config: EncoderConfig, *, canvas: bool = False) -> None:
        super().__init__(config, canvas=canvas)
        first, second = _CHANNELS
        self.net = nn.Sequential(
            nn.Conv2d(self.planes, first, _KERNEL, padding=1), nn.ELU(),
            nn.Conv2d(first, second, _KERNEL, padding=1), nn.ELU(),
        )  # fmt: skip
        self.head = self._head_of(second)

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (embedding [B, F], ``h_in`` [B, 0]) of readings [B, S, N, C]."""
        return self.answer(self.net(self.pictures(taxels)), taxels.shape[0]), h_in


class _ConvRecurrent(_Images):
    """A convolutional gated recurrent cell (published: 16 channels, kernel 3, layer norm) on each link's grid."""

    def __init__(self, config: EncoderConfig, *, canvas: bool = False) -> None:
        super().__init__(config, canvas=canvas)
        self.cell = GRU(self.planes, _CHANNELS[0], kernel_size=_KERNEL, layer_norm=True)
        self.head = self._head_of(_CHANNELS[0])
        self.state_size = self.images * _CHANNELS[0] * self.rows * self.columns
        small = self.rows * self.columns <= MOST_CELLS
        self.products: ConvGRUProducts | None = ConvGRUProducts(self.rows, self.columns, _KERNEL) if small else None

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (embedding [B, F], h_out [B, images · channels · rows · columns])."""
        state = h_in.reshape(-1, _CHANNELS[0], self.rows, self.columns)
        y, state = self.cell(self.pictures(taxels), state)
        return self.answer(y, taxels.shape[0]), state.reshape(h_in.shape)

    def unroll(self, taxels: torch.Tensor, h_in: torch.Tensor, ended: torch.Tensor | None = None) -> Stepped:
        """Return (embeddings [L, B, F], h_out [B, H]), on a GPU by matrix products for small images."""
        # Processors convolve faster than they multiply.
        if self.products is None or not taxels.is_cuda:
            return super().unroll(taxels, h_in, ended)
        return self.unroll_as_products(taxels, h_in, ended)

    def unroll_as_products(
        self, taxels: torch.Tensor, h_in: torch.Tensor, ended: torch.Tensor | None = None
    ) -> Stepped:
        """Return what :meth:`unroll` returns, by matrix products."""
        assert self.products is not None
        steps, batch = taxels.shape[:2]
        pictures = self.pictures(taxels.flatten(0, 1)).flatten(1).unflatten(0, (steps, -1))
        gone = None if ended is None else ended.repeat_interleave(self.images, 1)
        y, state = self.products(self.cell, pictures, h_in.reshape(pictures.shape[1], -1), gone)
        y = y.flatten(0, 1).unflatten(1, (-1, self.rows, self.columns))
        return self.answer(y, steps * batch).unflatten(0, (steps, batch)), state.reshape(h_in.shape)


class _Network(TactileEncoder):
    """A scored network, normalised features, and a learned linear map to the embedding."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__(config)
        self.front: FrontEnd = FrontEnd(
            config.arm, config.grid(), time=config.time, learning=config.learning, calibration=config.calibration,
            seed=config.seed, pretrained=config.pretrained, options=config.options,
        )  # fmt: skip
        self.state_size = self.front.state_size
        # One by one: layer norm would leave what never changes, 98 % of the energy of trained features.
        self.norm: FeatureNorm = FeatureNorm(self.front.features)
        self.project: nn.Linear = nn.Linear(self.front.features, self.features)

    @property
    def frozen_part(self) -> FrontEnd | None:
        """The network with its input, None where it learns with the policy."""
        return self.front if self.config.learning == "frozen" else None

    def unroll(self, taxels: torch.Tensor, h_in: torch.Tensor, ended: torch.Tensor | None = None) -> Stepped:
        """Return (embeddings [L, B, F], h_out [B, H]) of readings [L, B, S, N, C] or features [L, B, F]."""
        if taxels.ndim == 3:
            return self.project(self.norm(taxels)), h_in
        return super().unroll(taxels, h_in, ended)

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (embedding [B, F], h_out [B, H]), the latter the packed state of the network."""
        features, h_out = self.front(taxels, h_in)
        return self.project(self.norm(features)), h_out


class _Reservoir(TactileEncoder):
    """A random recurrent network on the hand's grid, and a learned linear map to the embedding: what chance gives."""

    state_size = UNITS

    def __init__(self, config: EncoderConfig, *, graph: bool = False) -> None:
        super().__init__(config)
        self.grid, self.scale = config.graph() if graph else config.grid(), RunningScale(6)
        self.echo = EchoState(6 * config.slots * self.grid.cells, seed=config.seed)
        self.norm, self.project = FeatureNorm(UNITS), nn.Linear(UNITS, self.features)

    def observe_scale(self, taxels: torch.Tensor) -> None:
        """Count readings [T, B, S, N, C] as wrenches of the cells, each component by itself."""
        self.scale.update(self.grid.wrenches(taxels.flatten(0, -4)))

    def forward(self, taxels: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (embedding [B, F], h_out [B, units]) of readings [B, S, N, C]."""
        felt = self.scale(self.grid.wrenches(taxels)).flatten(1)
        h_out = self.echo(self.echo.drive(felt), h_in)
        return self.project(self.norm(h_out)), h_out


ARMS: Mapping[str, Callable[[EncoderConfig], TactileEncoder]] = {
    "mlp": _Flat,
    "rnn": _Recurrent,
    "tactile_cnn": _Convolution,
    "tactile_convrnn": _ConvRecurrent,
    "tactile_canvas_cnn": partial(_Convolution, canvas=True),
    "tactile_canvas_convrnn": partial(_ConvRecurrent, canvas=True),
    "reservoir": _Reservoir,
    "reservoir_graph": partial(_Reservoir, graph=True),
}
"""Encoders that are learned with the policy, by their published names (``canvas``: on the 5 × 7 grid of the hand), and
``reservoir``, a random one to hold the others against; ``reservoir_graph`` reads the graph of taxels for the grid."""
