from __future__ import annotations

import math
import os
from functools import partial

import pytest

from brainbench.core.errors import DataError, MissingDependencyError, UsageError
from brainbench.core.runs.jobs import run_jobs


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_is_answered_with_its_place(workers):
    jobs = [4, 9, 16]
    assert dict(run_jobs(math.sqrt, jobs, workers=workers)) == {0: 2.0, 1: 3.0, 2: 4.0}


def test_linear_algebra_takes_one_thread_in_each_process():
    found = dict(run_jobs(os.getenv, ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"], workers=2))
    assert found == {0: "1", 1: "1"}


def test_what_a_job_raises_is_raised_here():
    with pytest.raises(ValueError, match="'x'"):
        dict(run_jobs(int, ["1", "x"], workers=2))


def test_a_process_that_dies_is_said():
    with pytest.raises(DataError, match="fewer workers"):
        dict(run_jobs(os._exit, [3, 3], workers=2))


def test_no_jobs_and_no_workers():
    assert list(run_jobs(partial(max, 1), [])) == []
    with pytest.raises(UsageError, match="received 0"):
        list(run_jobs(abs, [1], workers=0))


def test_without_dask_the_extra_is_named(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingDependencyError, match="cluster"):
        list(run_jobs(abs, [1], scheduler="tcp://127.0.0.1:9"))


@pytest.mark.parametrize("workers", [0, -1, 1.5, math.nan, True, "2"])
def test_workers_are_whole_and_positive(workers):
    with pytest.raises(UsageError, match=f"workers .*{workers}"):
        list(run_jobs(abs, [1, 2], workers=workers))
