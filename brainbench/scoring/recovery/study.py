"""Run the boards of a recovery, on this machine or a cluster, and go on where an earlier run stopped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.files import read_json, to_plain, write_json
from brainbench.core.jobs import run_jobs
from brainbench.core.progress import Progress
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.regular import readable
from brainbench.core.writing.same_run import begin_run
from brainbench.metrics.measures.metric import get_metric
from brainbench.scoring.recovery.boards import RecoveryBoard, make_board
from brainbench.scoring.recovery.candidates import Candidate
from brainbench.scoring.recovery.confusion import Recovery
from brainbench.scoring.recovery.design import RecoveryDesign

BOARDS = 10
_TOGETHER = 5
"""Boards that one job makes and one file keeps."""


@dataclass(frozen=True)
class _Job:
    """Some boards of one true candidate."""

    true: int
    numbers: tuple[int, ...]

    @property
    def file(self) -> str:
        """Name of the file of its boards in the folder of a study."""
        return f"boards-{self.true:03d}-{self.numbers[0]:05d}.json"


def recover(
    candidates: Sequence[Candidate],
    design: RecoveryDesign | None = None,
    *,
    boards: int = BOARDS,
    first: int = 0,
    folder: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Recovery:
    """Draw boards from every candidate and count how often the true one wins.

    Neither ``workers`` nor the scheduler changes a number. With a folder, a run that was killed goes on when it is
    started again. ``first`` is the number of the first board: boards of other numbers have other animals. A folder
    keeps finished boards; ``scheduler`` is the address of a Dask scheduler, whose workers make the boards instead of
    processes here.
    """
    design = design or RecoveryDesign()
    check_candidates(candidates, design, boards)
    check_number("The number of the first board", first, least=0, whole=True)
    jobs = [
        _Job(true, tuple(range(start, min(start + _TOGETHER, first + boards))))
        for start in range(first, first + boards, _TOGETHER)
        for true in range(len(candidates))
    ]
    found: dict[_Job, list[RecoveryBoard]] = {}
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        config = {"candidates": [item.identity for item in candidates], "design": design}
        begin_run(folder, config, "recovery", made="boards-*.json")
        for job in jobs:
            if (folder / job.file).is_file():
                with readable(folder / job.file, "part of a recovery", "Delete it to make it again."):
                    kept = [RecoveryBoard.of(item) for item in read_json(folder / job.file)]
                if [item.number for item in kept] == list(job.numbers):
                    found[job] = kept
    missing = [job for job in jobs if job not in found]
    total = done = sum(len(job.numbers) for job in jobs)
    done -= sum(len(job.numbers) for job in missing)
    work = partial(_make_boards, tuple(candidates), design)
    for place, made in run_jobs(work, missing, workers=workers, scheduler=scheduler):
        job = missing[place]
        found[job] = made
        done += len(made)
        if folder is not None:
            write_json(folder / job.file, to_plain(made))
        if progress is not None:
            progress(done, total, "scoring boards")
    every = sorted((board for job in jobs for board in found[job]), key=lambda one: (one.true, one.number))
    shown = design.stimuli or len(candidates[0].stimuli)
    return Recovery(tuple(item.name for item in candidates), design, shown, tuple(every))


def _make_boards(candidates: tuple[Candidate, ...], design: RecoveryDesign, job: _Job) -> list[RecoveryBoard]:
    return [make_board(candidates, design, job.true, number) for number in job.numbers]


def check_candidates(candidates: Sequence[Candidate], design: RecoveryDesign, boards: int) -> None:
    """Raise UsageError for what cannot be run, before any work."""
    check_number("number of candidates, which a recovery tells apart,", len(candidates), least=2)
    check_number("The number of boards", boards, least=1, whole=True)
    pool = len(candidates[0].stimuli)
    if any(item.stimuli != candidates[0].stimuli for item in candidates):
        raise UsageError("The candidates saw different stimuli; run all of them on the same ones in the same order.")
    if design.stimuli is not None and design.stimuli > pool:
        raise UsageError(f"A board of {design.stimuli} stimuli was asked for; the pool has {pool}.")
    if get_metric(design.metric).of_model_alone:
        raise UsageError(
            f"The metric {design.metric!r} scores a model without looking at the animals, so it cannot tell who made "
            "their data; choose another, such as 'rsa'."
        )
    if design.layer not in ("any", "last"):
        for item in candidates:
            item.choose(design.layer, np.random.default_rng(0))
