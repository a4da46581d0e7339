"""Proof of what a captured tensor is: which of its axes holds the stimuli, and which their time steps.

Networks of others return tensors of any layout, and a shape alone says little: 16 slots, 16 tokens and a batch of 16
look alike. So a copy of the network that has never run gets probes, in two small batches of unequal size and another
order. The stimulus axis is the one whose rows follow their probes from place to place; the time axis is the one that
moves when probes are changed late, or are shifted, in time. Later a random sample of the stimuli has to give the rows
that it gave among all others. What fails here is not a response, whatever its shape.

Letters: B batch, T time step, F feature.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.utils.parametrize import is_parametrized

from brainbench.core.reading.regular import temporary_folder

BASE, LATE, SHIFTED, PAIR, PAIR_SHIFTED = range(5)
"""Rows of the first batch of probes: two probes, both of them shifted by one step, and the first one changed late."""
FIRST, SECOND = (BASE, LATE, SHIFTED, PAIR, PAIR_SHIFTED), (PAIR, None, BASE)
"""Both batches of probes; None is a stimulus as it is."""
NO_AXIS = "no axis of it follows the stimuli"
UNMOVED = "does not move with the stimuli"
DEPENDENT = "its rows depend on the batch: on other stimuli, their place, chance or what ran before"
SHIFT = 0.7  # change by a shift that the shift explains leaves less than this of what it is without it
_LARGE = 1 << 24  # numbers of which no second copy is made
_BLOCKS = 256  # numbers that stand for a row where two runs are compared


@dataclass(frozen=True)
class Layout:
    """Place of the stimuli and of their time steps in a tensor."""

    axis: int
    """Axis of the stimuli."""
    outer: int = 1
    """Length of what is joined with the stimuli before them, [outer · B, …]."""
    inner: int = 1
    """Length of what is joined with them behind them, [B · inner, …]."""
    rest: tuple[int, ...] = ()
    """Lengths of the other axes."""
    time: tuple[int, int] | None = None
    """Axis of the time steps, counted after the stimuli were put first and split from what they are joined with, and
    the length of what is joined with time before it; None for no time."""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Lengths of the axes of each stimulus."""
        return (*self.rest[: self.axis], self.outer, self.inner, *self.rest[self.axis :])

    def fits(self, shape: tuple[int, ...], batch: int) -> bool:
        """Return whether a tensor of a batch has this layout."""
        return shape == (*self.rest[: self.axis], self.outer * batch * self.inner, *self.rest[self.axis :])

    def split(self, tensor: torch.Tensor, batch: int) -> torch.Tensor:
        """Return [B, …] with what is joined with the stimuli as axes of their own."""
        return tensor.unflatten(self.axis, (self.outer, batch, self.inner)).movedim(self.axis + 1, 0)

    def rows(self, tensor: torch.Tensor, batch: int, steps: int) -> torch.Tensor:
        """Return [B, T, F]; T = 1 without time."""
        rows = self.split(tensor, batch)
        if self.time is None:
            return rows.reshape(batch, 1, -1)
        axis, before = self.time
        return rows.unflatten(axis, (before, steps, -1)).movedim(axis + 1, 1).reshape(batch, steps, -1)


def layouts(first: tuple[int, ...], second: tuple[int, ...], batches: tuple[int, int]) -> Iterator[Layout]:
    """Yield the layouts that the shapes of one tensor in two batches allow."""
    if len(first) != len(second):
        return
    for axis, (length, again) in enumerate(zip(first, second, strict=True)):
        rest = (*first[:axis], *first[axis + 1 :])
        count, uneven = divmod(length, batches[0])
        if uneven or not count or again != count * batches[1] or rest != (*second[:axis], *second[axis + 1 :]):
            continue
        for outer in range(1, count + 1):
            if count % outer == 0:
                yield Layout(axis, outer, count // outer, rest)


def probes(stimuli: torch.Tensor, steps: int) -> dict[int, torch.Tensor]:
    """Return the probes [T, …] by their row, from stimuli [B, T, …]: two of them with noise of their size in all steps.

    Noise tells steps and stimuli apart even where the stimuli are alike, such as at rest.
    """
    generator = torch.Generator().manual_seed(0)
    values = stimuli.double()
    values = torch.where(values.isfinite(), values, 0.0)
    size = values.square().mean((0, 1)).sqrt()
    size = size if bool(size.any()) else torch.ones_like(size)

    def _noise(length: int) -> torch.Tensor:
        return torch.randn((length, *size.shape), generator=generator, dtype=torch.float64) * size

    base, pair = values[0] + _noise(steps), values[-1] + _noise(steps)
    late, half = base.clone(), steps // 2
    late[half:] += _noise(steps - half)
    head = _noise(1)
    shifted, pair_shifted = (torch.cat([head, row[:-1]]) for row in (base, pair))
    return {BASE: base, LATE: late, SHIFTED: shifted, PAIR: pair, PAIR_SHIFTED: pair_shifted}


def same(left: torch.Tensor, right: torch.Tensor, spread: float) -> bool:
    """Return whether tensors are equal but for rounding; ``spread`` is how far rows of unequal stimuli lie apart."""
    change, limit = left - right, tolerance(left.dtype) * spread + rounding(left)
    if math.isfinite(size := _extreme(change)):
        return size <= limit
    return torch.equal(left.isfinite(), right.isfinite()) and largest(change) <= limit


def largest(values: torch.Tensor) -> float:
    """Return the largest absolute value that is finite; 0 for none."""
    size = _extreme(values)
    return size if math.isfinite(size) else _extreme(values.nan_to_num(0.0, 0.0, 0.0))


def _extreme(values: torch.Tensor) -> float:
    if not values.numel():
        return 0.0
    low, high = values.aminmax()  # in place of the largest of absolute values, which are a copy
    return max(-float(low), float(high))


def tolerance(kind: torch.dtype) -> float:
    """Return which share of the differences between stimuli rounding may make."""
    return min(1e5 * torch.finfo(kind).eps, 0.05) if kind.is_floating_point else 0.01


def rounding(values: torch.Tensor) -> float:
    """Return the difference that rounding alone makes in values of this size."""
    eps = torch.finfo(values.dtype).eps if values.dtype.is_floating_point else 0.0
    return 50 * eps * largest(values)


def stimulus_layouts(
    first: torch.Tensor, second: torch.Tensor, batches: tuple[int, int]
) -> tuple[list[tuple[Layout, bool]], str]:
    """Return the layouts under which probes give the same rows in both batches, and whether these move; else why not.

    The batches begin with :data:`FIRST` and :data:`SECOND`.
    """
    proven, reason = [], UNMOVED if first.shape == second.shape and same(first, second, 0.0) else NO_AXIS
    places = [(place, SECOND.index(row)) for place, row in enumerate(FIRST) if row in SECOND]
    for layout in layouts(tuple(first.shape), tuple(second.shape), batches):
        before, after = layout.split(first, batches[0]), layout.split(second, batches[1])
        spread = max(largest(row - before[0]) for row in before[1 : len(FIRST)])
        if all(same(before[left], after[right], spread) for left, right in places):
            proven.append((layout, spread > rounding(before)))
        elif reason == NO_AXIS:
            reason = DEPENDENT
    return proven, reason


def with_time(layout: Layout, values: torch.Tensor, steps: int) -> Layout:
    """Return the layout with its time axis, if the probes [B, …], which :meth:`Layout.split` gave, show one."""
    joined = (layout.axis, layout.axis + 1)
    choices = []
    for axis, length in enumerate(layout.lengths):
        if steps < 2 or length % steps or (length != steps and axis not in joined):
            continue
        for before in range(1, length // steps + 1):
            if (length // steps) % before == 0:
                split = values.unflatten(axis + 1, (before, steps, -1)).movedim(axis + 2, 1)
                choices.append((time_misfit(split), (axis + 1, before)))
    misfit, time = min(choices, default=(math.inf, None))
    return Layout(layout.axis, layout.outer, layout.inner, layout.rest, time if misfit < 1 else None)


def time_misfit(values: torch.Tensor) -> float:
    """Return how badly axis 1 of the probes [B, T, …] moves with time: 0 for exactly, from 1 on for not at all.

    Exactly: a late change leaves the early entries as they were, and moves later ones; early entries do move with an
    early change. Entries that know the future too move with a shift: it explains what the shift changed.
    """
    rows = values[: len(FIRST)].reshape(len(FIRST), values.shape[1], -1)
    rows = (rows if rows.dtype == torch.float64 else rows.float()).nan_to_num(0.0, 0.0, 0.0)
    half, floor = values.shape[1] // 2, rounding(rows)

    late, early = ((rows[row] - rows[BASE]).abs().amax(-1) for row in (LATE, SHIFTED))
    if late[:half].max() <= max(1e-3 * float(late.max()), floor) < late[half:].max() and early[:half].max() > floor:
        return 0.0
    # Of the difference between two probes, so that a code of the place in time, which does not shift, drops out, and
    # without what all entries share, since it tells nothing of time.
    before, after = rows[BASE] - rows[PAIR], rows[SHIFTED] - rows[PAIR_SHIFTED]
    before, after = before - before.mean(0), after - after.mean(0)
    unexplained, change = (float((after[1:] - part).norm()) for part in (before[:-1], before[1:]))
    # By chance the share scatters about 1, the more the fewer numbers there are.
    limit = min(SHIFT, 1 - 3 / math.sqrt(before[1:].numel()))
    return unexplained / change / limit if change > floor and limit > 0 else math.inf


def sketch(rows: torch.Tensor) -> np.ndarray:
    """Return [B, ≤ 257] numbers that stand for rows [B, …]: weighted sums of blocks, and how many are not finite."""
    flat = rows.reshape(len(rows), -1)
    flat = flat if flat.dtype == torch.float64 else flat.float()
    numbers, lost = _block_sums(flat), torch.zeros(len(flat), 1, device=flat.device)
    if not bool(numbers.isfinite().all()):  # rarely, so that most rows are passed over once
        lost = (~flat.isfinite()).sum(1, keepdim=True)
        numbers = _block_sums(flat.nan_to_num(0.0, 0.0, 0.0))
    return torch.cat([numbers, lost], 1).cpu().numpy()


def _block_sums(flat: torch.Tensor) -> torch.Tensor:
    if (length := flat.shape[1]) <= _BLOCKS:
        return flat
    if len(flat) > 1 and flat.numel() > _LARGE:  # each row by itself, for the memory of what is between
        return torch.cat([_block_sums(row) for row in flat.split(1)])
    width = -(-length // _BLOCKS)
    weighted = flat * _weights(length).to(flat.device)
    if width * _BLOCKS != length:
        weighted = nn.functional.pad(weighted, (0, width * _BLOCKS - length))
    return weighted.unflatten(1, (_BLOCKS, width)).sum(-1)


@lru_cache(maxsize=16)
def _weights(length: int) -> torch.Tensor:
    """Return weights of either sign for rows of a length, so that entries that changed places do not cancel."""
    generator = torch.Generator().manual_seed(length)
    signs = torch.randint(0, 2, (length,), generator=generator, dtype=torch.int8).mul_(2).sub_(1)
    return torch.randint(32, 128, (length,), generator=generator, dtype=torch.int8).mul_(signs)


def agree(left: np.ndarray, right: np.ndarray, kind: torch.dtype) -> bool:
    """Return whether two runs over the same stimuli gave the same sketches [S, N], but for rounding."""
    if not np.array_equal(left[:, -1], right[:, -1]):
        return False
    left, right = (part[:, :-1].astype(np.float64) for part in (left, right))
    if not left.size:
        return True
    both = np.concatenate([left, right])
    eps = torch.finfo(kind).eps if kind.is_floating_point else 1e-7
    limit = tolerance(kind) * np.abs(both - both.mean(axis=0)).max() + 50 * eps * np.abs(both).max()
    return bool(np.abs(left - right).max() <= limit)


def draw_sample(count: int) -> np.ndarray:
    """Return the stimuli [n] of the second run in its order, by number: an eighth, from everywhere, 3 to 128."""
    generator = np.random.default_rng(0)
    size = min(max(3, count // 8), 128)
    edges = np.linspace(0, count, size + 1).astype(int)
    picks = [int(generator.integers(low, max(high, low + 1))) for low, high in pairwise(edges)]
    return generator.permutation(np.minimum(picks, count - 1))


def spilled(tensor: torch.Tensor, files: ExitStack) -> Path:
    """Return a temporary file that holds a tensor."""
    path = Path(files.enter_context(temporary_folder()), "tensor.pt")
    torch.save(tensor, path)
    return path


def restored(place: Any) -> Any:
    """Return the tensor in a file, mapped and not read, and anything else as it is."""
    return torch.load(place, weights_only=True, mmap=True) if isinstance(place, Path) else place


def fresh_copy(model: nn.Module) -> nn.Module | None:
    """Return a copy of a model as it is before it runs, for a state that the first batch leaves behind; None: no copy.

    Old kinds of weight norm keep a weight that was computed, which Python cannot copy but PyTorch can.
    """
    memo: dict[int, Any] = {
        id(value): value.detach().clone()
        for module in model.modules()
        for value in vars(module).values()
        if isinstance(value, torch.Tensor) and not value.is_leaf
    }
    try:
        return copy.deepcopy(model, memo)
    except torch.OutOfMemoryError:
        raise
    except Exception:  # noqa: BLE001 - anything that a user's attribute raises when it is copied
        return None


def unwrapped(model: Any) -> Any:
    """Return the module inside a compiled one."""
    return getattr(model, "_orig_mod", model)


def named_layers(model: nn.Module) -> tuple[str, ...] | None:
    """Return the layers that a model names, which its method ``activations`` gives; None for any other module.

    An attribute ``layers`` alone, such as a list of modules, names none.
    """
    names = getattr(model, "layers", None)
    if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
        return None
    return names if callable(getattr(model, "activations", None)) else None


def is_ours(model: nn.Module) -> bool:
    """Return whether a model names its layers and is made of our parts alone, whose layers our tests prove."""
    packages = {type(part).__module__.partition(".")[0] for part in model.modules()}
    return named_layers(model) is not None and packages <= {"brainbench", "torch"}


def layer_modules(model: nn.Module) -> dict[str, nn.Module]:
    """Return the parts that count as layers: those without parts, and those with weights of their own.

    Parametrisations are weights of the part that they stand in.
    """
    layers: dict[str, nn.Module] = {}
    within: Any = (part.parametrizations for part in model.modules() if is_parametrized(part))
    passed = {model, *(part for parametrizations in within for part in parametrizations.modules())}
    for label, part in model.named_modules():
        leaf = not any(True for _ in part.children())
        weighs = is_parametrized(part) or any(True for _ in part.parameters(recurse=False))
        if part not in passed and (leaf or weighs):
            layers[".".join(name for name in label.split(".") if name != "_orig_mod")] = part
    return layers


def first_tensor(value: Any) -> torch.Tensor | None:
    """Return the first tensor in what a module returned, as numbers that lie densely; a list of one shape is one."""
    if isinstance(value, torch.Tensor):
        if value.is_meta or value.is_nested:
            return None
        if value.is_quantized:
            return value.dequantize()
        dense = value if value.layout == torch.strided else value.to_dense()
        # Real and imaginary parts are features of their own.
        dense = torch.view_as_real(dense.resolve_conj()) if dense.is_complex() else dense
        return dense if dense.is_floating_point() else dense.double()
    tensors = isinstance(value, list) and all(isinstance(part, torch.Tensor) and not part.is_nested for part in value)
    kinds = {(part.shape, part.dtype, part.layout) for part in value} if tensors else ()
    if len(kinds) == 1 < len(value) and value[0].ndim:
        # Parts of one layer, such as the steps of a loop over time.
        return first_tensor(torch.stack(value, dim=1))
    if isinstance(value, dict):
        value = tuple(value.values())
    elif hasattr(value, "__dataclass_fields__"):
        value = tuple(vars(value).values())
    if isinstance(value, (tuple, list)):
        return next((tensor for part in value if (tensor := first_tensor(part)) is not None), None)
    return None


@contextmanager
def hooks(modules: dict[str, nn.Module], take: Callable[[str, Any], None]) -> Iterator[None]:
    """Call ``take`` with the name and the output of each module when it was called."""
    handles = []
    try:
        for name, module in modules.items():
            if isinstance(module, torch.jit.ScriptModule):  # it takes no hooks, and its parts would not call them
                continue
            handles.append(module.register_forward_hook(lambda _, inputs, output, name=name: take(name, output)))
        yield
    finally:
        for handle in handles:
            handle.remove()
