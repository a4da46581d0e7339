import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.datasets import export, open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from tests.factories.recordings import make_simple_session


def halves(**options):
    """One session as one file would hold it, and as two probes."""
    whole = make_simple_session(units=6, **options)
    spikes = whole.units.rows("spike_times")
    tables = {"trials": dict(whole.tables["trials"].data)}
    return whole, [make_session("mouse", "1", part, tables) for part in (spikes[:2], spikes[2:])]


def test_probes_of_one_session_count_as_recorded_at_once(tmp_path):
    whole, probes = halves()
    write_recordings(tmp_path / "whole.h5", whole)
    for number, probe in enumerate(probes):
        write_recordings(tmp_path / "probes" / f"sub-mouse_probe-{number}.h5", probe)
    one = open_recordings(tmp_path / "whole.h5", conditions="trials:stimulus")
    two = open_recordings(tmp_path / "probes", conditions="trials:stimulus")
    assert two.sizes == one.sizes
    np.testing.assert_array_equal(np.sort(two["counts"], axis=2), np.sort(one["counts"], axis=2))
    assert two.attrs["ledger"]["trials"]["found"] == 12
    assert two.attrs["ledger"]["units"]["read"] == 6
    for target in ("again.h5", "again"):
        export(tmp_path / "probes", tmp_path / target)
        again = open_recordings(tmp_path / target, conditions="trials:stimulus")
        assert again.attrs["content_hash"] == two.attrs["content_hash"]


def test_a_probe_that_stops_early_leaves_gaps_and_removes_no_trials(tmp_path):
    _, (first, second) = halves()
    short = [times[times < 12] for times in second.units.rows("spike_times")]
    tables = {"trials": dict(second.tables["trials"].data)}
    write_recordings(tmp_path / "a.h5", make_session("mouse", "1", short, tables))
    write_recordings(tmp_path / "b.h5", first)
    opened = open_recordings(tmp_path, conditions="trials:stimulus")
    assert opened.sizes["trial"] == 12
    assert np.isnan(opened["counts"]).any(axis=(0, 1)).values.sum() == 4
    assert not any("balance" in doubt for doubt in opened.attrs["doubts"])


@pytest.mark.parametrize("shift", [0.0, 100.0])
@pytest.mark.parametrize("units", [6, 4])
def test_the_same_spikes_under_another_name_are_refused(tmp_path, shift, units):
    whole, _ = halves()
    spikes = [times + shift for times in whole.units.rows("spike_times")][:units]
    table = dict(whole.tables["trials"].data)
    table |= {name: table[name] + shift for name in ("start_time", "stop_time")}
    write_recordings(tmp_path / "a.h5", whole)
    write_recordings(tmp_path / "b.h5", make_session("other", "9", spikes, {"trials": table}))
    with pytest.raises(DataError, match=rf"hold the same spikes \({units} of {units} units\)"):
        open_recordings(tmp_path, conditions="trials:stimulus")


def test_a_few_units_of_another_session_are_a_doubt(tmp_path):
    whole, _ = halves()
    spikes = whole.units.rows("spike_times")[:1] + make_simple_session(subject="x", units=4).units.rows("spike_times")
    write_recordings(tmp_path / "a.h5", whole)
    write_recordings(tmp_path / "b.h5", make_session("x", "1", spikes, {"trials": dict(whole.tables["trials"].data)}))
    doubts = open_recordings(tmp_path, conditions="trials:stimulus").attrs["doubts"]
    assert any("hold the same spikes (1 of 5 units), which count twice" in doubt for doubt in doubts)


def test_sessions_of_one_name_with_other_trials_stay_apart_and_are_said(tmp_path):
    for number in range(2):
        start = 1 + (2.0 + 0.37 * number) * np.arange(12)
        made = make_simple_session(seed=number, columns={"start_time": start})
        write_recordings(tmp_path / f"day{number}.h5", made)
    opened = open_recordings(tmp_path, conditions="trials:stimulus")
    assert sorted(set(opened["session"].values)) == ["1 (day0)", "1 (day1)"]
    assert any("called '1'" in doubt for doubt in opened.attrs["doubts"])
