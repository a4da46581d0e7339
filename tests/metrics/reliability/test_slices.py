"""An animal taken in slices of units has the numbers of one taken at once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.trials import Trials
from brainbench.metrics.reliability.sessions import SortedTrials
from brainbench.metrics.reliability.subject_rdm import subject_rdm


def _block(missing: bool) -> Trials:
    rng = np.random.default_rng(4)
    labels = np.arange(48) % 6
    responses = rng.gamma(2.0, 4.0, (6, 900))[labels] + rng.normal(size=(48, 900))
    if missing:
        responses[rng.uniform(size=responses.shape) < 0.05] = np.nan
    return Trials(responses, labels, [str(trial) for trial in range(48)])


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("method", ["correlation", "sqeuclidean", "mahalanobis", "crossnobis"])
def test_slices_change_no_number_and_no_response_of_the_caller(method, missing, monkeypatch):
    block = _block(missing)
    before = block.responses.copy()
    whole = subject_rdm("a", [block], 6, method=method, splits=20)
    np.testing.assert_array_equal(block.responses, before)
    monkeypatch.setattr(SortedTrials, "slices", lambda self: (slice(at, at + 70) for at in range(0, 900, 70)))
    sliced = subject_rdm("a", [block], 6, method=method, splits=20)
    for name in ("rdm", "split_half_r", "halves", "patterns", "noise"):
        np.testing.assert_allclose(getattr(sliced, name), getattr(whole, name), rtol=1e-11, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("job", ["score, every time step kept, crossnobis", "score, every time step kept"])
def test_a_thousand_units_in_bins_of_ten_milliseconds_take_less_than_four_gigabytes(job):
    root = Path(__file__).parents[3]
    words = [sys.executable, "-m", "benchmarks.scores.memory", "--job", job]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    found = subprocess.run(words, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    assert json.loads(found.stdout.splitlines()[-1])["gigabytes"] < 4
