"""The folder of a run: a document says which run it holds, and a run goes on there only if it is that one.

It goes on from its state, a tree of tensors and plain values in one file, and ends early by time, count or signal.
"""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from brainbench.core.errors import DataError, UsageError, brief, check_number
from brainbench.core.files import is_temporary, lock_folder, read_mapping, to_plain, write_json, write_tensors
from brainbench.core.lazy import lazy_module
from brainbench.core.reading.regular import check_file, readable, reason
from brainbench.core.reading.tensors import check_finite

if TYPE_CHECKING:
    import torch
    from torch import nn
else:
    torch = lazy_module("torch")

RUN, CONFIG = "run.json", "config.json"
RESTART = "Delete it to start anew."


@dataclass(frozen=True)
class RunEnd:
    """How a run ended, at least for now."""

    status: Literal["finished", "stopped", "diverged"]
    """``stopped``: before its end, by time, count or signal; start it again to go on."""
    reason: str
    """Why it stopped or diverged; empty for a finished run."""
    folder: Path


def claim(
    document: Path,
    identity: Mapping[str, Any],
    begin: Callable[[], Mapping[str, Any]],
    *,
    stated: Callable[[dict[str, Any]], object],
    what: str = "run",
    write: bool = True,
) -> None:
    """Enter a run into its folder, or find it there: a run goes on if its identity is equal.

    Args:
        document: The file that says which run the folder holds.
        identity: What must be equal.
        begin: Gives the document of a new run.
        stated: Checks an earlier document, and returns what it states of the identity.
        what: What the folder holds, for messages.
        write: Off in all processes but one: a folder without a run stays so.
    """
    if document.is_file():
        check_same(document.parent, stated(read_mapping(document)), to_plain(identity), what)
    elif write:
        document.parent.mkdir(parents=True, exist_ok=True)
        write_json(document, begin())


def mark(document: Path, **values: Any) -> None:
    """Add to what a document says of its run."""
    write_json(document, {**read_mapping(document), **values})


def check_same(folder: Path, stated: object, identity: Mapping[str, Any], what: str = "run") -> None:
    """Check that what a folder states of its run is what identifies this one, both as JSON has it."""
    before, now = (dict(_leaves(part)) if isinstance(part, Mapping) else {} for part in (stated, identity))
    # Of what identifies a run, no part may have more in it than now.
    names = [*now, *(name for name in before if name not in now and name.partition(".")[0] in identity)]
    if differing := [name for name in names if before.get(name) != now.get(name)]:
        changes = ", ".join(f"{name} {brief(before.get(name))} (now {brief(now.get(name))})" for name in differing[:4])
        raise UsageError(f"{str(folder)!r} holds another {what}: {changes}. Choose another folder, or delete this one.")


def begin_run(folder: Path, config: Mapping[str, Any], what: str, *, results: str) -> None:
    """Note in an existing folder what is begun there, or check that it is what was begun.

    A first try that made none of its ``results`` (a pattern of files) does not stand in the way: its note is replaced.
    """
    path, config = folder / CONFIG, to_plain(config)
    if not path.exists():
        if strange := sorted(path.name for path in folder.iterdir() if not is_temporary(path.name)):
            raise UsageError(
                f"{str(folder)!r} is not empty and holds no {what} (it has {strange[0]!r}); choose a new folder."
            )
    elif any(folder.glob(results)):
        check_same(folder, read_mapping(path), config, what)
        return
    write_json(path, config)


def _leaves(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


STATE = "state.safetensors"
_LEAF = "__tensor__"


def flatten(tree: Any, prefix: str = "") -> tuple[dict[str, torch.Tensor], Any]:
    """Split a tree into named tensors and a JSON-able rest."""
    tensors: dict[str, torch.Tensor] = {}
    if isinstance(tree, torch.Tensor):
        return {prefix: tree}, {_LEAF: prefix}
    if isinstance(tree, Mapping):
        pairs = []
        for key, value in tree.items():
            inner, rest = flatten(value, f"{prefix}/{key}")
            tensors |= inner
            # JSON knows only text as keys; optimizers number their parameters.
            pairs.append(["int" if isinstance(key, int) else "str", str(key), rest])
        return tensors, {"__dict__": pairs}
    if isinstance(tree, (list, tuple)):
        entries = []
        for index, value in enumerate(tree):
            inner, rest = flatten(value, f"{prefix}/{index}")
            tensors |= inner
            entries.append(rest)
        return tensors, {"__tuple__" if isinstance(tree, tuple) else "__list__": entries}
    return tensors, tree


def restore(rest: Any, tensors: Mapping[str, torch.Tensor]) -> Any:
    """Put together what :func:`flatten` split."""
    if isinstance(rest, dict):
        if _LEAF in rest:
            return tensors[rest[_LEAF]]
        if "__dict__" in rest:
            return {int(k) if kind == "int" else k: restore(v, tensors) for kind, k, v in rest["__dict__"]}
        if "__tuple__" in rest:
            return tuple(restore(value, tensors) for value in rest["__tuple__"])
        if "__list__" in rest:
            return [restore(value, tensors) for value in rest["__list__"]]
    return rest


def save_state(path: str | os.PathLike[str], tree: Mapping[Any, Any]) -> None:
    """Write a tree to one safetensors file, replaced as a whole."""
    tensors, rest = flatten(tree)
    write_tensors(path, tensors, tree=json.dumps(rest))


def load_state(path: str | os.PathLike[str]) -> Any:
    """Read a tree; its tensors are on the CPU."""
    from safetensors import safe_open

    check_file(path, "saved state")
    with readable(path, "saved state", RESTART):
        with safe_open(str(path), framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            metadata = file.metadata() or {}
        tree = restore(json.loads(metadata["tree"]), tensors)
    if not isinstance(tree, dict):
        raise DataError(f"{str(path)!r} is damaged or not one of ours: it holds no names and values.")
    return tree


def random_state(device: torch.device) -> dict[str, torch.Tensor]:
    """Return the states of PyTorch's random numbers on the CPU and on a device."""
    states = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device)
    return states


def set_random_state(states: Mapping[str, torch.Tensor], device: torch.device) -> None:
    """Put random numbers back where :func:`random_state` found them."""
    torch.set_rng_state(states["cpu"])
    if device.type == "cuda" and "cuda" in states:
        torch.cuda.set_rng_state(states["cuda"], device)


def learner_state(learner: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the weights and moments of a training, as part of its state."""
    return {"learner": learner.state_dict(), "optimizer": optimizer.state_dict()}


def restore_learner(
    state: Mapping[str, Any], learner: nn.Module, optimizer: torch.optim.Optimizer, path: str | os.PathLike[str]
) -> None:
    """Put weights and moments of a state read from a file back; all of them must be finite and fit."""
    weights, moments = state["learner"], state["optimizer"]
    check_finite(flatten([weights, moments])[0], os.fspath(path))
    try:
        learner.load_state_dict(weights)
    except RuntimeError as error:
        raise DataError(f"{brief(os.fspath(path))} belongs to another network ({reason(error)}). {RESTART}") from error
    optimizer.load_state_dict(moments)
    for name in {name for entries in optimizer.state.values() for name in entries}:
        pairs = optimizer.state.items()
        shapes = [(getattr(entries.get(name), "shape", None), weight.shape) for weight, entries in pairs]
        # Moments have the shapes of the weights; counts of steps are alike for all.
        if any(shape != expected for shape, expected in shapes) and len({shape for shape, _ in shapes}) > 1:
            raise DataError(f"{brief(name)} of the optimiser in {brief(os.fspath(path))} fits no weights. {RESTART}")


class Stop:
    """Says when to stop: ``seconds`` after it was made, at a ``count`` of what is ``counted``, or on SIGTERM."""

    def __init__(self, seconds: float | None = None, count: int | None = None, counted: str = "steps") -> None:
        if seconds is not None:
            check_number("stop_after", seconds, least=0)
        self.seconds, self.count, self.counted = seconds, count, counted
        self.terminated = False
        self._start = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start

    def reason(self, done: int = 0) -> str:
        """Return why the run stops here, where ``done`` are counted; empty while it goes on."""
        if self.terminated:
            cause = "it received SIGTERM"
        elif self.seconds is not None and self.elapsed > self.seconds:
            cause = f"the {self.seconds:g} s allowed are over"
        elif self.count is not None and done >= self.count:
            cause = f"{self.count} {self.counted} are done, as many as were allowed"
        else:
            return ""
        return f"{cause}; start it again to go on"


@contextmanager
def occupied(folder: Path, stop: Stop, *, lock: bool = True) -> Iterator[None]:
    """Hold a run's folder, in which no other process may write meanwhile, and let SIGTERM ask the run to stop.

    Schedulers send that signal before they end a job: the run then saves its state first. Without ``lock``, as in all
    processes of a run but one, the folder is not held.
    """

    def terminate(number: int, frame: object) -> None:
        """Note that the run was asked to stop."""
        stop.terminated = True

    # Python delivers signals to the main thread alone, and lets no other one ask for them.
    listens = threading.current_thread() is threading.main_thread()
    with lock_folder(folder, wait=False) if lock else nullcontext():
        before = signal.signal(signal.SIGTERM, terminate) if listens else None
        try:
            yield
        finally:
            if listens:
                signal.signal(signal.SIGTERM, before)
