"""Scores over time: what is known to be there is found, when and at which lag, and nothing else."""

from __future__ import annotations

import math
import shutil

import h5py
import numpy as np
import pytest

import brainbench
from brainbench.cli import main
from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.metrics import compare, rdm
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.models.features import write_features
from brainbench.scoring.over_time import AnimalMovie, animal_movie, in_bins, layer_movie, score_over_time
from brainbench.scoring.over_time.course import LaggedRDMs, best_lag, held_out_course, votes
from brainbench.scoring.scores import score_record
from leaderboards.site.build import write_report

BIN = 0.05
DIMENSIONS = 4


def make_path(rng, stimuli, bins, *, memory=0.7):
    """Latent patterns [T, K, D] that change from bin to bin, correlated by ``memory`` with the bin before."""
    path = rng.normal(size=(bins + 20, stimuli, DIMENSIONS))
    for step in range(1, len(path)):
        path[step] = memory * path[step - 1] + np.sqrt(1 - memory**2) * path[step]
    return path[20:]


def lagged(path, lag, onset=0):
    """Return a path that follows ``lag`` bins behind; zero before ``onset`` and before the path begins."""
    moved = np.zeros_like(path)
    moved[lag:] = path[: len(path) - lag]
    moved[:onset] = 0
    return moved


def make_movie(rng, path, name="animal", *, units=30, noise=0.5, reliability=0.9):
    """An animal that follows a path, as RDMs with noise in every bin; where the path is zero there is only noise."""
    means = path @ rng.normal(size=(DIMENSIONS, units)) + noise * rng.normal(size=(*path.shape[:2], units))
    known = np.where(path.any(axis=(1, 2)), reliability, 0.1)
    return AnimalMovie(name, np.stack([rdm(mean, method="sqeuclidean") for mean in means]), known)


def make_layer(rng, path, features=40):
    """RDMs [T, P] of a layer that follows a path."""
    values = path @ rng.normal(size=(DIMENSIONS, features))
    return np.stack([rdm(value, method="sqeuclidean") for value in values])


def make_moving_session(rng, path, *, units=25, repeats=8, noise=2.0):
    """One session of trials [R, T, U] that follow a path."""
    labels = np.repeat(np.arange(path.shape[1]), repeats)
    means = (path @ rng.normal(size=(DIMENSIONS, units))).swapaxes(0, 1)
    responses = means[labels] + noise * rng.normal(size=(len(labels), len(path), units))
    return Trials(responses, labels, [str(row) for row in range(len(labels))])


def _study(rng, *, stimuli=12, animals=5, bins=12, lag=2, onset=4, related=True, layers=3):
    """The middle layer is what the animals follow, unless nothing is related."""
    paths = [make_path(rng, stimuli, bins) for _ in range(layers)]
    source = paths[layers // 2] if related else make_path(rng, stimuli, bins)
    path = lagged(source, lag, onset)
    movies = [make_movie(rng, path, str(index)) for index in range(animals)]
    return {f"layer{index}": make_layer(rng, one) for index, one in enumerate(paths)}, movies


def test_a_geometry_is_found_when_it_appears_and_at_its_lag():
    layers, animals = _study(np.random.default_rng(0))
    course = score_over_time(layers, animals, width=BIN, permutations=199)
    assert course.layer == "layer1"
    assert course.p == 1 / 200
    p = np.array([point.p for point in course.points])
    assert (p[4:] <= 0.05).all()
    assert not (p[:4] <= 0.05).any()
    found = {item.layer: item for item in course.latencies}
    assert found["layer1"].latency == pytest.approx(2 * BIN, abs=0.2 * BIN)
    assert found["layer1"].interval.high - found["layer1"].interval.low < BIN
    assert math.isnan(found["layer0"].latency)
    assert "permuted" in found["layer0"].reason


def test_the_score_is_corrected_for_noise_and_undefined_where_nobody_is_reliable():
    layers, animals = _study(np.random.default_rng(1))
    course = score_over_time(layers, animals, width=BIN, permutations=50)
    early, late = course.points[2], course.points[8]
    assert early.animals == 0
    assert math.isnan(early.value)
    assert math.isfinite(early.r)
    assert late.animals == 5
    assert late.value == pytest.approx(late.r / math.sqrt(0.9))
    assert late.interval.low < late.value < late.interval.high
    assert any("4 of 12 bins" in reason for reason in course.reasons)
    assert [point.time for point in course.points[:2]] == pytest.approx([BIN / 2, 3 * BIN / 2])


def test_unrelated_models_are_found_at_some_time_in_one_study_of_twenty():
    found, layers_found = [], []
    for seed in range(150):
        layers, animals = _study(np.random.default_rng([7, seed]), stimuli=7, animals=4, bins=6, related=False)
        course = score_over_time(layers, animals, width=BIN, permutations=59, seed=seed)
        found.append(min(point.p for point in course.points if math.isfinite(point.p)) <= 0.05)
        layers_found.append(min(item.p for item in course.latencies) <= 0.05)
    # 99.9 % limits of 150 draws at 5 %.
    assert 1 <= sum(found) <= 18
    assert 1 <= sum(layers_found) <= 18


def test_intervals_of_the_latency_hold_it():
    hits, widths = [], []
    for seed in range(40):
        layers, animals = _study(np.random.default_rng([8, seed]), stimuli=10, animals=5, bins=10, layers=1, onset=0)
        (item,) = score_over_time(layers, animals, width=BIN, permutations=39).latencies
        if item.interval is not None:
            hits.append(item.interval.low <= 2 * BIN <= item.interval.high)
            widths.append(item.interval.high - item.interval.low)
    assert len(hits) >= 36
    assert np.mean(hits) >= 0.85
    assert np.median(widths) < BIN


def test_neurons_may_lead_the_model():
    rng = np.random.default_rng(3)
    path = make_path(rng, 12, 12)
    animals = [make_movie(rng, path, str(index)) for index in range(5)]
    course = score_over_time({"late": make_layer(rng, lagged(path, 1))}, animals, width=BIN, permutations=59)
    assert course.latencies[0].latency == pytest.approx(-BIN, abs=0.2 * BIN)


def test_a_layer_without_time_has_a_score_but_no_latency():
    rng = np.random.default_rng(4)
    path = np.repeat(make_path(rng, 12, 1), 8, axis=0)
    animals = [make_movie(rng, path, str(index)) for index in range(4)]
    course = score_over_time({"static": make_layer(rng, path)[:1]}, animals, width=BIN, permutations=59)
    assert course.p <= 0.05
    assert math.isnan(course.latencies[0].latency)
    assert course.latencies[0].reason == "the layer has no time"


def test_few_animals_or_stimuli_are_said():
    layers, animals = _study(np.random.default_rng(5), stimuli=6, animals=1)
    course = score_over_time(layers, animals, width=BIN, permutations=19)
    assert any("there are 1 and 6" in reason for reason in course.reasons)
    assert all(point.interval is None for point in course.points)
    assert all(item.interval is None for item in course.latencies)


def test_animals_that_are_reliable_at_no_time_give_no_latency():
    rng = np.random.default_rng(10)
    path = make_path(rng, 10, 8)
    animals = [make_movie(rng, path, str(index), reliability=0.3) for index in range(4)]
    course = score_over_time({"layer": make_layer(rng, path)}, animals, width=BIN, permutations=39)
    assert math.isnan(course.latencies[0].latency)
    assert "reliable" in course.latencies[0].reason
    assert course.p <= 0.05


def test_the_order_of_stimuli_does_not_matter():
    layers, animals = _study(np.random.default_rng(6), stimuli=9)
    from dataclasses import replace

    from brainbench.metrics.rdms.comparison import permuted_pairs

    pairs = permuted_pairs(np.random.default_rng(0).permutation(9)[None])[0]
    moved = [replace(item, rdms=item.rdms[:, pairs]) for item in animals]
    one = score_over_time(layers, animals, width=BIN, permutations=99)
    two = score_over_time({name: movie[:, pairs] for name, movie in layers.items()}, moved, width=BIN, permutations=99)
    np.testing.assert_allclose([point.p for point in one.points], [point.p for point in two.points])
    np.testing.assert_allclose(
        [item.latency for item in one.latencies], [item.latency for item in two.latencies], atol=1e-9
    )


def test_trials_are_enough():
    rng = np.random.default_rng(9)
    path = make_path(rng, 10, 10)
    sessions = [make_moving_session(rng, lagged(path, 1), noise=1.0) for _ in range(4)]
    animals = [animal_movie(str(i), [one], 10, splits=20) for i, one in enumerate(sessions)]
    course = score_over_time({"layer": make_layer(rng, path)}, animals, width=BIN, permutations=99)
    assert course.latencies[0].latency == pytest.approx(BIN, abs=0.3 * BIN)
    assert course.p <= 0.05


def test_misuse_is_told_in_a_sentence():
    layers, animals = _study(np.random.default_rng(0), bins=6, stimuli=6)
    with pytest.raises(UsageError, match="one layer and one animal"):
        score_over_time({}, animals, width=BIN)
    with pytest.raises(UsageError, match="whitened-cosine"):
        score_over_time(layers, animals, width=BIN, comparison="whitened-cosin")
    with pytest.raises(UsageError, match="'layer0'"):
        score_over_time({"layer0": np.ones((6, 10))}, animals, width=BIN)
    with pytest.raises(UsageError, match="received 0"):
        score_over_time(layers, animals, width=0.0)
    short, few = _study(np.random.default_rng(0), bins=2, lag=0, onset=0)
    with pytest.raises(UsageError, match="3 bins"):
        score_over_time(short, few, width=BIN)


LABELS = tuple("abcdefghij")
BINS, LAG = 10, 1


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Four animals that follow one layer by one bin, in files of spike times; and the layers in a file."""
    folder = tmp_path_factory.mktemp("moving")
    rng = np.random.default_rng(0)
    path = make_path(rng, len(LABELS), BINS)
    for animal in range(4):
        own = np.random.default_rng([1, animal])
        rates = 20 * np.exp(0.5 * lagged(path, LAG) @ own.normal(size=(DIMENSIONS, 40))).swapaxes(0, 1)
        order = own.permutation(np.repeat(np.arange(len(LABELS)), 12))
        starts = 1.0 + np.arange(len(order))
        counts = own.poisson(rates[order] * BIN)
        spikes = []
        for unit in range(counts.shape[2]):
            trial, bin = np.nonzero(counts[:, :, unit])
            times = np.repeat(starts[trial] + bin * BIN, counts[trial, bin, unit])
            spikes.append(np.sort(times + BIN * own.random(len(times))))
        table = {"start_time": starts, "stop_time": starts + BINS * BIN, "stimulus": [LABELS[k] for k in order]}
        span = np.array([[0.0, starts[-1] + 2]])
        session = make_session(f"m{animal}", "s", spikes, {"trials": table}, observed=[span] * len(spikes))
        write_recordings(folder / f"m{animal}.h5", session)
    layers = {
        "unrelated": make_path(rng, len(LABELS), BINS).swapaxes(0, 1),
        "followed": (path @ rng.normal(size=(DIMENSIONS, 50))).swapaxes(0, 1),
    }
    write_features(folder / "layers.hdf5", LABELS, layers)
    return folder


def _score(folder, **changes):
    files, layers = str(folder / "m*.h5"), folder / "layers.hdf5"
    return score_record(str(layers), recordings=files, conditions="trials:stimulus", over_time=True, **changes)


def _latency(folder, **changes):
    course = _score(folder, baselines=False, **changes).score.provenance.statistics["time_course"]
    return next(item["latency"] for item in course["latencies"] if item["layer"] == "followed")


def test_a_score_over_time_is_in_the_record_and_in_its_report(moving, tmp_path):
    record = _score(moving, baselines=False)
    course = record.score.provenance.statistics["time_course"]
    assert course["layer"] == "followed"
    assert len(course["points"]) == BINS
    assert course["bin"] == pytest.approx(BIN)
    found = {item["layer"]: item for item in course["latencies"]}
    assert found["followed"]["latency"] == pytest.approx(LAG * BIN, abs=0.35 * BIN)
    assert found["unrelated"]["latency"] is None
    page = write_report(record, tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'id="time"' in page
    assert "followed: " in page
    again = brainbench.ResultRecord.from_json(record.to_json())
    assert again.score.provenance.statistics["time_course"] == course


def test_one_longer_trial_does_not_stretch_features_without_a_duration(moving, tmp_path):
    shutil.copytree(moving, tmp_path, dirs_exist_ok=True)
    with h5py.File(tmp_path / "m0.h5", "r+") as file:
        file["sessions/m0-s/tables/trials/stop_time"][5] += 0.8 * BINS * BIN
    assert _latency(tmp_path) == pytest.approx(_latency(moving), abs=0.01 * BIN)


@pytest.mark.parametrize("bins", [0.7, 1.5])
def test_a_last_bin_that_the_window_cuts_does_not_stretch_them_either(moving, bins):
    assert _latency(moving, bin=bins * BIN) == pytest.approx(LAG * BIN, abs=0.2 * BIN)


def test_the_command_prints_latencies(moving, tmp_path, monkeypatch, capsys):
    arguments = ["score", str(moving / "layers.hdf5"), "-r", str(moving / "m*.h5"), "--conditions", "trials:stimulus"]
    monkeypatch.setattr("sys.argv", ["brainbench", *arguments, "--over-time", "--bin", "0.1", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code in (0, None)
    text = capsys.readouterr().out
    assert "5 bins of 0.1 s" in text
    assert "followed" in text


def test_without_the_option_a_score_has_no_time(moving):
    record = score_record(
        str(moving / "layers.hdf5"), recordings=str(moving / "m*.h5"), conditions="trials:stimulus", baselines=False
    )
    assert "time_course" not in record.score.provenance.statistics


@pytest.mark.parametrize("part", [slice(3, None), slice(None, None, 2)], ids=["late", "every second"])
def test_bins_that_do_not_follow_from_the_begin_of_the_window_are_refused(moving, part):
    whole = open_recordings(str(moving / "m*.h5"), conditions="trials:stimulus", bin=BIN)
    with pytest.raises(UsageError, match="begin of the window"):
        score_record(str(moving / "layers.hdf5"), recordings=whole.isel(time=part), over_time=True, baselines=False)


def test_metrics_without_rdms_and_recordings_without_time_are_refused(moving):
    with pytest.raises(UsageError, match="'ridge'"):
        _score(moving, metric="ridge")
    with pytest.raises(DataError, match="--bin"):
        _score(moving, bin=0.5)
    with pytest.raises(UsageError, match="bin of 1 s is longer"):
        _score(moving, bin=1.0)


def test_unreliable_units_are_left_out_at_each_time_too(moving):
    courses = [
        _score(moving, baselines=False, units_reliability=least).score.provenance.statistics["time_course"]
        for least in (-0.99, 0.8, 0.9999)
    ]
    every, some, none = ([point["reliability"] for point in course["points"]] for course in courses)
    assert all(np.isfinite([*every, *some]))
    assert every != some
    assert set(none) == {None}
    assert any("reliability of their tuning below" in reason for reason in courses[2]["reasons"])


def test_an_activation_counts_in_a_bin_for_as_long_as_it_lasts_there():
    values = np.array([0.0, 3.0, 6.0])[None, :, None]
    np.testing.assert_allclose(in_bins(values, 0.1, 0.15).ravel(), [1.0, 5.0])
    np.testing.assert_allclose(in_bins(values, 0.1, 0.05).ravel(), [0, 0, 3, 3, 6, 6])
    # The last third of a bin is left out, two thirds of one are not.
    assert in_bins(values, 0.1, 0.225).shape == (1, 1, 1)
    assert in_bins(values, 0.1, 0.18).shape == (1, 2, 1)


def test_a_layer_without_time_has_one_rdm():
    patterns = np.random.default_rng(0).normal(size=(6, 1, 9))
    movie = layer_movie(patterns, 1.0, 0.05)
    np.testing.assert_allclose(movie, rdm(patterns[:, 0], method="sqeuclidean")[None])


def test_each_bin_of_an_animal_is_prepared_as_a_score_without_time():
    rng = np.random.default_rng(1)
    session = make_moving_session(rng, make_path(rng, 6, 4))
    how = {"method": "sqeuclidean", "comparison": "pearson", "splits": 30, "seed": 5}
    movie = animal_movie("a", [session], 6, **how)
    for bin in range(4):
        alone = subject_rdm("a", [Trials(session.responses[:, bin], session.labels, session.keys)], 6, **how)
        np.testing.assert_allclose(movie.rdms[bin], alone.rdm)
        assert movie.reliability[bin] == alone.reliability


def test_an_animal_is_reliable_only_where_it_responds():
    rng = np.random.default_rng(2)
    session = make_moving_session(rng, lagged(make_path(rng, 8, 6), 0, onset=3), noise=1.0)
    movie = animal_movie("a", [session], 8, splits=30)
    assert (movie.reliability[3:] > 0.6).all()
    assert (movie.reliability[:3] < 0.5).all()


def test_a_bin_without_an_rdm_says_why():
    rng = np.random.default_rng(3)
    session = make_moving_session(rng, make_path(rng, 6, 3))
    responses = session.responses.copy()
    responses[session.labels == 2, 1] = np.nan
    movie = animal_movie("a", [Trials(responses, session.labels, session.keys)], 6, splits=5)
    assert np.isnan(movie.rdms[1]).all()
    assert np.isnan(movie.reliability[1])
    assert [problem is None for problem in movie.problems] == [True, False, True]


def test_an_animal_without_times_is_refused():
    with pytest.raises(UsageError, match="'a'"):
        animal_movie("a", [Trials(np.ones((6, 3)), np.arange(6))], 6)
    with pytest.raises(UsageError, match=r"\(6, 4\)"):
        in_bins(np.ones((6, 4)), 0.1, 0.1)
    with pytest.raises(UsageError, match="bins of 0"):
        in_bins(np.ones((6, 4, 2)), 0.1, 0.0)


def _joined(rng, *, animals=3, lag=1, bins=6, comparison="whitened-cosine"):
    path = make_path(rng, 6, bins)
    movies = [make_layer(rng, make_path(rng, 6, bins)), make_layer(rng, path), make_layer(rng, path)[:1]]
    brain = [make_movie(rng, lagged(path, lag), str(index)).rdms for index in range(animals)]
    return movies, brain, LaggedRDMs.join(movies, brain, largest=2, comparison=comparison)


def test_a_lag_compares_the_animals_bin_with_an_earlier_bin_of_the_model():
    movies, brain, joined = _joined(np.random.default_rng(0))
    (r,) = joined.compared()
    assert r.shape == (3, 5, 6, 3)
    for lag, place in ((-1, 1), (0, 2), (2, 4)):
        expected = compare(movies[1][3 - lag], brain[2][3], method="whitened-cosine")
        np.testing.assert_allclose(r[1, place, 3, 2], expected)
    # The model has no time before its first bin, nor after its last.
    assert np.isnan(r[1, 4, :2]).all()
    assert np.isnan(r[1, 1, 5:]).all()
    # A layer without time is compared at lag zero, with every bin.
    assert np.isfinite(r[2, 2]).all()
    assert np.isnan(np.delete(r[2], 2, axis=0)).all()


def test_the_first_order_is_the_given_one_and_left_out_stimuli_leave_their_pairs():
    _, _, joined = _joined(np.random.default_rng(1), comparison="pearson")
    first = next(joined.permuted(20, 0))[0]
    np.testing.assert_allclose(first, joined.compared()[0], equal_nan=True)
    rows, cols = np.triu_indices(6, 1)
    kept = (rows != 4) & (cols != 4)
    expected = compare(joined.layers[3, kept], joined.animals[0, kept])
    np.testing.assert_allclose(
        np.ravel(joined.without_stimulus(4)[0, 0, 2, 3, 0]),
        compare(joined.layers[3, kept], joined.animals.reshape(6, 3, -1)[3, 0, kept]),
    )
    assert np.isfinite(expected)


def test_bins_without_an_rdm_are_left_out():
    movies, brain, _ = _joined(np.random.default_rng(2))
    brain[1] = brain[1].copy()
    brain[1][3] = np.nan
    (r,) = LaggedRDMs.join(movies, brain, largest=2, comparison="whitened-cosine").compared()
    assert np.isnan(r[:, :, 3, 1]).all()
    assert np.isfinite(r[1, 2, 3, 0])
    assert np.isfinite(votes(r[None])[0, 1, 2, 1])


def test_layer_and_lag_of_an_animal_are_chosen_on_the_others():
    rng = np.random.default_rng(3)
    r = rng.uniform(-0.1, 0.1, size=(1, 2, 3, 4, 3))
    r[0, 1, 2, :, :2] = 0.9
    r[0, 0, 0, :, 2] = 0.99
    course, chosen = held_out_course(r)
    # The third animal's own favourite is not what it is scored with.
    assert chosen[0, 2] == 5
    np.testing.assert_allclose(course[0, :, 2], r[0, 1, 2, :, 2])


def test_bins_that_never_match_do_not_move_the_peak():
    # True lag 1; the first three bins match nothing, and larger lags lose them.
    bins, lags = 12, np.arange(-3, 4)
    at = np.arange(bins) - lags[:, None]
    height = np.exp(-0.5 * (lags - 1.0) ** 2)[:, None] * (np.arange(bins) >= 3)
    excess = np.where((at >= 0) & (at < bins), height, np.nan)[None, :, :, None]
    np.testing.assert_allclose(best_lag(excess) - 3, [1.0])
    before, here, after = votes(excess[None])[0, 0, 3:6, 0]
    assert 0.5 * (before - after) / (before - 2 * here + after) > 0.06


def test_a_peak_at_an_end_or_without_a_neighbour_has_no_place():
    heights = np.array([[3.0, 2.0, 1.0, 0.0], [np.nan, 2.0, 1.0, 0.0], [0.0, 1.0, 1.0, 0.0], [np.nan] * 4])
    found = best_lag(np.repeat(heights[:, :, None, None], 5, axis=2))
    np.testing.assert_allclose(found, [np.nan, np.nan, 1.5, np.nan])
