"""Activations of a model's layers for a set of stimuli.

Letters: K stimulus, T time step, F feature.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import BrainbenchError, UsageError, check_each, unknown_name
from brainbench.core.plugins import load_optional, optional_parts
from brainbench.core.reading.ranges import check_number

if TYPE_CHECKING:
    import torch
    from torch import nn

_log = logging.getLogger(__name__)

READOUTS = "brainbench.readouts"
"""Entry points of ways to read layers other than the default."""
OUTPUT = "output"
"""Layer name of a user model's own output."""
_REPEATED = 0.05
"""Difference of repeated activations, as a share of their size, that neither rounding nor half precision makes."""


class Activations(dict[str, np.ndarray]):
    """``{layer: [K, T, F] float32}``; values that are not finite are kept and counted in :attr:`nonfinite`."""

    def __init__(self) -> None:
        super().__init__()
        self.nonfinite: dict[str, int] = {}
        """Number of NaN and infinite values of each layer that has any."""


def extract(
    model: nn.Module,
    stimuli: Any,
    *,
    layers: Collection[str] | None = None,
    chunk: int = 16,
    folder: str | os.PathLike[str] | None = None,
    readout: str = "default",
) -> Activations:
    """Return the activations of a model's layers.

    A model with ``layers`` and ``activations`` (all of ours) gives its named layers. Any other module is
    read by hooks at its leaf modules, and at its output under the name ``output``. A hooked layer that is
    called once has the time axis of the stimuli if its tensor is [B, T, ...], [T, B, ...], [B·T, ...] or
    [T·B, ...], else T = 1; one called several times per sweep is stacked over calls as time (calls of unequal shape, or
    calls that have the time axis and are not T: ``name[0]``, ``name[1]``, …). Of a tuple or mapping the first tensor
    counts.

    The model runs in evaluation mode without gradients; modes are put back and no hook stays. Memory
    beyond the result is that of ``chunk`` stimuli; with ``folder`` the result lies on disk, and so may the
    stimuli (``numpy.load(…, mmap_mode="r")``).

    Args:
        model: Maps [B, T, C, H, W] to anything.
        stimuli: Array or tensor [K, T, C, H, W], or an object whose ``input`` is one.
        layers: Layers wanted; for a module without named layers any of its submodules. None: all.
        chunk: Stimuli processed at once.
        folder: Keep every layer as ``<folder>/<layer>.npy``, which replaces an earlier one, and return them mapped
            into memory.
        readout: ``published`` reads a network of the study by its layer names and steps there; the mean of axis 1 is
            then what was scored (``brainbench/published``).
    """
    import torch

    given = getattr(stimuli, "input", stimuli)
    values: Any = given if isinstance(given, torch.Tensor) else np.asanyarray(given)
    check_number("The chunk of an extraction", chunk, least=1, whole=True)
    if values.ndim < 2 or len(values) < 1:
        raise UsageError(f"Extraction needs stimuli [stimulus, time, ...]; received shape {list(values.shape)}.")
    if not isinstance(values, torch.Tensor) and values.dtype.kind not in "fiub":
        raise UsageError(f"Stimuli are real numbers; received {values.dtype}.")
    like = next((p for p in model.parameters() if p.is_floating_point()), torch.zeros(()))
    if readout != "default":
        own_reader = reader = partial(find_readout(readout).activations, model, layers=layers)
    else:
        own_reader = named_reader(model, layers)
        reader = own_reader or partial(_hooked_run, model, _hooked(model, layers), layers is not None, {})
    result = Activations()
    with evaluating(model), torch.no_grad():

        def read(start: int, stop: int) -> Iterator[tuple[str, np.ndarray]]:
            part = torch.as_tensor(_writable(values[start:stop])).to(device=like.device, dtype=like.dtype)
            for name, activity in _run(reader, part, model, values).items():
                # Real and imaginary parts are features of their own.
                real = torch.view_as_real(activity.resolve_conj()) if activity.is_complex() else activity
                yield name, real.detach().to("cpu", dtype=torch.float32).reshape(*real.shape[:2], -1).numpy()

        for start, stop in _chunks(len(values), chunk, avoid=values.shape[1]):
            for name, rows in read(start, stop):
                if name not in result:
                    result[name] = _room(name, (len(values), *rows.shape[1:]), folder)
                elif result[name].shape[1:] != rows.shape[1:]:
                    raise UsageError(
                        f"Layer {name!r} changed its shape between stimuli, from {list(result[name].shape[1:])} to "
                        f"{list(rows.shape[1:])}; give stimuli of one length or leave this layer out."
                    )
                result[name][start:stop] = rows
        # In another batch, after others: what depends on these is no answer to a stimulus. Ours do not.
        first = 3 if values.shape[1] == 2 else 2
        _check_repeated(result, read(0, min(len(values), first)) if own_reader is None else iter(()), model)
    if not result:
        raise UsageError(
            f"Nothing in {type(model).__name__} gives an activation per stimulus: no output of it or of its parts has "
            f"the {len(values)} stimuli as its first axis. Return [B, ...] for stimuli [B, T, C, H, W]."
        )
    for name, activity in result.items():
        if isinstance(activity, np.memmap):
            activity.flush()
        if count := sum(int((~np.isfinite(row)).sum()) for row in activity):
            result.nonfinite[name] = count
            _log.warning("%d of %d activations of layer %r are not finite.", count, activity.size, name)
    return result


def find_readout(name: str) -> Any:
    """Return a readout: how layers are named (``layers(model)``) and read (``activations(model, x, layers)``)."""
    if (readout := load_optional(READOUTS, name, "readout")) is None:
        raise unknown_name("readout", name, ("default", *optional_parts(READOUTS)))
    return readout


def _check_repeated(result: Activations, again: Iterator[tuple[str, np.ndarray]], model: nn.Module) -> None:
    """Raise UsageError if the first stimuli give other activations than before."""
    try:
        repeated = dict(again)
    except UsageError:  # a model may be made for batches of one size
        return
    for name, rows in repeated.items():
        before = result[name][: len(rows)]
        finite = np.isfinite(before) & np.isfinite(rows)
        first, two = before[finite].astype(np.float64), rows[finite].astype(np.float64)
        if np.linalg.norm(two - first) > _REPEATED * np.linalg.norm(first):
            raise UsageError(
                f"{type(model).__name__} answers the same stimuli otherwise when it is run again (layer {name!r}): it "
                "keeps a state between calls, draws random numbers or normalises over the batch. Begin anew in "
                "forward, and give functional.dropout and functional.batch_norm training=self.training."
            )


def _writable(values: Any) -> Any:
    """Return stimuli that PyTorch may read in place: its tensors cannot be read-only."""
    if isinstance(values, np.ndarray):
        return np.array(values) if not values.flags.writeable else np.ascontiguousarray(values)
    return values


def _room(name: str, shape: tuple[int, ...], folder: str | os.PathLike[str] | None) -> np.ndarray:
    """Return where a layer's activations go: memory, or a file."""
    if folder is None:
        return np.empty(shape, np.float32)
    path = Path(folder) / f"{name.replace('/', '-')}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    return np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """Put a model into evaluation mode and every submodule back into its own mode afterwards."""
    modes = {module: module.training for module in model.modules()}
    try:
        model.eval()
        yield
    finally:
        for module, mode in modes.items():
            module.training = mode


def _chunks(count: int, chunk: int, *, avoid: int) -> Iterator[tuple[int, int]]:
    """Yield ranges, none as long as the time axis: such a batch could not be told from time."""
    start = 0
    while start < count:
        stop = min(start + chunk, count)
        if stop - start == avoid and avoid > 1:
            stop -= 1
        yield start, stop
        start = stop


def _run(reader: Any, part: torch.Tensor, model: nn.Module, stimuli: torch.Tensor) -> dict[str, torch.Tensor]:
    import torch

    try:
        return reader(part)
    except torch.OutOfMemoryError:
        raise
    except (RuntimeError, ValueError, TypeError, IndexError, AssertionError, NotImplementedError) as error:
        if isinstance(error, _LayerError) or (isinstance(error, BrainbenchError) and not isinstance(error, UsageError)):
            raise
        reason = str(error).strip().partition("\n")[0]
        if not isinstance(error, UsageError):
            reason = f"{type(error).__name__}: {reason}"
        raise UsageError(
            f"{type(model).__name__} cannot process stimuli of shape {list(stimuli.shape)} "
            f"[stimulus, time, channel, row, column]: {reason}"
        ) from error


class _LayerError(UsageError):
    """A layer, not the stimulus, is what does not fit."""


def named_reader(model: nn.Module, layers: Collection[str] | None) -> Any:
    """Return a function from stimuli to activations if the model names its layers itself."""
    names, read = getattr(model, "layers", None), getattr(model, "activations", None)
    if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names) or not callable(read):
        return None
    check_each("layer", layers or (), names)
    wanted = names if layers is None else tuple(name for name in names if name in layers)
    return lambda part: read(part, wanted)


def _hooked(model: nn.Module, layers: Collection[str] | None) -> dict[str, nn.Module]:
    every = {name: module for name, module in model.named_modules() if name}
    if layers is None:
        leaves = {name: module for name, module in every.items() if not any(True for _ in module.children())}
        return leaves | {OUTPUT: model}
    choices = every if OUTPUT in every else {**every, OUTPUT: model}
    check_each("layer", layers, choices)
    return {name: choices[name] for name in choices if name in layers}


def _hooked_run(
    model: nn.Module, modules: dict[str, nn.Module], strict: bool, time_first: dict[str, bool], part: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Run any module and return what submodules gave, read by forward hooks; if strict, each must give something.

    ``time_first`` keeps, for layers that join stimuli and steps in one axis, whether steps come first in it.
    """
    calls = _recorded(model, modules, part)
    batch, steps = part.shape[:2]
    joined = [name for name, outputs in calls.items() for item in outputs[:1] if item.shape[:1] == (batch * steps,)]
    if min(batch, steps) > 1 and (undecided := [name for name in joined if name not in time_first]):
        # Both orders have one shape. Stimuli in another order tell which one it is: a layer's rows move with them.
        moved = _recorded(model, {name: modules[name] for name in undecided}, part.roll(1, 0))
        for name in undecided:
            before, two = calls[name][0].float(), moved[name][0].float()
            ours = (before.unflatten(0, (batch, steps)).roll(1, 0).flatten(0, 1) - two).abs().nan_to_num().sum()
            theirs = (before.unflatten(0, (steps, batch)).roll(1, 1).flatten(0, 1) - two).abs().nan_to_num().sum()
            # Where rows are equal, later stimuli tell.
            if max(ours, theirs) > 1e-3 * before.abs().nan_to_num().sum():
                time_first[name] = bool(theirs < ours)
    activities = {}
    for name, outputs in calls.items():
        if time_first.get(name):
            outputs = [
                value.unflatten(0, (steps, batch)).transpose(0, 1) if value.shape[:1] == (batch * steps,) else value
                for value in outputs
            ]
        activity = _over_calls(name, outputs, batch, steps)
        if not activity and strict:
            seen = [list(output.shape) for output in outputs] or "nothing"
            raise _LayerError(f"Layer {name!r} gave {seen} for {batch} stimuli of {steps} steps, not one each.")
        activities |= activity
    return activities


def _recorded(model: nn.Module, modules: dict[str, nn.Module], part: torch.Tensor) -> dict[str, list[torch.Tensor]]:
    """Run a module and return what each submodule gave, call by call."""
    calls: dict[str, list[torch.Tensor]] = {name: [] for name in modules}

    def record(name: str, output: Any) -> None:
        if (tensor := _first_tensor(output)) is not None:
            # A later in-place operation must not change what was recorded.
            calls[name].append(tensor.detach().clone())

    with ExitStack() as handles:
        for name, module in modules.items():
            handle = module.register_forward_hook(lambda _, inputs, output, name=name: record(name, output))
            handles.callback(handle.remove)
        model(part)
    return calls


def _first_tensor(value: Any) -> torch.Tensor | None:
    import torch

    if isinstance(value, torch.Tensor):
        return value
    if isinstance(value, dict):
        value = tuple(value.values())
    if isinstance(value, (tuple, list)):
        return next((tensor for item in value if (tensor := _first_tensor(item)) is not None), None)
    return None


def _over_calls(name: str, outputs: list[torch.Tensor], batch: int, steps: int) -> dict[str, torch.Tensor]:
    """Return named activations [B, T, ...]; none if the outputs do not belong to the stimuli."""
    import torch

    timed = [_with_time(output, batch, steps) for output in outputs]
    if len(outputs) == 1:
        return {} if timed[0] is None else {name: timed[0]}
    # A part that stands in several places of a network gives all steps each time; only a loop's calls are steps.
    whole = len(outputs) != steps and all(item is not None and item.shape[1] == steps > 1 for item in timed)
    if len({output.shape for output in outputs}) == 1 and not whole:
        return {name: torch.stack(outputs, 1)} if outputs[0].shape[:1] == (batch,) else {}
    return {f"{name}[{index}]": activity for index, activity in enumerate(timed) if activity is not None}


def _with_time(output: torch.Tensor, batch: int, steps: int) -> torch.Tensor | None:
    shape = tuple(output.shape)
    if len(shape) >= 3 and shape[:2] == (batch, steps):
        return output
    if len(shape) >= 3 and shape[:2] == (steps, batch):
        return output.transpose(0, 1)
    if shape[:1] == (batch * steps,) and steps > 1:
        return output.unflatten(0, (batch, steps))
    return output.unsqueeze(1) if shape[:1] == (batch,) else None
