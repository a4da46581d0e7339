from __future__ import annotations

from dataclasses import replace

import pytest

from brainbench.core.errors import UsageError
from brainbench.scoring.recovery import find_cheapest, recover, study
from tests.factories.candidates import DESIGN, make_candidates


def test_processes_change_nothing():
    candidates = make_candidates(8)
    here = recover(candidates, DESIGN, boards=2, workers=1)
    assert recover(candidates, DESIGN, boards=2, workers=2) == here
    assert [(one.true, one.number) for one in here.boards] == [(t, n) for t in range(3) for n in range(2)]


def test_a_cluster_changes_nothing():
    distributed = pytest.importorskip("distributed")
    candidates = make_candidates(8)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp", host="127.0.0.1"
    ) as running:
        found = recover(candidates, DESIGN, boards=1, scheduler=running.scheduler_address)
    assert found == recover(candidates, DESIGN, boards=1, workers=1)


def test_an_interrupted_recovery_goes_on(tmp_path, monkeypatch):
    candidates = make_candidates(8)
    whole = recover(candidates, DESIGN, boards=1, workers=1, folder=tmp_path)
    (tmp_path / "boards-001-00000.json").unlink()
    made = []

    def counted(*arguments):
        made.append(arguments[2:])
        return original(*arguments)

    original = study.make_board
    monkeypatch.setattr(study, "make_board", counted)
    told = []
    again = recover(
        candidates, DESIGN, boards=1, workers=1, folder=tmp_path, progress=lambda *state: told.append(state)
    )
    assert again == whole
    assert made == [(1, 0)]
    assert told == [(3, 3, "scoring boards")]


def test_a_folder_of_another_recovery_is_refused(tmp_path):
    candidates = make_candidates(8)
    recover(candidates, DESIGN, boards=1, workers=1, folder=tmp_path)
    with pytest.raises(UsageError, match=r"another recovery: design\.seed 0 \(now 1\)"):
        recover(candidates, replace(DESIGN, seed=1), boards=1, workers=1, folder=tmp_path)
    for made in tmp_path.glob("boards-*"):
        made.unlink()
    recover(candidates, replace(DESIGN, seed=1), boards=1, workers=1, folder=tmp_path)
    (tmp_path / "config.json").unlink()
    with pytest.raises(UsageError, match=r"holds no recovery \(it has 'boards-"):
        recover(candidates, DESIGN, boards=1, workers=1, folder=tmp_path)


@pytest.mark.parametrize(
    ("candidates", "changes", "boards", "culprit"),
    [
        (make_candidates(names=("a",)), {}, 1, "at least 2"),
        (make_candidates(8), {"stimuli": 9}, 1, "9 stimuli .* the pool has 8"),
        (make_candidates(8), {"metric": "rsaa"}, 1, "'rsa'"),
        (make_candidates(8), {"layer": "layr1"}, 1, "'layer1'"),
        (make_candidates(8), {"metric": "decoding"}, 1, "'decoding'"),
        (make_candidates(8), {}, 0, "received 0"),
        (make_candidates(8), {"splits": 1.5}, 1, "splits .* received 1.5"),
        (make_candidates(8), {"seed": -1}, 1, "seed .* received -1"),
        ((*make_candidates(8), *make_candidates(9, names=("d",))), {}, 1, "different stimuli"),
    ],
)
def test_what_cannot_be_run_is_refused_before_it_starts(candidates, changes, boards, culprit):
    with pytest.raises(UsageError, match=culprit):
        recover(candidates, replace(DESIGN, **changes), boards=boards, workers=1)


@pytest.fixture
def small(monkeypatch):
    """A grid of four designs."""
    for name, values in (("ANIMALS", (4,)), ("UNITS", (40,)), ("TRIALS", (2, 8)), ("STIMULI", (6, 12))):
        monkeypatch.setattr(study, name, values)


def test_the_cheapest_design_that_suffices_is_named(small):
    candidates = make_candidates(14)
    best, tried = find_cheapest(candidates, DESIGN, 0.7, boards=3, workers=1)
    assert best is not None
    assert best.win_rate >= 0.7
    assert best == tried[-1]
    costs = [one.animals * one.trials * one.stimuli for one in tried]
    assert max(costs) == costs[-1]


def test_none_is_named_where_none_suffices(small):
    # Twins cannot be told apart, whatever is measured.
    (one,) = make_candidates(14, names=("a",))
    (twin,) = make_candidates(14, names=("b",))
    best, tried = find_cheapest((one, twin), DESIGN, 0.9, boards=4, workers=1)
    assert best is None
    assert tried


def test_a_rate_lies_between_0_and_1():
    with pytest.raises(UsageError, match="received 1"):
        find_cheapest(make_candidates(), DESIGN, 1.0)
