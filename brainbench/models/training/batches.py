"""The sources of sweeps for training, the processes that share them (what torchrun says), and their augmentations.

Sweeps [B, T, S·C, H, W] in SI are augmented anew for every sample:

``physical`` mirrors the scene: dorsal and ventral (vertical), rostral and caudal (horizontal), both (a half turn),
and plays it backwards. Whiskers, forces and moments go together: forces are polar vectors, moments axial ones
(about each base point), and whiskers change places only among cells that hold one, so no signal is lost.

``thesis`` is the published behaviour: the same flips, quarter turns and time reversal of the grid of numbers, drawn
once per batch, without turning the vectors; a quarter turn of 5 × 7 is cropped and loses 28.6 % of the cells.

``image`` is the negative control: noise, blur, jitter and grey scale of pictures, which mean nothing to forces.

Axes are those of the stimuli: x to the right, y rostral, z dorsal; rows A–E run ventrally and columns 0–6 rostrally.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal, Protocol, runtime_checkable

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.contracts import CHANNELS, GRID_SHAPE
from brainbench.core.devices import torch_device
from brainbench.core.errors import DataError, UsageError, check_name
from brainbench.core.limits import Limit, limited
from brainbench.models.network import Normaliser

LAST_COLUMNS = (4, 4, 6, 6, 5)
"""Last whisker of rows A–E of the mouse (Bresee et al. 2023); columns count from 0, the other cells are empty."""
MOUSE = tuple(row * GRID_SHAPE[1] + col for row, last in enumerate(LAST_COLUMNS) for col in range(last + 1))
"""Cells of the grid, row · 7 + column, that hold a whisker of the mouse."""

_MIRRORED = {"vertical": "z", "horizontal": "y"}


@limited(of="{} of an augmentation")
class Augmentation:
    """Change of every sample at training time."""

    kind: Literal["none", "physical", "thesis", "image"] = "none"
    """``none``, ``physical``, ``thesis`` or ``image``."""
    masking: Annotated[float, Limit(least=0, below=1)] = 0.0
    """Share of the time steps that are set to zero (temporal masking; published with 0.75)."""
    cells: tuple[int, ...] = MOUSE
    """Cells of the grid that hold a whisker in these data, ascending; ``physical`` keeps to them."""
    axes: str = "world"
    """``world`` or ``follicle``: axes of forces and moments, which ``physical`` mirrors."""

    def __call__(self, x: torch.Tensor, generator: torch.Generator, *, part: tuple[int, int] = (0, 1)) -> torch.Tensor:
        """Return an augmented copy of sweeps [B, T, S·C, 5, 7] in SI.

        With a generator on the CPU, equal states give equal results on every device. With one on the device of ``x``
        nothing is moved, and the whole can be part of a CUDA graph. ``part`` is (rank, number) when ``x`` holds every
        number-th sweep of a larger batch, from rank on; each sweep is then treated as it would be in the whole batch.
        """
        draw = SampledAugmentation(generator, *part)
        y = KINDS[self.kind](x, draw, self)
        return mask_steps(y, self.masking, draw) if self.masking else y


@dataclass(frozen=True)
class SampledAugmentation:
    """Random numbers for the sweeps of one batch, or of this process's part of it."""

    generator: torch.Generator
    rank: int = 0
    parts: int = 1

    def uniform(self, count: int, *shape: int, draw: Callable[..., torch.Tensor] = torch.rand) -> torch.Tensor:
        """Return numbers in [0, 1) [count, *shape], or those of another of torch's generators."""
        every = draw(count * self.parts, *shape, generator=self.generator, device=self.generator.device)
        return every[self.rank :: self.parts]

    def coins(self, x: torch.Tensor, probability: float = 0.5) -> torch.Tensor:
        """Return one truth value per sweep of ``x``, [B, 1, …] to broadcast against it."""
        return (self.uniform(len(x)) < probability).to(x.device).view(-1, *(1,) * (x.ndim - 1))


def flip(x: torch.Tensor, direction: str, cells: tuple[int, ...] = MOUSE, axes: str = "world") -> torch.Tensor:
    """Mirror sweeps physically: ``vertical`` (z → −z) or ``horizontal`` (y → −y); ``cells`` hold whiskers.

    Follicle axes are mirrored with their whisker: what changes sign, for both directions, is their third axis, which
    stands on the plane of the whisker's curvature.
    """
    check_name("direction of a flip", direction, _MIRRORED)
    if x.ndim != 5 or x.shape[2] % len(CHANNELS) or tuple(x.shape[3:]) != GRID_SHAPE:
        raise UsageError(
            f"A physical flip needs sweeps [batch, time, sub-steps × {len(CHANNELS)}, {GRID_SHAPE[0]}, "
            f"{GRID_SHAPE[1]}]; received {list(x.shape)}."
        )
    # A mirror turns the normal part of a polar vector (force) and the tangential part of an axial one (moment).
    normal = _MIRRORED[direction] if axes == "world" else "z"
    signs = tuple(-1.0 if (name[1] == normal) == (name[0] == "F") else 1.0 for name in CHANNELS)
    turned = _constant(signs * (x.shape[2] // len(CHANNELS)), x.device).to(x.dtype)
    places = _constant(_places(direction, cells), x.device)
    return (x.flatten(3).index_select(3, places) * turned[:, None]).unflatten(3, GRID_SHAPE)


def reverse_time(x: torch.Tensor) -> torch.Tensor:
    """Play sweeps [B, T, S·C, H, W] backwards, sub-steps too; slow contact does not know the direction of time."""
    samples = x.unflatten(2, (-1, len(CHANNELS))).flatten(1, 2)
    return samples.flip(1).reshape(x.shape)


def mask_steps(x: torch.Tensor, share: float, draw: SampledAugmentation) -> torch.Tensor:
    """Set a share of the time steps of each sample to zero (rounded to whole steps, at least one step stays)."""
    batch, steps = x.shape[:2]
    count = min(round(share * steps), steps - 1)
    # A random order of the steps: those numbered below ``count`` go, exactly as many in every sample.
    order = draw.uniform(batch, steps).argsort(1)
    retained = (order >= count).to(device=x.device, dtype=x.dtype)
    return x * retained.view(batch, steps, *(1,) * (x.ndim - 2))


@cache
def _constant(values: tuple[float, ...], device: torch.device) -> torch.Tensor:
    """Return numbers on a device, where a step that is replayed as a CUDA graph must find them."""
    with torch.inference_mode(False):
        return torch.tensor(values, device=device)


@cache
def _places(direction: str, cells: tuple[int, ...]) -> tuple[int, ...]:
    """Return for every cell of the grid the cell whose whisker comes to it: the order of a row or column reversed."""
    rows, columns = GRID_SHAPE
    places = list(range(rows * columns))
    held = [divmod(cell, columns) for cell in cells]
    along = 0 if direction == "horizontal" else 1
    for which in range(GRID_SHAPE[along]):
        line = [row * columns + column for row, column in held if (row, column)[along] == which]
        for cell, source in zip(line, reversed(line), strict=True):
            places[cell] = source
    return tuple(places)


def _physical(x: torch.Tensor, draw: SampledAugmentation, how: Augmentation) -> torch.Tensor:
    # Both flips together are the half turn, so three fair coins draw the eight motions evenly.
    for direction in _MIRRORED:
        x = torch.where(draw.coins(x), flip(x, direction, how.cells, how.axes), x)
    return torch.where(draw.coins(x), reverse_time(x), x)


def _thesis(x: torch.Tensor, draw: SampledAugmentation, _how: Augmentation) -> torch.Tensor:
    drawn = torch.rand(4, generator=draw.generator, device=draw.generator.device).to(x.device)
    rows, columns = x.shape[3:]
    # Nothing is read back from the device: every outcome is a table, and the one drawn is looked up.
    vertical, horizontal = (drawn[:2] < 0.5).long()
    which = (vertical * 2 + horizontal) * 4 + (drawn[3] * 4).long()
    tables = _constant(_turned_places(rows, columns), x.device).view(16, -1)
    places = tables.index_select(0, which.view(1))[0]
    x = torch.where(drawn[2] < 0.5, x.flip(1), x).flatten(3)
    return (x.index_select(3, places.clamp_min(0)) * (places >= 0)).unflatten(3, (rows, columns))


@cache
def _turned_places(rows: int, columns: int) -> tuple[int, ...]:
    """Return for both flips and four turns (2 × 2 × 4 outcomes) each cell's source, −1 where the turn lost it."""
    margin = (columns - rows) // 2
    places: list[int] = []
    for dims in ((), (1,), (0,), (0, 1)):
        grid = torch.arange(rows * columns).view(rows, columns).flip(dims)
        for turns in range(4):
            turned = torch.rot90(grid, turns, (0, 1))
            if turns % 2:
                turned = functional.pad(turned[margin : margin + rows], (margin, margin), value=-1)
            places += turned.flatten().tolist()
    return tuple(places)


def _image(x: torch.Tensor, draw: SampledAugmentation, _how: Augmentation) -> torch.Tensor:
    # Pictures have one unit per pixel: work in the units the networks see.
    units = tuple(Normaliser.physical(x.shape[2] // len(CHANNELS)).scale.flatten().tolist())
    scale = _constant(units, x.device).to(x.dtype).view(-1, 1, 1)
    y = x / scale

    def _drawn(*shape: int) -> torch.Tensor:
        return draw.uniform(len(x), *shape).to(device=x.device, dtype=x.dtype)

    # Colour jitter: every channel its own brightness (offset) and contrast (gain).
    spread = y.flatten(1).std(1).view(-1, 1, 1, 1, 1)
    offset, gain = _drawn(1, x.shape[2], 1, 1), _drawn(1, x.shape[2], 1, 1)
    y = torch.where(draw.coins(x, 0.8), y * (0.6 + 0.8 * gain) + 0.4 * spread * (2 * offset - 1), y)
    y = torch.where(draw.coins(x, 0.2), y.mean(2, keepdim=True).expand_as(y), y)
    kernel = _constant((1.0, 2.0, 1.0), x.device).to(x.dtype)
    # Binomial blur [1 2 1]ᵀ[1 2 1]/16, each channel by itself.
    kernel = (kernel[:, None] * kernel / 16.0).expand(x.shape[2], 1, 3, 3)
    blurred = functional.conv2d(y.flatten(0, 1), kernel, padding=1, groups=x.shape[2]).unflatten(0, x.shape[:2])
    y = torch.where(draw.coins(x), blurred, y)
    noise = draw.uniform(*x.shape, draw=torch.randn).to(device=x.device, dtype=x.dtype)
    y = torch.where(draw.coins(x), y + 0.1 * spread * noise, y)
    return y * scale


KINDS: Mapping[str, Callable[[torch.Tensor, SampledAugmentation, Augmentation], torch.Tensor]] = {
    "none": lambda x, draw, how: x,
    "physical": _physical,
    "thesis": _thesis,
    "image": _image,
}


@dataclass(frozen=True)
class BatchOptions:
    """Division of a split into batches."""

    batch_size: int = 256
    """Sweeps per batch of all processes."""
    shuffle: bool = True
    """Draw the order from seed and epoch; else as given."""
    seed: int = 0
    part: tuple[int, int] = (0, 1)
    """(rank, number of processes)."""
    device: torch.device | str = "cpu"
    """Where the batches are used; they may come from elsewhere."""


class Batches(Protocol):
    """One epoch of (sweeps [B, T, S·C, H, W] in SI, labels [B]) per iteration, resumable between any two batches.

    Iterating goes on where the last iteration or the loaded state stopped and ends with the epoch; the length counts a
    whole epoch. With several processes each holds every number-th sweep of the whole batches, from its rank on.
    """

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]: ...

    def __len__(self) -> int: ...

    def state_dict(self) -> dict[str, Any]:
        """Return where the iteration stands, in plain values: the next batch."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state`` was taken."""


@runtime_checkable
class Data(Protocol):
    """A labelled data set with splits, as training needs it."""

    classes: tuple[str, ...]
    """Names of the classes; labels are indices into them."""
    summary: Mapping[str, Any]
    """Facts for the card of what is trained: ``hash``, ``left_out``, and the sweeps of ``train``, ``validation`` and
    ``test``; empty where they are unknown."""

    def batches(self, split: str, options: BatchOptions) -> Batches | None:
        """Return the batches of ``train``, ``validation`` or ``test``; None if there is no such split."""


@dataclass
class CheckedBatches:
    """Batches of others, of which every batch is checked before a network meets it."""

    batches: Batches
    split: str
    classes: int

    def __iter__(self) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        for batch in self.batches:
            yield self.checked(batch)

    def __len__(self) -> int:
        return len(self.batches)

    def state_dict(self) -> dict[str, Any]:
        """Return where the iteration stands."""
        return self.batches.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where ``state`` was taken."""
        self.batches.load_state_dict(state)

    def checked(self, batch: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the sweeps [B, ...] of a batch, those in double precision rounded to single, and its labels [B]."""
        pair = tuple(batch) if isinstance(batch, Sequence) else (batch,)
        if len(pair) != 2 or not all(isinstance(part, torch.Tensor) for part in pair):
            kinds = ", ".join(type(part).__name__ for part in pair[:4])
            raise self._error(f"is (sweeps, labels), two tensors; received {kinds}")
        x, labels = pair
        if not x.is_floating_point() or labels.is_floating_point() or labels.is_complex():
            raise self._error(f"has real sweeps and whole numbers as labels; received {x.dtype} and {labels.dtype}")
        if not len(x) or labels.shape != x.shape[:1]:
            raise self._error(f"has a label for each sweep; received shapes {[*x.shape]} and {[*labels.shape]}")
        low, high = (int(end) for end in labels.aminmax())
        if low < 0 or high >= self.classes:
            wrong = low if low < 0 else high
            raise self._error(f"has labels from 0 to {self.classes - 1}, one for each class; received {wrong}")
        return x.float() if x.dtype == torch.float64 else x, labels.long()

    def _error(self, text: str) -> DataError:
        return DataError(f"A batch of the split {self.split!r} {text}.")


@dataclass(frozen=True)
class Processes:
    """This process among those of the run."""

    rank: int
    count: int
    device: torch.device

    @property
    def part(self) -> tuple[int, int]:
        """(rank, number): which sweeps of a batch are this process's."""
        return self.rank, self.count

    @property
    def first(self) -> bool:
        """True in the process that writes files and shows progress."""
        return self.rank == 0

    def average(self, vector: torch.Tensor) -> None:
        """Replace a vector by its mean over processes.

        With equal shares of a batch, the mean of the gradients is that of the whole batch's mean loss.
        """
        torch.distributed.all_reduce(vector)
        vector.div_(self.count)

    def prepare(self, module: nn.Module) -> nn.Module:
        """Return the module on its device, with batch norms that pool over processes."""
        if self.count > 1 and any(isinstance(m, nn.modules.batchnorm._BatchNorm) for m in module.modules()):
            if self.device.type != "cuda":
                raise UsageError(
                    "Several processes on the CPU would each normalise over their own part of a batch; train a "
                    "network with batch norms in one process, or on CUDA."
                )
            module = nn.SyncBatchNorm.convert_sync_batchnorm(module)
        return module.to(self.device)

    def mean(self, value: float) -> float:
        """Return the mean of a number over processes."""
        if self.count == 1:
            return value
        total = torch.tensor([value], dtype=torch.float64, device=self.device)
        # Every process must come here equally often, or the others wait for ever.
        self.average(total)
        return float(total)

    def any(self, *flags: bool) -> tuple[bool, ...]:
        """Return for each flag whether it is up in any process."""
        if self.count == 1:
            return flags
        total = torch.tensor(flags, dtype=torch.int32, device=self.device)
        torch.distributed.all_reduce(total, op=torch.distributed.ReduceOp.MAX)
        return tuple(bool(value) for value in total.tolist())

    def wait(self) -> None:
        """Wait until all processes have come here."""
        if self.count > 1:
            # NCCL guesses a device, and warns, unless it is told.
            ids = [self.device.index] if self.device.type == "cuda" else None
            torch.distributed.barrier(device_ids=ids)


@contextmanager
def processes(device: str | None = None) -> Iterator[Processes]:
    """Join the processes that torchrun started, or be the only one; without a device's name CUDA when there is one."""
    where = torch_device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
    count, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    if where.type == "cuda":
        if where.index is None:
            where = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(where)
    if count == 1:
        yield Processes(0, 1, where)
        return
    if where.type == "cuda":
        torch.distributed.init_process_group("nccl", device_id=where)
    else:
        torch.distributed.init_process_group("gloo")
    try:
        yield Processes(rank, count, where)
    finally:
        torch.distributed.destroy_process_group()
