from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import export, open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.datasets.trials.session_trials import Copies, pooled, same_trials, trials_by_subject
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.recordings import make_simple_session


def make_dataset(folder, **options):
    sessions = [
        make_simple_session(subject="m1", session="1", seed=1, observed=options.get("observed")),
        make_simple_session(subject="m1", session="2", units=5, seed=2),
        make_simple_session(subject="m2", session="1", units=2, seed=3),
    ]
    path = write_recordings(folder / "a.h5", sessions)
    return open_recordings(path, conditions="trials:stimulus", bin=options.get("bin"))


def test_each_session_is_one_block_of_rates(tmp_path):
    dataset = make_dataset(tmp_path, bin=0.4)
    found = trials_by_subject(dataset)
    assert [(name, [block.responses.shape for block in items]) for name, items in found.items()] == [
        ("m1", [(12, 3, 3), (12, 3, 5)]),
        ("m2", [(12, 3, 2)]),
    ]
    block = found["m1"][1]
    counts, duration = dataset["counts"].values[12:24, :, 3:8], dataset["duration"].values[12:24]
    np.testing.assert_allclose(block.responses, counts / duration[..., None])
    labels = [dataset.attrs["vocabulary"][index] for index in block.labels]
    assert labels == dataset["stimulus"].values[12:24].tolist()


def test_a_session_holds_one_response_label_and_key_per_trial(tmp_path):
    trials = trials_by_subject(make_dataset(tmp_path))["m2"][0]
    assert len(trials.responses) == len(trials.labels) == len(set(trials.keys)) == 12
    assert trials.keys[0] == "m2/1/5"


def test_trials_that_stand_twice_are_refused(tmp_path):
    dataset = make_dataset(tmp_path)
    again = dataset.isel(trial=np.r_[np.arange(dataset.sizes["trial"]), 0])
    with pytest.raises(DataError, match="1 trials of session 1 of m1 stand twice"):
        trials_by_subject(again)
    # Rows of a table may share an id.
    assert len(trials_by_subject(dataset.assign_coords(trial_id=("trial", ["0"] * dataset.sizes["trial"])))) == 2


def test_units_lost_in_some_trials_stay_missing_there(tmp_path):
    observed = [[[0, 100]], [[0, 10.5]], [[0, 100]]]
    responses = trials_by_subject(make_dataset(tmp_path, observed=observed))["m1"][0].responses[:, 0]
    assert np.isnan(responses[:, 1]).sum() == 7
    assert np.isfinite(responses[:, [0, 2]]).all()


@pytest.mark.parametrize("bin", [0.3, 0.4, 0.499])
def test_bins_cut_short_do_not_change_the_average(tmp_path, bin):
    whole, bins = (make_dataset(tmp_path, bin=width) for width in (None, bin))
    assert bins["duration"].values[:, -1].max() < bin - 1e-3
    for one, two in zip(trials_by_subject(whole)["m1"], trials_by_subject(bins, averaged=True)["m1"], strict=True):
        assert one.responses.shape == two.responses.shape
        np.testing.assert_allclose(one.responses, two.responses)


def test_bins_that_were_not_recorded_do_not_count_in_the_average(tmp_path):
    dataset = make_dataset(tmp_path, bin=0.25)
    counts, duration = dataset["counts"].values, dataset["duration"].values
    counts[:, 0, 0], counts[0, :, 1] = np.nan, np.nan
    found = trials_by_subject(dataset, averaged=True)["m1"][0].responses[:, 0]
    np.testing.assert_allclose(found[:, 0], np.nansum(counts[:12, :, 0], 1) / duration[:12, 1:].sum(1))
    assert np.isnan(found[0, 1])
    assert np.isfinite(found[:, 2]).all()


def test_probes_of_one_session_in_files_of_their_own_share_the_halves_of_their_trials(tmp_path):
    random = np.random.default_rng(0)
    start = np.cumsum(random.uniform(2, 3, 96))
    table = {
        "start_time": start,
        "stop_time": start + 1,
        "stimulus": random.permutation(np.resize(list("abcdefgh"), 96)),
    }
    # Trial noise that all units share, and no tuning.
    loud = np.exp(random.normal(size=(96, 2)) @ random.normal(size=(2, 20)))
    spikes = [
        np.sort(np.concatenate([[0.0, 500.0], *(s + random.uniform(size=random.poisson(9 * n)) for s, n in trials)]))
        for trials in (zip(start, unit, strict=True) for unit in loud.T)
    ]
    # The clock of the second file is off by less than a millisecond, and it began later.
    late = {name: values[8:] + 3e-4 if name != "stimulus" else values[8:] for name, values in table.items()}

    def animal(*sessions):
        dataset = open_recordings(write_recordings(tmp_path / "a.h5", sessions), conditions="trials:stimulus")
        blocks = [replace(block, responses=block.responses[:, 0]) for block in trials_by_subject(dataset)["m"]]
        return subject_rdm("m", blocks, 8, method="crossnobis", comparison="whitened-cosine", splits=50)

    one = animal(make_session("m", "a", spikes, {"trials": table}))
    probes = [make_session("m", name, part, {"trials": table}) for name, part in (("a", spikes[:9]), ("b", spikes[9:]))]
    two = animal(*probes)
    np.testing.assert_allclose(two.split_half_r, one.split_half_r)
    # A clock of its own, with another zero and a drift.
    other = {name: values * 1.00005 + 7 if name != "stimulus" else values for name, values in table.items()}
    apart = animal(probes[0], make_session("m", "b", [times * 1.00005 + 7 for times in spikes[9:]], {"trials": other}))
    np.testing.assert_allclose(apart.split_half_r, one.split_half_r, atol=1e-3)
    three = animal(probes[0], make_session("m", "b", spikes[9:], {"trials": late}))
    assert abs(three.reliability - one.reliability) < 0.15


@pytest.mark.parametrize("even", [True, False])
def test_sessions_of_different_days_share_no_trials(even):
    random = np.random.default_rng(0)
    for number in range(50):
        start, earlier = (1.0 + np.cumsum(random.uniform(2, 2 if even else 3, 96)) for _ in range(2))
        labels, others = (random.permutation(np.resize(np.arange(4), 96)) for _ in range(2))
        assert not same_trials(start + number, labels, earlier, others)


def test_other_data_sets_are_refused():
    with pytest.raises(DataError, match="variable 'counts'"):
        trials_by_subject(xr.Dataset())


@pytest.fixture
def dataset(tmp_path):
    """Two animals; both have a session "1", the second also one without the stimulus "c"."""
    sessions = [
        make_simple_session(subject="m1"),
        make_simple_session(subject="m2", seed=1),
        make_simple_session(
            subject="m2", session="2", seed=2, columns={"stimulus": np.resize(np.array(["a", "b"]), 12)}
        ),
    ]
    return open_recordings(write_recordings(tmp_path / "a.h5", sessions), conditions="trials:stimulus")


def test_an_animal_is_the_pool_unless_asked_otherwise(dataset):
    xr.testing.assert_identical(pooled(dataset), dataset)
    assert {name: len(items) for name, items in trials_by_subject(dataset).items()} == {"m1": 1, "m2": 2}


def test_every_session_can_be_its_own_subject(dataset):
    result = pooled(dataset, "session")
    found = trials_by_subject(result)
    assert list(found) == ["m1/1", "m2/1", "m2/2"]
    assert result.attrs["missing"] == {"m2/2": ["c"]}
    assert dataset.attrs["missing"] == {}
    np.testing.assert_array_equal(found["m2/2"][0].responses, trials_by_subject(dataset)["m2"][1].responses)


def test_all_animals_can_be_one_subject_with_their_sessions_apart(dataset):
    ((name, sessions),) = trials_by_subject(pooled(dataset, "all")).items()
    assert name == "all"
    assert [block.responses.shape for block in sessions] == [(12, 1, 3)] * 3
    assert [len(set(block.keys)) for block in sessions] == [12] * 3


def test_pools_of_the_same_recordings_are_told_apart(dataset):
    hashes = {pooled(dataset, by).attrs["content_hash"] for by in ("subject", "session", "all")}
    assert len(hashes) == 3


def test_an_unknown_pool_suggests_the_nearest(dataset):
    with pytest.raises(UsageError, match="'sesion'; did you mean 'session'"):
        pooled(dataset, "sesion")


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


def test_probes_that_list_other_trials_are_joined_and_each_trial_is_found_once(tmp_path):
    _, probes = halves()
    table = probes[0].tables["trials"].data
    table |= {"outcome": np.array(["error", *["correct"] * 10, "error"])}
    for probe, rows in zip(probes, (slice(0, 9), slice(2, 12)), strict=True):
        part = {name: values[rows] for name, values in table.items()}
        spikes = probe.units.rows("spike_times")
        write_recordings(tmp_path / f"{len(spikes)}.h5", make_session("mouse", "1", spikes, {"trials": part}))
    opened = open_recordings(tmp_path, conditions="trials:stimulus", select="outcome=correct")
    balance = opened.attrs["ledger"]["trials"]
    assert (balance["found"], balance["read"]) == (12, 10)
    assert balance["left_out"] == [{"reason": "outcome=correct", "number": 2, "lost": False}]
    assert opened["counts"].isnull().all(axis=1).sum(axis=1).values.tolist() == [4, *[0] * 7, 2, 2]
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


def test_spikes_are_known_again_when_parts_of_them_are_left_out_or_rounded():
    random = np.random.default_rng(0)
    times = np.cumsum(random.exponential(0.1, 2000))
    changes = {
        "later": times + 3600,
        "no first spikes": times[2:],
        "first half": times[:1000],
        "rounded": np.round(times, 4),
        "single precision": times.astype(np.float32).astype(float),
        "some lost": np.delete(times, random.integers(0, 2000, 20)),
    }
    for name, changed in changes.items():
        copies = Copies()
        copies.compare(make_session("m1", "1", [times], {}), [times])
        with pytest.raises(DataError, match="hold the same spikes"):
            copies.compare(make_session("m2", name, [changed], {}), [changed])
    others = [np.cumsum(random.exponential(0.1, 2000)) for _ in range(20)]
    assert not Copies().compare(make_session("m2", "2", others, {}), others)


def test_regular_trains_of_two_animals_are_no_copies():
    copies, times = Copies(), np.arange(500) * 0.1
    assert not copies.compare(make_session("m1", "1", [times], {}), [times])
    assert not copies.compare(make_session("m2", "2", [times], {}), [times])
