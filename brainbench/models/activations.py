"""Activations of a model's layers for a set of stimuli.

A network of ours names its layers and their axes. Any other is read by hooks, and what a hook captures counts only as
far as :mod:`~brainbench.models.proof` shows it to be a response.

Letters: K stimulus, B batch, T time step, F feature.
"""

from __future__ import annotations

import logging
import os
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import BrainbenchError, UsageError, check_each, check_number, listing, unknown_name
from brainbench.core.lazy import lazy_module
from brainbench.core.plugins import load_optional, optional_parts
from brainbench.core.reading.regular import temporary_folder

if TYPE_CHECKING:
    import torch
    from torch import nn

    from brainbench.models import proof
    from brainbench.models.proof import Layout
else:
    torch, proof = lazy_module("torch"), lazy_module("brainbench.models.proof")

_log = logging.getLogger(__name__)

READOUTS = "brainbench.readouts"  # entry points of ways to read layers other than the default
OUTPUT = "output"  # layer name of a user model's own output
MEMORY = 2.0  # memory for activations [GiB], by default
_SAMPLED, _PROBED = 7, 5  # stimuli in a batch of the second run, unlike the 16 of the first, and beside probes


@dataclass(frozen=True)
class ReadReport:
    """What was read of a model, and what was not."""

    called: int
    """Modules that ran and count as layers."""
    not_read: Mapping[str, str] = field(default_factory=dict)
    """Layer → why it is no response to the stimuli."""
    notes: tuple[str, ...] = ()
    """What else a reader of the layers should know."""

    @property
    def read(self) -> int:
        """Number of modules that were read in all their calls."""
        return self.called - len({name.partition("[")[0] for name in self.not_read})

    @classmethod
    def of(cls, stated: Mapping[str, Any]) -> ReadReport:
        """Return the report that a record states."""
        return cls(stated["called"], stated["not_read"], tuple(stated["notes"]))

    @property
    def stated(self) -> dict[str, Any]:
        """The report as a record states it."""
        return {"called": self.called, "read": self.read, "not_read": dict(self.not_read), "notes": list(self.notes)}

    def __str__(self) -> str:
        """Return the report as a sentence."""
        text = f"{self.read} of {self.called} called modules read"
        if self.not_read:
            parts = [f"{name} ({reason})" for name, reason in self.not_read.items()]
            text += f"; not read: {listing(parts, limit=5, quoted=False)}"
        return "; ".join((text, *self.notes))


class Activations(dict[str, np.ndarray]):
    """``{layer: [K, T, F] float32}``; values that are not finite are kept and counted in :attr:`nonfinite`."""

    def __init__(self) -> None:
        super().__init__()
        self.nonfinite: dict[str, int] = {}
        """Number of NaN and infinite values of each layer that has any."""
        self.report = ReadReport(0)
        """What was read, and what was not and why."""


def extract(
    model: nn.Module,
    stimuli: Any,
    *,
    layers: Collection[str] | None = None,
    chunk: int = 16,
    folder: str | os.PathLike[str] | None = None,
    readout: str = "default",
    reduce: Callable[[np.ndarray], np.ndarray] | None = None,
    memory: float = MEMORY,
) -> Activations:
    """Return the activations of a model's layers.

    A model with ``layers`` and ``activations`` (all of ours) gives its named layers. Any other module is read by hooks
    at its parts that have no parts or have weights of their own, and at its output under the name ``output``. A tensor
    counts as a layer if its rows are proven to follow the stimuli, wherever they lie in it; its time axis is the one
    that is proven to follow time, else T = 1. Layers of a model that is made of our parts alone are proven in our
    tests. Calls of one module are ``name[0]``, ``name[1]``, …, or the time steps of one layer if they are proven to be.
    Of a tuple or mapping the first tensor counts, of a list of one shape all. The result's ``report`` names what was
    not read, and why.

    The model runs in evaluation mode without gradients on copies of the stimuli; modes are put back and no hook stays.
    The proof runs a copy of it on 8 probes and an eighth of the stimuli, and at the end itself on two of these again;
    probes beyond an eighth of ``memory`` lie in temporary files. Memory beyond the result is that copy, which is gone
    before all stimuli run, and half of ``memory``, or one stimulus and the probes where these need more.

    Args:
        model: Maps [B, T, C, H, W] to anything.
        stimuli: Array or tensor [K, T, C, H, W], or an object whose ``input`` is one.
        layers: Layers wanted; for a module without named layers any of its submodules. None: all.
        chunk: Stimuli processed at once, at most.
        folder: Keep every layer as ``<folder>/<layer>.npy``, which replaces an earlier one, and return them mapped
            into memory.
        readout: ``published`` reads a network of the study by its layer names and steps there; the mean of axis 1 is
            then what was scored (``brainbench/published``).
        reduce: Makes of the activations [B, T, F] of a batch what is kept of them, [B, T', F'], such as a mean over
            time.
        memory: Layers beyond this many GiB lie in temporary files, which go with the result.
    """
    from brainbench.models.ops.layers import check_weights

    given = getattr(stimuli, "input", stimuli)
    values: Any = given if isinstance(given, torch.Tensor) else np.asanyarray(given)
    check_number("The chunk of an extraction", chunk, least=1, whole=True)
    check_number("The memory of an extraction (GiB)", memory, above=0)
    if values.ndim < 2 or len(values) < 1:
        raise UsageError(f"Extraction needs stimuli [stimulus, time, ...]; received shape {list(values.shape)}.")
    if not isinstance(values, torch.Tensor) and values.dtype.kind not in "fiub":
        raise UsageError(f"Stimuli are real numbers; received {values.dtype}.")
    model = proof.unwrapped(model)
    check_weights(model, type(model).__name__)
    rooms = _Rooms(len(values), folder, int(memory * 2**30), reduce)
    with _surroundings(model) as device, evaluating(model), torch.no_grad():
        run = _Run(model, values, device)
        if readout != "default":
            _read_proven(run, partial(find_readout(readout).activations, model, layers=layers), rooms, chunk)
        elif proof.is_ours(model):
            _read_proven(run, named_reader(model, layers), rooms, chunk)
        else:
            _ForeignReader(run, layers, rooms).read(chunk)
    result = rooms.close(run.notes)
    if not result:
        raise UsageError(
            f"Nothing in {type(model).__name__} gives an activation per stimulus ({result.report}). Return [B, ...] "
            "for stimuli [B, T, C, H, W]."
        )
    for name, count in result.nonfinite.items():
        _log.warning("%d of %d activations of layer %r are not finite.", count, rooms.sizes[name], name)
    return result


def find_readout(name: str) -> Any:
    """Return a readout: how layers are named (``layers(model)``) and read (``activations(model, x, layers)``)."""
    if (readout := load_optional(READOUTS, name, "readout")) is None:
        raise unknown_name("readout", name, ("default", *optional_parts(READOUTS)))
    return readout


def named_reader(model: Any, layers: Collection[str] | None) -> Any:
    """Return a function from stimuli to activations if the model names its layers itself."""
    from brainbench.models.proof import named_layers

    if (names := named_layers(model)) is None:
        return None
    check_each("layer", layers or (), names)
    wanted = names if layers is None else tuple(name for name in names if name in layers)
    return lambda part: model.activations(part, wanted)


def check_layers(model: Any, layers: Iterable[str]) -> set[str]:
    """Return layers or parts by name, without the number of a call, such as ``part[0]``; UsageError for unknown ones.

    ``model`` is a module, or the names of layers.
    """
    choices = _choices(model) if callable(model) else model
    names = {layer if layer in choices else layer.partition("[")[0] for layer in layers}
    check_each("layer", sorted(names), choices)
    return names


def _choices(model: Any) -> dict[str, Any]:
    """Return what may be asked for of a model: the layers that it names, or else its parts and its output."""
    from brainbench.models.proof import named_layers

    if (names := named_layers(model)) is not None:
        return dict.fromkeys(names, model)
    parts = {name.replace("_orig_mod.", ""): part for name, part in model.named_modules() if name}
    return {**parts, OUTPUT: parts.get(OUTPUT, model)}


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


@contextmanager
def _surroundings(model: nn.Module) -> Iterator[Any]:
    """Keep the caller's autocast, inference mode, default device (yielded) and default precision out of a reading."""
    where, kind = torch.get_default_device(), torch.get_default_dtype()
    double = any(weight.dtype == torch.float64 for weight in model.parameters())
    with ExitStack() as scope:
        scope.enter_context(torch.inference_mode(False))
        for device in ("cpu", "cuda"):
            scope.enter_context(torch.autocast(device, enabled=False))
        if where.type != "cpu":
            scope.enter_context(torch.device("cpu"))
        if any("_orig_mod" in part._modules or getattr(part, "_compiled_call_impl", None) for part in model.modules()):
            # Parts that were compiled run as written, since only those call hooks.
            scope.enter_context(torch.compiler.set_stance("force_eager"))
        torch.set_default_dtype(torch.float64 if double else torch.float32)
        scope.callback(torch.set_default_dtype, kind)
        yield where


class _Run:
    """A model and its stimuli, of which it gets copies."""

    def __init__(self, model: nn.Module, values: Any, device: Any) -> None:
        self.model, self.values, self.device = model, values, device
        self.count, self.steps = values.shape[:2]
        self.like = next((p for p in model.parameters() if p.is_floating_point()), torch.zeros(()))
        self.sample = proof.draw_sample(self.count)
        self.first = np.sort(self.sample)[:2]  # met again at the end, which shows what the model kept since then
        self.notes: list[str] = []

    def stimuli(self, rows: slice | np.ndarray) -> torch.Tensor:
        """Return a copy of stimuli, which a model may write to."""
        if isinstance(self.values, torch.Tensor):
            part = self.values[torch.as_tensor(rows) if isinstance(rows, np.ndarray) else rows].detach().clone()
        else:
            part = torch.from_numpy(np.array(self.values[rows], order="C"))
        return part.to(device=self.like.device, dtype=self.like.dtype)

    def __call__(self, reader: Callable[[torch.Tensor], Any], part: torch.Tensor) -> Any:
        """Run a model or a reader of it on stimuli; what fails is told in one sentence."""
        version = part._version
        try:
            # A model on a GPU may rely on the program's default device for the states that it makes.
            with nullcontext() if self.device.type == "cpu" else torch.device(part.device):
                result = reader(part)
        except torch.OutOfMemoryError:
            raise
        except Exception as error:
            if isinstance(error, BrainbenchError) and not isinstance(error, UsageError):
                raise
            reason = str(error).strip().partition("\n")[0]
            if not isinstance(error, UsageError):
                reason = f"{type(error).__name__}: {reason}"
            raise UsageError(
                f"{type(self.model).__name__} cannot process stimuli of shape {list(self.values.shape)} "
                f"[stimulus, time, channel, row, column]: {reason}"
            ) from error
        note = "the model changes its input in place, and was given copies"
        if part._version != version and note not in self.notes:
            self.notes.append(note)
        return result

    def chunks(self, chunk: int) -> Iterator[slice]:
        """Yield the ranges of all stimuli."""
        for start in range(0, self.count, chunk):
            yield slice(start, min(start + chunk, self.count))

    def refusal(self, layer: str) -> UsageError:
        """Return the error for a model that does not answer a stimulus alone."""
        return UsageError(
            f"{type(self.model).__name__} answers the same stimuli otherwise when it is run again in another batch "
            f"(layer {layer!r}): it keeps a state between calls, draws random numbers or mixes the stimuli of a batch. "
            "Begin anew in forward, and give functional.dropout and functional.batch_norm training=self.training."
        )


class _Sketches:
    """What stands for the rows of the sampled stimuli, in the first and in the second run."""

    def __init__(self, sample: np.ndarray) -> None:
        self.sample, self.places = sample, {}
        for place, stimulus in enumerate(sample):
            self.places.setdefault(int(stimulus), []).append(place)
        self.runs: tuple[dict[Any, np.ndarray], dict[Any, np.ndarray]] = {}, {}
        self.kinds: dict[Any, Any] = {}

    def add(self, run: int, key: tuple[str, int | None], rows: torch.Tensor, stimuli: Iterable[int]) -> None:
        """Keep the sketches of the rows that are of sampled stimuli."""
        pairs = [(row, place) for row, stimulus in enumerate(stimuli) for place in self.places.get(int(stimulus), ())]
        if pairs:
            source, target = map(list, zip(*pairs, strict=True))
            self.keep(run, key, proof.sketch(rows[source]), target, rows.dtype)

    def keep(self, run: int, key: tuple[str, int | None], numbers: np.ndarray, target: Any, kind: Any = None) -> None:
        """Keep sketches at their places in the sample."""
        store = self.runs[run].setdefault(key, np.full((len(self.sample), numbers.shape[1]), np.nan))
        if store.shape[1] == numbers.shape[1]:
            store[target] = numbers
        self.kinds[key] = kind

    def unequal(self) -> dict[str, str]:
        """Return the layers that the runs do not agree on, with the reason."""
        reasons: dict[str, str] = {}
        for key, before in self.runs[0].items():
            after = self.runs[1].get(key)
            if after is None or np.isnan(after).any():
                reasons[key[0]] = "does not run in every batch"
            elif not np.isnan(before).any() and (
                before.shape != after.shape or not proof.agree(before, after, self.kinds[key])
            ):
                reasons[key[0]] = proof.DEPENDENT
        return reasons


class _Rooms:
    """Where layers go: memory up to a bound, files beyond it; each row has to be written."""

    def __init__(self, count: int, folder: Any, memory: int, reduce: Callable[[np.ndarray], np.ndarray] | None) -> None:
        self.count, self.folder, self.memory, self.reduce = count, folder, memory, reduce
        self.result, self.used, self.spill = Activations(), 0, None
        self.sizes: dict[str, int] = {}  # number of activations of each layer, before they are reduced
        self.written: dict[str, np.ndarray] = {}
        self.not_read: dict[str, str] = {}
        self.called: set[str] = set()
        self.order: dict[str, int] = {}  # place of each layer's module among the modules

    def write(self, name: str, rows: np.ndarray, place: slice) -> None:
        """Write the activations [B, T, F] of some stimuli."""
        lost = int(rows.size - np.isfinite(rows).sum())
        self.sizes[name] = self.sizes.get(name, 0) + rows.size
        rows = rows if self.reduce is None else self.reduce(rows)
        if name not in self.result:
            self.result[name] = self._room(name, (self.count, *rows.shape[1:]), rows.dtype)
            self.written[name] = np.zeros(self.count, bool)
        if self.result[name].shape[1:] != rows.shape[1:]:
            shapes = f"from {list(self.result[name].shape[1:])} to {list(rows.shape[1:])}"
            self.not_read[name] = f"changes its shape between stimuli, {shapes}"
            return
        self.result[name][place] = rows
        self.written[name][place] = True
        if lost:
            self.result.nonfinite[name] = self.result.nonfinite.get(name, 0) + lost

    def close(self, notes: Iterable[str]) -> Activations:
        """Return the layers whose every row was written, and the report."""
        for name, rows in self.written.items():
            if not rows.all():
                gaps = np.flatnonzero(~rows)
                self.not_read.setdefault(name, f"gives no row for {len(gaps)} stimuli, {gaps[0]}–{gaps[-1]}")
        for name in self.not_read:
            if (room := self.result.pop(name, None)) is not None and isinstance(room, np.memmap):
                filename, room = room.filename, None
                Path(str(filename)).unlink(missing_ok=True)
            self.result.nonfinite.pop(name, None)
        for name in sorted(self.result, key=self._place):
            self.result[name] = room = self.result.pop(name)
            if isinstance(room, np.memmap):
                room.flush()
        not_read = {name: self.not_read[name] for name in sorted(self.not_read, key=self._place)}
        self.result.report = ReadReport(len(self.called), not_read, tuple(notes))
        return self.result

    def _place(self, name: str) -> tuple[int, int]:
        base, _, call = name.partition("[")
        return self.order.get(name, self.order.get(base, len(self.order))), int(call.rstrip("]") or 0) if call else 0

    def _room(self, name: str, shape: tuple[int, ...], kind: Any) -> np.ndarray:
        size = int(np.prod(shape)) * np.dtype(kind).itemsize
        folder = self.folder
        if folder is None and self.used + size > self.memory:
            if self.spill is None:
                spill = temporary_folder()
                self.spill = spill.name
                weakref.finalize(self.result, spill.cleanup)
            folder = self.spill
        if folder is None:
            self.used += size
            return np.full(shape, np.nan, kind)
        path = Path(folder) / f"{name.replace('/', '-')}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        room = np.lib.format.open_memmap(path, mode="w+", dtype=kind, shape=shape)
        room.fill(np.nan)
        return room


def _plain(rows: torch.Tensor) -> np.ndarray:
    """Return rows as single precision in memory."""
    return rows.detach().to("cpu", dtype=torch.float32).numpy()


def _read_proven(run: _Run, read: Any, rooms: _Rooms, chunk: int) -> None:
    """Read layers [B, T, …] that need no proof."""
    for place in run.chunks(chunk):
        for name, activity in run(read, run.stimuli(place)).items():
            rooms.order.setdefault(name, len(rooms.order))
            rooms.called.add(name)
            values = torch.view_as_real(activity.resolve_conj()) if activity.is_complex() else activity
            rooms.write(name, _plain(values.reshape(*values.shape[:2], -1)), place)


@dataclass(frozen=True)
class _Place:
    """Layer, and step of it, that one call of a module gives."""

    layer: str
    layout: Layout
    step: int | None = None
    moved: bool = True  # whether rows of unequal probes differed; if not, those of the stimuli have to


class _ForeignReader:
    """Reads a network of others: proves what its parts return, or what it names, on a copy of it, then runs it once."""

    def __init__(self, run: _Run, layers: Collection[str] | None, rooms: _Rooms) -> None:
        self.run, self.rooms, self.layers = run, rooms, layers
        self.named = named_reader(run.model, layers) is not None
        self.modules = self._modules(run.model)
        rooms.order = {name: place for place, name in enumerate(self.modules)}
        self.fresh = proof.fresh_copy(run.model)
        if self.fresh is None:
            run.notes.append("the model cannot be copied, so a state that its first batch leaves is not noticed")
        if not self.named and any(isinstance(part, torch.jit.ScriptModule) for part in run.model.modules()):
            run.notes.append("parts that run in TorchScript cannot be read: give the module that was scripted")
        self.places: dict[tuple[str, int], _Place] = {}
        self.calls: dict[str, int] = {}
        self.held = 0  # bytes of probes
        self.size = 1  # bytes of all layers for a stimulus
        self.fill = 1  # stimuli that a batch has at least; more where a model takes no others

    def _modules(self, model: nn.Module) -> dict[str, nn.Module]:
        choices = _choices(model)
        if self.layers is None:
            return choices if self.named else {**proof.layer_modules(model), OUTPUT: model}
        wanted = check_layers(model, self.layers)
        return {name: part for name, part in choices.items() if name in wanted}

    def read(self, chunk: int) -> None:
        """Prove and read all layers."""
        rooms, run = self.rooms, self.run
        try:
            sketches = self._prove()
        except UsageError:  # a model may be made for batches of one size
            self.fill = min(chunk, run.count)
            sketches = self._prove()
        self._run_again(self.fresh or run.model, run.sample[_PROBED:], sketches)
        self.fresh = None  # its memory is that of the layers from here on
        self._run_all(max(1, min(chunk, rooms.memory // 2 // self.size)), sketches)
        rooms.not_read = sketches.unequal() | rooms.not_read
        self._run_again(run.model, run.first, sketches)
        rooms.not_read = sketches.unequal() | rooms.not_read
        self._check(rooms.not_read)

    def _check(self, not_read: Mapping[str, str]) -> None:
        """Refuse a model whose output, or a layer that it names, is no answer to a stimulus, and layers asked for."""
        from brainbench.models.proof import DEPENDENT

        for name, reason in not_read.items():
            if reason == DEPENDENT and self.modules.get(name) is self.run.model:
                raise self.run.refusal(name)
        for name in self.layers or ():
            base, run = name.partition("[")[0], {layer.partition("[")[0] for layer in self.rooms.written}
            if base not in self.rooms.called:
                raise UsageError(f"Layer {name!r} of {type(self.run.model).__name__} gave nothing: it did not run.")
            reason = not_read.get(name) or (not_read.get(base) if base not in run or name == base else None)
            if reason == DEPENDENT:
                raise self.run.refusal(name)
            if reason is not None:
                raise UsageError(f"Layer {name!r} of {type(self.run.model).__name__} cannot be read: {reason}.")

    def _forward(self, model: nn.Module, part: torch.Tensor, take: Callable[[str, int, Any], None]) -> dict[str, int]:
        """Run a model, give each call's first tensor away, and return how often each module was called."""
        counts: dict[str, int] = {}

        def _count(name: str, output: Any) -> None:
            index = counts[name] = counts.get(name, -1) + 1
            take(name, index, proof.first_tensor(output))

        modules = self._modules(model)
        if self.named:
            answers = self.run(named_reader(model, self.layers), part)
            if not isinstance(answers, Mapping):
                raise UsageError(
                    f"{type(model).__name__}.activations(x, layers) gives a mapping from layers to tensors; it gave a "
                    f"{type(answers).__name__}."
                )
            for name in modules:
                _count(name, answers.get(name))
            return dict.fromkeys(modules, 1)
        # A root's hook does not run for every kind of module, its result is here anyway.
        with proof.hooks({name: module for name, module in modules.items() if module is not model}, _count):
            output = self.run(model, part)
        if modules.get(OUTPUT) is model:
            _count(OUTPUT, output)
        return {name: last + 1 for name, last in counts.items()}

    def _prove(self) -> _Sketches:
        """Find the places of stimuli and time in what each module returns; the second batch holds sampled stimuli."""
        run, model = self.run, self.fresh or self.run.model
        stimuli = run.stimuli(run.sample[:16])
        rows = proof.probes(stimuli.cpu(), run.steps)
        least, sketches = min(_PROBED, len(stimuli)), _Sketches(run.sample)
        batches = []
        for batch, more in ((proof.FIRST, 0), (proof.SECOND, least)):
            filling = [stimuli[place % len(stimuli)] for place in range(max(self.fill - len(batch), more))]
            probes = [stimuli[0] if row is None else rows[row].to(stimuli) for row in batch]
            batches.append(torch.stack([*probes, *filling]))
        sizes = (len(batches[0]), len(batches[1]))
        calls: dict[str, list[Any]] = {}
        proofs: dict[str, list[Any]] = {}
        sketched: dict[tuple[str, int, Layout], np.ndarray] = {}

        def _keep(tensor: torch.Tensor) -> Any:
            self.held += tensor.nbytes
            return tensor if self.held <= self.rooms.memory // 8 else proof.spilled(tensor, files)

        def _capture(name: str, index: int, tensor: Any) -> None:
            # A later operation in place must not change what was captured.
            calls.setdefault(name, []).append(None if tensor is None else _keep(tensor.cpu().clone()))

        def _compare(name: str, index: int, tensor: Any) -> None:
            first = calls[name][index] if index < len(calls.get(name, ())) else None
            result: Any = [], "gives no tensor of numbers"
            if first is not None and tensor is not None:
                result = proof.stimulus_layouts(proof.restored(first), tensor.cpu(), sizes)
                for layout, _ in result[0]:
                    rows = layout.split(tensor, sizes[1])[len(proof.SECOND) :]
                    sketched[name, index, layout] = proof.sketch(rows[:least])
            proofs.setdefault(name, []).append(result)

        with ExitStack() as files:
            self._forward(model, batches[0], _capture)
            self._forward(model, batches[1], _compare)
            self.places, self.rooms.not_read, self.size = {}, {}, 1
            for name in [name for name in self.modules if name in calls or name in proofs]:
                self.rooms.called.add(name)
                tensors = calls.pop(name, [])
                if len(tensors) != len(proofs.get(name, ())):
                    self.rooms.not_read[name] = "does not run alike in every batch"
                    continue
                self._place(name, list(map(proof.restored, tensors)), proofs[name], sizes[0])
        for key, place in self.places.items():
            sketches.keep(1, (place.layer, place.step), sketched[*key, replace(place.layout, time=None)], slice(least))
        return sketches

    def _place(self, name: str, tensors: list[Any], proven: list[Any], batch: int) -> None:
        """Decide which layers, and which steps of them, the calls of a module are."""
        if len(tensors) > 1 and (loop := self._loop(tensors, proven, batch)) is not None:
            layout, before, after = loop
            for index, tensor in enumerate(tensors):
                outer, step, inner = np.unravel_index(index, (before, self.run.steps, after))
                layer = name if before * after == 1 else f"{name}[{outer * after + inner}]"
                self.places[name, index] = _Place(layer, layout, int(step))
                self.size += tensor.numel() * 4 // batch
            return
        for index, (tensor, (layouts, reason)) in enumerate(zip(tensors, proven, strict=True)):
            layer = name if len(tensors) == 1 else f"{name}[{index}]"
            moved = [layout for layout, moves in layouts if moves]
            still = [layout for layout, moves in layouts if not moves and layout.outer == layout.inner == 1]
            if not moved and not still:
                self.rooms.not_read[layer] = reason
                continue
            layout = (moved or still)[0]
            if moved:
                layout = proof.with_time(layout, layout.split(tensor, batch), self.run.steps)
            self.places[name, index] = _Place(layer, layout, moved=bool(moved))
            self.size += tensor.numel() * 4 // batch

    def _loop(self, tensors: list[Any], proven: list[Any], batch: int) -> tuple[Layout, int, int] | None:
        """Return the layout of calls that are the steps of a loop, and how many calls stand around its steps."""
        steps, count = self.run.steps, len(tensors)
        if steps < 2 or count % steps or len({getattr(tensor, "shape", None) for tensor in tensors}) != 1:
            return None
        common = set.intersection(*({layout for layout, _ in layouts} for layouts, _ in proven))
        moved = [layout for layouts, _ in proven for layout, moves in layouts if moves and layout in common]
        if not moved:
            return None
        layout = moved[0]
        split = [layout.split(tensor, batch)[: len(proof.FIRST)] for tensor in tensors]
        if proof.with_time(layout, split[-1], steps).time is not None:
            return None
        stacked = torch.stack(split, 1)
        choices = [
            (proof.time_misfit(stacked.unflatten(1, (before, steps, -1)).movedim(2, 1)), before)
            for before in range(1, count // steps + 1)
            if (count // steps) % before == 0
        ]
        misfit, before = min(choices)
        return (layout, before, count // steps // before) if misfit < 1 else None

    def _run_again(self, model: nn.Module, picks: np.ndarray, sketches: _Sketches) -> None:
        """Run sampled stimuli in their own order and batches."""
        for part in np.array_split(picks, -(-len(picks) // _SAMPLED)) if len(picks) else ():
            rows = np.resize(part, max(len(part), self.fill))

            def _take(name: str, index: int, tensor: Any, rows: Any = rows) -> None:
                place = self.places.get((name, index))
                if place is not None and tensor is not None and place.layout.fits(tuple(tensor.shape), len(rows)):
                    sketches.add(1, (place.layer, place.step), place.layout.split(tensor, len(rows)), rows)

            self._forward(model, self.run.stimuli(rows), _take)

    def _run_all(self, chunk: int, sketches: _Sketches) -> None:
        """Run all stimuli once, and write what is a response."""
        rooms, run = self.rooms, self.run
        firsts: dict[tuple[str, int], torch.Tensor] = {}
        moved: set[tuple[str, int]] = set()
        for part in run.chunks(chunk):
            batch = part.stop - part.start
            loops: dict[str, np.ndarray] = {}
            missing: dict[str, int] = {}

            def take(name: str, index: int, tensor: Any, part: Any = part, batch: Any = batch, loops: Any = loops,
                     missing: Any = missing) -> None:  # fmt: skip
                """Write the rows of one call [B, …] where they are a response, and say why of what is not read."""
                place = self.places.get((name, index))
                if place is None:
                    rooms.called.add(name)
                    if name not in rooms.not_read and f"{name}[{index}]" not in rooms.not_read:
                        rooms.not_read[name] = "does not run alike in every batch"
                    return
                if tensor is None or not place.layout.fits(tuple(tensor.shape), batch):
                    shape = "no tensor" if tensor is None else list(tensor.shape)
                    rooms.not_read[place.layer] = f"gives {shape} for {batch} stimuli, unlike in other batches"
                    return
                rows = place.layout.rows(tensor, batch, run.steps)
                stimuli = range(part.start, part.stop)
                sketches.add(0, (place.layer, place.step), place.layout.split(tensor, batch), stimuli)
                if not place.moved and (name, index) not in moved:
                    first = firsts.setdefault((name, index), rows[:1].cpu().clone())
                    if not proof.same(first.expand_as(rows), rows.cpu(), 0.0):
                        moved.add((name, index))
                if place.step is None:
                    rooms.write(place.layer, _plain(rows), part)
                    return
                if place.layer not in loops:
                    loops[place.layer] = np.full((batch, run.steps, rows.shape[-1]), np.nan, np.float32)
                    missing[place.layer] = run.steps
                loops[place.layer][:, place.step] = _plain(rows)[:, 0]
                missing[place.layer] -= 1
                if not missing[place.layer]:
                    rooms.write(place.layer, loops.pop(place.layer), part)

            self._forward(run.model, run.stimuli(part), take)
            for layer in loops:
                rooms.not_read[layer] = "does not run alike in every batch"
        for key, place in self.places.items():
            if not place.moved and key not in moved:
                rooms.not_read[place.layer] = proof.UNMOVED
