"""Where the numbers of a training run go beside ``log.jsonl``: TensorBoard, a CSV file, Weights & Biases offline."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from brainbench.core.errors import MissingDependencyError, check_name, missing_dependency
from brainbench.core.files import write_text
from brainbench.models.training.run_folder import LOG

LOGGERS = ("tensorboard", "csv", "wandb")
CSV = "log.csv"


def check_loggers(names: Iterable[str]) -> None:
    """Check names of :data:`LOGGERS`, and that their packages are there, before anything is trained."""
    for name in names:
        check_name("logger", name, LOGGERS)
        if name == "tensorboard" and find_spec(name) is None:
            raise missing_dependency(name, extra="policies", purpose="The logger 'tensorboard'")
        if name == "wandb" and find_spec(name) is None:
            raise MissingDependencyError("The logger 'wandb' needs its package, of no extra of ours: pip install wandb")


class Loggers:
    """Writes the numbers of each iteration of the run in a folder; ``facts`` describe the run.

    Names are those that :func:`check_loggers` lets through.
    """

    def __init__(self, run: Path, names: Iterable[str], facts: Mapping[str, Any]) -> None:
        self._run, self._names = run, tuple(names)
        self._board: Any = None
        self._wandb: Any = None
        if "tensorboard" in self._names:
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(run))
        if "wandb" in self._names:
            import wandb

            # Offline: nothing leaves the machine until its user runs `wandb sync`.
            self._wandb = wandb.init(
                project="brainbench", name=run.name, dir=str(run), mode="offline", config=dict(facts)
            )

    def write(self, row: Mapping[str, float], iteration: int) -> None:
        """Log the numbers of an iteration."""
        if self._board is not None:
            for name, value in row.items():
                self._board.add_scalar(name, value, iteration)
        if self._wandb is not None:
            self._wandb.log(dict(row), step=iteration)

    def save(self) -> None:
        """Bring the CSV file up to ``log.jsonl``, from which a resumed run dropped what it does again."""
        path = self._run / LOG
        if "csv" not in self._names or not path.is_file():
            return
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, list(dict.fromkeys(name for row in rows for name in row)), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        write_text(self._run / CSV, text.getvalue())

    def close(self) -> None:
        """Close what is open."""
        self.save()
        if self._board is not None:
            self._board.close()
        if self._wandb is not None:
            self._wandb.finish()
