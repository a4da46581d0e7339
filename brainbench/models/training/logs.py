"""Logs of a run: one JSON document per line, and TensorBoard when it is installed."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any

_log = logging.getLogger(__name__)

LOG = "log.jsonl"


class RunLog:
    """Appends to ``log.jsonl`` and to TensorBoard's folder.

    Args:
        folder: The run's folder.
        step: Optimiser steps done; lines of later steps, written before an interruption, are dropped.
        active: Only the first process of a run writes.
    """

    def __init__(self, folder: Path, *, step: int, active: bool = True) -> None:
        self._writer: Any = None
        self._file: Any = None
        if not active:
            return
        path = folder / LOG
        kept = []
        if path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    if json.loads(line)["step"] <= step:
                        kept.append(line)
                except (json.JSONDecodeError, KeyError):  # the line that a kill cut short
                    break
        from brainbench.core.files import write_text

        write_text(path, "".join(f"{line}\n" for line in kept))
        self._file = path.open("a", encoding="utf-8")
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            _log.info("TensorBoard is not installed (pip install 'brainbench[train]'); %s is written alone.", LOG)
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
