import numpy as np
import pytest

from brainbench import score
from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry
from brainbench.metrics import get_metric
from brainbench.metrics.reliability.halves import reliable_units, tuning_by_chance
from brainbench.models.features import write_features
from brainbench.scoring.neural_responses import BY_CHANCE, open_neural_responses
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.scores import score_record
from tests.factories.recordings import as_recordings

# Recordings that are too little, or not what they should be: a status with its reason, or one sentence.


@pytest.fixture
def features(tmp_path):
    def write(count=12):
        random = np.random.default_rng(1)
        layers = {"one": random.normal(size=(count, 20)), "two": random.normal(size=(count, 9))}
        return write_features(tmp_path / "features.h5", [f"s{index + 1}" for index in range(count)], layers)

    return write


def make_recordings(stimuli=12, **changes):
    geometry = ResponseGeometry.from_activations(np.random.default_rng(0).normal(size=(stimuli, 20)))
    design = {"animals": 3, "units": 20, "trials": (6, 8), "modulation": 0.4, "emphasis": 0.0}
    return as_recordings(geometry, PopulationDesign(**{**design, **changes}))


def with_counts(change, where=None):
    """Recordings whose counts are ``change``, everywhere or in the trials of one stimulus."""
    dataset = make_recordings().copy(deep=True)
    counts = dataset["counts"].values
    chosen = np.ones(len(counts), bool) if where is None else dataset["stimulus"].values == where
    counts[chosen] = np.where(np.isnan(counts[chosen]), np.nan, change)
    return dataset


def test_one_animal_has_a_score_without_an_interval_over_animals(features):
    found = score(features(), recordings=make_recordings(animals=1))
    assert found.interval is None
    assert [item.subject for item in found.subjects] == ["synthetic01"]


@pytest.mark.parametrize(
    ("name", "value"), [("counts", -1.0), ("counts", np.inf), ("duration", np.nan), ("duration", -0.5)]
)
def test_numbers_that_no_recording_has_are_refused_in_memory_too(features, tmp_path, name, value):
    dataset = make_recordings().copy(deep=True)
    dataset[name].values[0, 0] = value
    for use in (
        lambda: score(features(), recordings=dataset),
        lambda: write_recordings(tmp_path / "x.h5", dataset),
    ):
        with pytest.raises(DataError, match=name):
            use()
    dataset = make_recordings()
    dataset[name] = dataset[name].astype(str)
    with pytest.raises(DataError, match="no numbers"):
        score(features(), recordings=dataset)


def test_two_stimuli_have_no_score(features):
    found = score(features(2), recordings=make_recordings(2))
    assert found.status == "undefined"
    assert any("2 stimuli" in reason for reason in found.reasons)


def test_an_animal_without_a_stimulus_is_named_and_the_others_are_scored(features):
    found = score(features(), recordings=make_recordings(missing=((1, 3),)))
    assert found.status != "undefined"
    animal = {item.subject: item for item in found.subjects}["synthetic02"]
    assert animal.status == "undefined" or np.isfinite(animal.value)
    assert any("synthetic02" in reason for reason in found.reasons) == (animal.status == "undefined")


def test_an_animal_without_units_is_named(features, tmp_path):
    dataset = make_recordings(animals=4)
    dataset = dataset.isel(unit=dataset["unit_subject"].values != "synthetic02")
    found = score(features(), recordings=dataset)
    assert len(found.subjects) == 3
    assert any("synthetic02" in reason for reason in found.reasons), found.reasons


@pytest.mark.parametrize(
    "make",
    [
        lambda: with_counts(0.0, where="s4"),
        lambda: with_counts(3.0),
        lambda: make_recordings(units=1),
        lambda: make_recordings(trials=1),
    ],
    ids=["silent stimulus", "all trials equal", "one unit", "one trial of each"],
)
@pytest.mark.filterwarnings("error")
def test_recordings_that_hold_too_little_get_a_status_with_its_reason(features, make):
    found = score(features(), recordings=make())
    assert found.status in ("ok", "unreliable", "undefined")
    assert np.isfinite(found.value) == (found.status != "undefined")
    assert found.reasons or found.status == "ok"


@pytest.mark.parametrize("time", ["mean", "concatenate"])
def test_a_session_of_dropped_labels_alone_is_left_out(features, tmp_path, time):
    for session, labels in (("1", [f"s{1 + index % 13}" for index in range(120)]), ("2", ["s13"] * 120)):
        spikes = [
            np.sort(np.random.default_rng(unit + 100 * (session == "2")).uniform(0, 122, 900)) for unit in range(20)
        ]
        table = {"start_time": 1.0 + np.arange(120), "stop_time": 1.5 + np.arange(120), "stimulus": labels}
        write_recordings(tmp_path / "two" / f"{session}.h5", make_session("m1", session, spikes, {"trials": table}))
    how = {"conditions": "trials:stimulus", "match": {"s13": None}, "bin": 0.25, "time": time}
    found = score(features(), recordings=tmp_path / "two", **how)
    assert any("1 of 2 sessions left out" in reason for reason in found.reasons), found.reasons


def _session(folder, **columns):
    begin = np.arange(0.0, 60.0)
    spikes = [np.sort(np.random.default_rng(unit).uniform(0, 60, 200)) for unit in range(4)]
    tables = {"trials": {"start_time": begin, "stop_time": begin + 0.5, **columns}}
    return write_recordings(folder / "a.h5", make_session("m1", "1", spikes, tables))


def test_noise_of_trials_that_share_spikes_is_not_reliable(features, tmp_path):
    """Neurons without tuning, stimuli in blocks: windows of 3 s each second make the halves of a block alike."""
    begin, names = 2.0 + np.arange(120), np.repeat([f"s{index + 1}" for index in range(12)], 10)
    for animal in range(4):
        random = np.random.default_rng(animal)
        spikes = [np.sort(np.append(random.uniform(0, 130, 300), [0.0, 130.0])) for _ in range(30)]
        table = {"start_time": begin, "stop_time": begin + 0.9, "stimulus": names}
        write_recordings(
            tmp_path / "noise" / f"{animal}.h5", make_session(f"m{animal}", "1", spikes, {"trials": table})
        )
    apart, shared = (
        score_record(features(), recordings=tmp_path / "noise", conditions="trials:stimulus", window=window)
        for window in ("start..stop", "start-1..+3")
    )
    assert apart.score.reliability < 0.5 < shared.score.reliability
    for found in (shared.score, shared.animal_to_animal):
        assert found.status == "unreliable"
        assert "share spikes" in found.reasons[0]


def test_recordings_without_labels_say_what_is_there(features, tmp_path):
    with pytest.raises(DataError, match="'trials'"):
        score(features(), recordings=_session(tmp_path))
    with pytest.raises(UsageError, match="'trials:thing'"):
        score(features(), recordings=_session(tmp_path, thing=np.tile(["a", "b", "c"], 20)))
    with pytest.raises(DataError, match="stimulus"):
        score(features(), recordings=_session(tmp_path, stimulus=np.array([""] * 60)), conditions="trials:stimulus")


def test_units_that_were_chosen_by_chance_put_every_score_in_doubt(features):
    silent, tuned = (make_recordings(6, animals=5, units=60, modulation=size) for size in (1e-6, 0.4))
    doubt = "those that shuffled labels leave have"
    record = score_record(features(6), recordings=silent, units_reliability=0.5)
    for result in (record.score, record.animal_to_animal, *record.baselines.values()):
        assert result.status == "unreliable"
        assert doubt in " ".join(result.reasons)
    sound = score(features(6), recordings=tuned, units_reliability=0.5)
    assert sound.status == "ok"
    assert doubt not in " ".join(sound.reasons)


def _gated_study(seed, stimuli=6, trials=10, animals=6, units=60, dimensions=4):
    """Return the share of tuning by chance, whether a score is ok, its error, and whether its interval holds it."""
    rng, metric, labels = np.random.default_rng([seed, 3]), get_metric("rsa"), np.repeat(np.arange(stimuli), trials)
    tuned, size = rng.choice([0.03, 0.06, 0.1, 0.15, 0.25, 0.5]), rng.choice([0.3, 0.45, 0.6, 0.9]) * np.sqrt(0.8)
    shared, other = rng.normal(size=(2, stimuli, dimensions))
    blocks, chosen, true = [], [], []
    for index in range(animals):
        means = np.sqrt(0.8) * shared + np.sqrt(0.2) * rng.normal(size=shared.shape)
        means = size * means @ rng.normal(size=(dimensions, units)) / np.sqrt(dimensions)
        means *= rng.random(units) < tuned
        blocks.append(Trials(means[labels] + rng.normal(size=(len(labels), units)), labels))
        reliable, _ = reliable_units(blocks[-1:], stimuli, least=0.5)
        if reliable and means.any():
            chosen.append(metric.animal(str(index), reliable, stimuli, splits=20))
            exact = means[labels] + 1e-3 * size * rng.normal(size=(len(labels), units))
            true.append(metric.animal(str(index), [Trials(exact, labels)], stimuli, splits=20))
    layer = (shared + other) @ rng.normal(size=(dimensions, 100))
    names = [str(number) for number in range(stimuli)]
    score, truth = (metric.score({"layer": layer}, side, name="x", stimuli=names) for side in (chosen, true))
    interval = score.scaled_interval
    inside = interval is None or interval.low <= truth.scaled <= interval.high
    share = tuning_by_chance(blocks, stimuli, least=0.5)
    return share, score.status == "ok", score.scaled - truth.scaled, inside


@pytest.mark.slow
def test_scores_of_units_that_pass_by_chance_are_doubted_from_where_they_err_by_a_tenth():
    # Of 370 studies: root mean square errors of .04 below .3, .10 from .3 to .5, .16 above.
    share, ok, error, inside = np.array([_gated_study(seed) for seed in range(120)]).T
    below, above = (ok > 0) & (share <= BY_CHANCE), (ok > 0) & (share > BY_CHANCE)
    sizes = [float(np.sqrt(np.mean(error[rows] ** 2))) for rows in (below, above)]
    assert (below.sum(), above.sum()) > (30, 15)
    assert inside[below].mean() > 0.95
    assert abs(error[below].mean()) < 0.03
    assert sizes[0] < 0.1 < sizes[1]


def test_bins_that_are_features_are_no_neurons():
    whole = open_neural_responses("demo-rodgers", progress=None, bin=0.2)
    for least in (None, 0.3):
        mean, each = (
            whole.animals(whole.vocabulary, get_metric("rsa"), ScoreOptions(time=time, units_reliability=least))
            for time in ("mean", "concatenate")
        )
        if least is None:
            assert [animal.units for animal in each] == [animal.units for animal in mean]
        else:
            counts = [whole.dataset["unit_subject"].values.tolist().count(animal.subject) for animal in each]
            for animal, count in zip(each, counts, strict=True):
                assert any(f"of {count} units left out" in note for note in animal.notes)
            # The last bin of a window is shorter, and its rates are noisier: units are chosen by the whole window.
            assert [animal.notes[0] for animal in each] == [animal.notes[0] for animal in mean]


def test_a_bin_that_every_window_cuts_short_counts_by_its_length():
    found = []
    for width in (0.25, 0.249):
        whole = open_neural_responses("demo-rodgers", progress=None, window="start+1..+0.5", bin=width)
        options = ScoreOptions(time="concatenate")
        found.append(whole.animals(whole.vocabulary, get_metric("rsa"), options))
    even, cut = ([animal.reliability for animal in animals] for animals in found)
    np.testing.assert_allclose(cut, even, atol=0.03)


@pytest.mark.parametrize(
    ("layout", "synthetic", "begins"),
    [("rodgers (detected from its columns)", False, "Rodgers C. C."), ("rodgers", True, ""), ("mine", False, "")],
)
def test_recordings_of_a_layout_state_the_work_to_cite(layout, synthetic, begins):
    dataset = make_recordings().assign_attrs(layout=layout, synthetic=synthetic)
    citation = open_neural_responses(dataset, progress=None).origin.get("citation", "")
    assert citation.startswith(begins)
    assert bool(citation) == bool(begins)
