"""The files of a run: what it trains, where it stands, its log, and a batch that broke it.

``run.json`` identifies the run and tells its end. ``state.safetensors`` is its whole state, so that it goes on exactly
where it stood: tensors (weights, optimiser, random states) as they are, everything else as JSON in the header. It
replaces its predecessor in one move: after a kill there is the old state or the new one. ``log.jsonl`` has one JSON
document per line, repeated in ``tensorboard/`` where that is installed.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from brainbench.core.errors import DataError, install_command, shown
from brainbench.core.files import read_mapping, write_json, write_text
from brainbench.core.reading.regular import check_file, readable, reason
from brainbench.core.reading.tensors import check_finite
from brainbench.core.writing.same_run import check_same
from brainbench.core.writing.tensors import write_tensors

_log = logging.getLogger(__name__)

RUN, STATE, LOG, BEST, FAILED = "run.json", "state.safetensors", "log.jsonl", "best", "failed-batch.safetensors"
CONTROLS_FILE = "controls.json"
RESTART = "Delete it to start anew."


def claim(folder: Path, identity: Mapping[str, Any], *, write: bool) -> None:
    """Enter a run into its folder, or find it there: a run is resumed if its identity is equal.

    Where ``write`` is off, as in all processes but one, a folder without a run stays so.
    """
    path = folder / RUN
    if path.is_file():
        check_same(folder, read_mapping(path).get("run"), identity)
    elif write:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(path, {"run": dict(identity), "status": "running"})


def mark(folder: Path, **values: Any) -> None:
    """Add to what the folder says of its run."""
    write_json(folder / RUN, {**read_mapping(folder / RUN), **values})


def save_state(path: Path, learner: nn.Module, optimizer: torch.optim.Optimizer, plain: Mapping[str, Any]) -> None:
    """Write weights, optimiser, random states and plain values."""
    tensors = {f"learner.{name}": value for name, value in learner.state_dict().items()}
    packed = optimizer.state_dict()
    scalars: dict[str, dict[str, Any]] = {}
    for index, entries in packed["state"].items():
        for key, value in entries.items():
            if isinstance(value, torch.Tensor):
                tensors[f"optimizer.{index}.{key}"] = value
            else:
                scalars.setdefault(str(index), {})[key] = value
    # Dropout draws from these; augmentation does not, its numbers depend on seed, step and view alone.
    tensors["random.cpu"] = torch.get_rng_state()
    if torch.cuda.is_available():
        tensors["random.cuda"] = torch.cuda.get_rng_state()
    header = {"groups": packed["param_groups"], "scalars": scalars, "plain": dict(plain)}
    write_tensors(path, tensors, state=json.dumps(header))


def load_state(path: Path, learner: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Put a run back where :func:`save_state` found it; return the plain values."""
    from safetensors import safe_open

    check_file(path, "training state")
    weights: dict[str, torch.Tensor] = {}
    with readable(path, "training state", RESTART):
        with safe_open(path, framework="pt") as file:
            header = json.loads(file.metadata()["state"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        check_finite(tensors, str(path))
        entries: dict[int, dict[str, Any]] = {int(key): dict(value) for key, value in header["scalars"].items()}
        for name, value in tensors.items():
            owner, _, rest = name.partition(".")
            if owner == "learner":
                weights[rest] = value
            elif owner == "optimizer":
                index, _, key = rest.partition(".")
                entries.setdefault(int(index), {})[key] = value
        try:
            learner.load_state_dict(weights)
        except RuntimeError as error:
            raise DataError(f"{shown(str(path))} belongs to another network ({reason(error)}). {RESTART}") from error
        optimizer.load_state_dict({"state": entries, "param_groups": header["groups"]})
        for name in {name for kept in optimizer.state.values() for name in kept}:
            states = optimizer.state.items()
            shapes = [(getattr(kept.get(name), "shape", None), weight.shape) for weight, kept in states]
            # Moments have the shapes of the weights; counts of steps are alike for all.
            if any(own != shape for own, shape in shapes) and len({own for own, _ in shapes}) > 1:
                raise DataError(f"{shown(name)} of the optimiser in {shown(str(path))} fits no weights. {RESTART}")
        torch.set_rng_state(tensors["random.cpu"])
        if torch.cuda.is_available() and "random.cuda" in tensors:
            torch.cuda.set_rng_state(tensors["random.cuda"])
        return header["plain"]


def trim_log(path: Path, key: str, last: int) -> None:
    """Drop the lines of a log that came after the last saved state, and what a kill cut short.

    Args:
        path: JSON documents, one a line; made if it is missing.
        key: field that counts, for example ``step``.
        last: its value in the saved state.
    """
    kept = []
    for line in check_file(path, LOG).read_bytes().splitlines() if path.exists() else ():
        try:
            if json.loads(line)[key] <= last:
                kept.append(line.decode())
        except (ValueError, LookupError, TypeError, RecursionError):
            break
    write_text(path, "".join(f"{line}\n" for line in kept))


class RunLog:
    """Appends to ``log.jsonl`` and to TensorBoard's folder, in the first process of a run alone (``active``).

    Lines of steps later than ``step``, written before an interruption, are dropped.
    """

    def __init__(self, folder: Path, *, step: int, active: bool = True) -> None:
        self._writer: Any = None
        self._file: Any = None
        if not active:
            return
        path = folder / LOG
        trim_log(path, "step", step)
        self._file = path.open("a", encoding="utf-8")
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            _log.info("TensorBoard is not installed (%s); %s is written alone.", install_command("train"), LOG)
        else:
            self._writer = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, kind: str, step: int, **values: float) -> None:
        """Log numbers of one kind (``train``, ``validation``, …) at an optimiser step; NaN becomes null."""
        if self._file is None:
            return
        plain = {name: value if math.isfinite(value) else None for name, value in values.items()}
        self._file.write(json.dumps({"kind": kind, "step": step, **plain}) + "\n")
        self._file.flush()
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{kind}/{name}", value, step)

    def close(self) -> None:
        """Close the files."""
        if self._file is not None:
            self._file.close()
        if self._writer is not None:
            self._writer.close()


def read_log(folder: str | Path, kind: str) -> list[dict[str, Any]]:
    """Return the lines of one kind (``train``, ``epoch``, ``validation``, ``test``) of a run's log."""
    path = Path(folder) / LOG
    if not path.is_file():
        raise DataError(f"There is no log {str(path)!r}.")
    with readable(path, "log of a run"):
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return [line for line in lines if line["kind"] == kind]
