"""The lines of a campaign's ``trainings.jsonl``: one for each network that was trained or probed, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from brainbench.core.errors import DataError, check_name, listing
from brainbench.core.reading.texts import parse_json, read_text

TRAININGS = "trainings.jsonl"
OBJECTIVES = ("supervised", "simclr", "simsiam", "ae", "untrained", "baseline")


@dataclass(frozen=True)
class Accuracy:
    """Accuracy on the test sweeps, as :class:`brainbench.models.training.evaluation.Evaluation` states it."""

    top1: float
    top5: float
    count: int
    collapsed: bool = False
    reason: str = ""


@dataclass(frozen=True)
class Training:
    """One line of ``trainings.jsonl``: a network trained once, an untrained one, or a baseline."""

    name: str
    objective: str
    model: str = ""
    seed: int = 0
    augmentation: str = "none"
    masking: float = 0.0
    epochs: int | None = None
    learning_rate: float | None = None
    rate: float | None = None
    """Learning rate that was given instead of searched."""
    evaluation: Accuracy | None = None
    """None for a training that diverged or is not finished."""
    twin_evaluation: Accuracy | None = None
    parameters: int | None = None
    status: str = "finished"
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def finished(self) -> bool:
        """False for a training that diverged or was interrupted: its network counts for nothing."""
        return self.status == "finished"


def read_trainings(path: Path) -> list[Training]:
    """Read the lines of a campaign, each checked.

    Raises:
        DataError: a line is not JSON, lacks a field, holds an impossible value, or stands there twice.
    """
    found: dict[str, Training] = {}
    for number, line in enumerate(read_text(path, "list of trainings").splitlines(), start=1):
        if not line.strip():
            continue
        place = f"Line {number} of {path.name!r}"
        try:
            training = msgspec.convert(parse_json(line, place), Training)
        except msgspec.ValidationError as error:
            raise DataError(f"{place} is not a training: {error}; write the line again or delete it.") from error
        check_name(f"objective in line {number} of {path.name!r}", training.objective, OBJECTIVES)
        faults = [
            f"has top-1 {one.top1}, top-5 {one.top5} of {one.count} sweeps; 0 ≤ top-1 ≤ top-5 ≤ 1 is needed"
            for one in (training.evaluation, training.twin_evaluation)
            if one and not (0 <= one.top1 <= one.top5 <= 1 and one.count)
        ]
        if training.objective != "baseline" and not training.model:
            faults.append("names no model; give the registry name as 'model'")
        if found.setdefault(training.name, training) is not training:
            faults.append("repeats an earlier line; keep one line for each training")
        if faults:
            raise DataError(f"{place} ({training.name!r}) {faults[0]}.")
    classes = {item.data["classes"] for item in found.values() if item.data.get("classes")}
    if len(classes) > 1:
        raise DataError(
            f"The trainings of {path.name!r} have different numbers of classes ({listing(map(str, classes))}), so "
            "their accuracies cannot be compared; keep one campaign in a file."
        )
    return list(found.values())
