"""The log of a run: ``log.jsonl``, and where else its numbers go: TensorBoard, a CSV file, Weights & Biases offline."""

from __future__ import annotations

import csv
import io
import json
import logging
import math
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from brainbench.core.errors import MissingDependencyError, check_name, install_command, missing_dependency
from brainbench.core.files import write_text
from brainbench.core.reading.regular import check_file, readable
from brainbench.core.reading.texts import read_text

_log = logging.getLogger(__name__)

LOG, CSV, BOARD = "log.jsonl", "log.csv", "tensorboard"
SINKS = ("tensorboard", "csv", "wandb")


def check_sinks(names: Iterable[str]) -> None:
    """Check names of :data:`SINKS`, and that their packages are there, before anything is trained."""
    for name in names:
        check_name("logger", name, SINKS)
        if name == "tensorboard" and find_spec(name) is None:
            raise missing_dependency(name, extra="policies", purpose="The logger 'tensorboard'")
        if name == "wandb" and find_spec(name) is None:
            raise MissingDependencyError("The logger 'wandb' needs its package, of no extra of ours: pip install wandb")


class RunLog:
    """Appends to ``log.jsonl`` and to sinks, in the first process of a run alone (``active``).

    Args:
        folder: The run's folder.
        counter: Field that counts, ``step`` or ``iteration``.
        last: Its value in the state that the run goes on from; later lines are dropped.
        sinks: Of :data:`SINKS`; without its package TensorBoard is left out.
        facts: Facts of the run, for Weights & Biases.
        active: Off in all processes but one.
    """

    def __init__(
        self,
        folder: Path,
        counter: str,
        last: int,
        *,
        sinks: Iterable[str] = ("tensorboard",),
        facts: Mapping[str, Any] | None = None,
        active: bool = True,
    ) -> None:
        self.folder, self.counter, self.sinks = folder, counter, tuple(sinks) if active else ()
        self._file: Any = None
        self._board: Any = None
        self._wandb: Any = None
        if not active:
            return
        trim_log(folder / LOG, counter, last)
        self._file = (folder / LOG).open("a", encoding="utf-8")
        if "tensorboard" in self.sinks:
            self._board = _open_board(folder / BOARD, last)
        if "wandb" in self.sinks:
            import wandb

            # Offline: nothing leaves the machine until its user runs `wandb sync`.
            self._wandb = wandb.init(
                project="brainbench", name=folder.name, dir=str(folder), mode="offline", config=dict(facts or {})
            )

    def write(self, kind: str, count: int, **values: float) -> None:
        """Log numbers of one kind (``train``, …; empty where there is but one) at a count; NaN becomes null."""
        if self._file is None:
            return
        plain = {name: value if math.isfinite(value) else None for name, value in values.items()}
        head: dict[str, Any] = {"kind": kind} if kind else {}
        self._file.write(json.dumps({**head, self.counter: count, **plain}) + "\n")
        self._file.flush()
        tagged = {f"{kind}/{name}" if kind else name: value for name, value in values.items()}
        if self._board is not None:
            for tag, value in tagged.items():
                self._board.add_scalar(tag, value, count)
        if self._wandb is not None:
            self._wandb.log(tagged, step=count)

    def save(self) -> None:
        """Bring the CSV file up to ``log.jsonl``, from which a resumed run dropped what it does again."""
        if "csv" not in self.sinks:
            return
        rows = [json.loads(line) for line in (self.folder / LOG).read_text(encoding="utf-8").splitlines()]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self.folder / CSV, text.getvalue())

    def close(self) -> None:
        """Close what is open."""
        self.save()
        if self._file is not None:
            self._file.close()
        if self._board is not None:
            self._board.close()
        if self._wandb is not None:
            self._wandb.finish()


def _open_board(folder: Path, last: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        _log.info("TensorBoard is not installed (%s); %s is written alone.", install_command("train"), LOG)
        return None
    return SummaryWriter(str(folder), purge_step=last + 1)


def trim_log(path: Path, counter: str, last: int) -> None:
    """Drop the lines of a log that came after the last saved state, and what a kill cut short.

    The log has one JSON document a line, and is made if it is missing; ``last`` is the value of ``counter`` in the
    state.
    """
    retained = []
    for line in check_file(path, LOG).read_bytes().splitlines() if path.exists() else ():
        try:
            if json.loads(line)[counter] <= last:
                retained.append(line.decode())
        except (ValueError, LookupError, TypeError, RecursionError):
            break
    write_text(path, "".join(f"{line}\n" for line in retained))


def read_log(folder: str | Path, kind: str) -> list[dict[str, Any]]:
    """Return the lines of one kind (``train``, ``epoch``, ``validation``, ``test``) of a run's log."""
    path = Path(folder) / LOG
    text = read_text(path, "log of a run")
    with readable(path, "log of a run"):
        lines = [json.loads(line) for line in text.splitlines()]
        return [line for line in lines if line["kind"] == kind]
