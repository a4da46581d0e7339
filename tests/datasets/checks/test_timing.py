import re

import h5py
import numpy as np
import pytest

from brainbench.datasets import write_recordings
from brainbench.datasets.checks.timing import coincidences
from brainbench.datasets.exports import subset
from brainbench.datasets.reading import each_session, open_file
from tests.datasets.checks.healthy_sessions import GEOMETRY, examine, findings_of, make_healthy, with_spikes
from tests.factories.recording_files import write_nwb
from tests.factories.recordings import make_sessions, make_simple_session, quiet_design

# Clock


@pytest.mark.parametrize("shift", [10.0, -10.0, 0.4, -0.4, 37.5])
def test_a_clock_that_is_off_is_caught_with_the_size_of_the_shift(tmp_path, shift):
    session = with_spikes(make_healthy(), lambda spikes: [times + shift for times in spikes])
    items, text = examine(tmp_path, session, "clock", "error")
    assert len(items) == 1
    assert items[0].values["lag"] == pytest.approx(shift, abs=0.03)
    assert f"spikes follow touch (first-contact) by about {shift:+.2f}"[:-2] in text or abs(shift) < 1
    assert "instead of 5 to 30 ms" in text


def test_weakly_tuned_neurons_of_the_demo_keep_a_clock_that_can_be_judged(demo_files):
    """First touches are followed by others, whose answers must not be taken for a shift."""
    items, text = findings_of(demo_files, "clock")
    assert len(items) == 6
    assert not [item for item in items if item.severity == "error"], text
    assert sum(item.severity == "note" for item in items) >= 5


@pytest.mark.parametrize("shift", [10.0, -25.0])
def test_a_shifted_demo_session_is_caught(demo_files, tmp_path, shift):
    path = sorted(demo_files.glob("*.nwb"))[0]
    with open_file(path) as file:
        ((session, _),) = each_session(file, path)
        copied = subset(session)
    session = with_spikes(copied, lambda spikes: [times + shift for times in spikes])
    items, _ = examine(tmp_path, session, "clock", "error")
    assert items[0].values["lag"] == pytest.approx(shift, abs=0.1)


def test_the_starting_time_of_the_voltage_is_recognised_as_the_shift(tmp_path):
    session = with_spikes(make_healthy(), lambda spikes: [times[times > 12.5] - 12.5 for times in spikes])
    from brainbench.datasets import export

    (path,) = export(write_recordings(tmp_path / "a.h5", session), tmp_path / "a.nwb")
    with h5py.File(path, "a") as file:
        series = file.create_group("acquisition/voltage")
        series["data"] = np.zeros(10, dtype=np.int16)
        series.create_dataset("starting_time", data=12.5).attrs["rate"] = 30000.0
    items, _ = findings_of(path, "clock", "error")
    assert "starting_time of acquisition/voltage (12.5 s)" in items[0].advice


def test_a_clock_without_touch_or_without_an_answer_is_not_called_right(tmp_path):
    _, text = examine(tmp_path, make_simple_session(), "clock", "note")
    assert "cannot be checked" in text
    random = np.random.default_rng(0)
    noise = with_spikes(make_healthy(), lambda spikes: [np.sort(random.uniform(0, 150, 500)) for _ in spikes])
    _, text = examine(tmp_path, noise, "clock", "warning")
    assert "the clock cannot be confirmed" in text
    short = make_sessions(GEOMETRY, quiet_design(animals=1, trials=2))[0]
    _, text = examine(tmp_path, short, "clock", "warning")
    assert text.startswith("12 touches near the recording and")
    assert "too few" in text


@pytest.mark.slow
@pytest.mark.parametrize("units", [3, 30])
def test_in_sixty_sessions_no_clock_is_misjudged(units):
    """Over-dispersed, drifting neurons; the shifts include one within the rhythm of touches."""
    from brainbench.datasets.checks.timing import check_clock
    from brainbench.datasets.trials.counting import read_spikes

    random = np.random.default_rng(0)
    design = quiet_design(animals=1, units=units, trials=12, dispersion=0.3, shared_gain=0.3, drift=-0.3)
    confirmed = 0
    for seed in range(30):
        (session,) = make_sessions(GEOMETRY, design, seed=seed)
        spikes = read_spikes(session.units, [])
        for shift in (0.0, 10.0, -3.0, 0.3):
            (finding,) = check_clock(session, [times + shift for times in spikes], None)
            assert finding.severity == ("error" if shift else "note"), finding
            assert finding.values["lag"] == pytest.approx(shift, abs=0.05)
        noise = [np.sort(random.uniform(0, times[-1], len(times))) for times in spikes]
        (finding,) = check_clock(session, noise, None)
        assert finding.severity != "error", finding
        confirmed += finding.severity == "note"
    # Noise passes for a response in few sessions (measured: one of 450), and never for a shift.
    assert confirmed <= 1


# Units


def test_silent_units_are_counted_and_a_session_of_them_is_an_error(tmp_path):
    session = with_spikes(make_healthy(), lambda spikes: [*spikes, np.zeros(0), np.zeros(0)])
    _, text = examine(tmp_path, session, "silent", "note")
    assert text == "2 of 22 (9 %) units have no spike (unit 20, unit 21)"
    _, text = examine(tmp_path, with_spikes(session, lambda spikes: [np.zeros(0)] * 3), "silent", "error")
    assert text.startswith("3 of 3 (100 %)")


def test_the_same_unit_twice_is_found_also_when_sorted_a_little_apart(tmp_path):
    random = np.random.default_rng(0)

    def twins(spikes):
        half = np.sort(np.concatenate([spikes[3][::3], spikes[3][1::3], spikes[4][::8]]))
        return [*spikes, spikes[2] + random.uniform(-1, 1, len(spikes[2])) * 1e-4, half]

    items, text = examine(tmp_path, with_spikes(make_healthy(rate=15.0), twins), "duplicates")
    assert [item.severity for item in items] == ["error", "warning"]
    assert "(unit 2 = unit 20: 100 %)" in text
    assert "unit 3 = unit 21" in text


def test_busy_units_that_coincide_by_chance_are_no_twins():
    random = np.random.default_rng(1)
    busy = [np.sort(random.uniform(0, 100, 20_000)) for _ in range(5)]
    assert coincidences(busy) == []
    assert coincidences([*busy, busy[0]])[0][:2] == (0, 5)


def test_refractory_violations_are_graded(tmp_path):
    def merged(spikes):
        doubled = np.sort(np.concatenate([spikes[0], spikes[0] + 0.001]))
        some = np.sort(np.concatenate([spikes[1], spikes[1][::25] + 0.001]))
        return [doubled, some, *spikes[2:]]

    items, text = examine(tmp_path, with_spikes(make_healthy(), merged), "refractory")
    assert [item.severity for item in items] == ["error", "warning"]
    assert re.search(r"1 of 20 \(5 %\) .*1\.5 ms \(unit 0: 50", text)
    assert list(items[1].values["share"]) == ["unit 1"]


@pytest.mark.parametrize(
    ("change", "severity", "message"),
    [
        (lambda times: times - 5.0, "warning", "spikes before the session began"),
        (lambda times: np.unique(np.round(times * 30000)), "error", "all spike times are whole numbers"),
        (lambda times: times * 30000.1, "error", "spikes span"),
    ],
)
def test_impossible_spike_times_are_named(tmp_path, change, severity, message):
    session = with_spikes(make_healthy(), lambda spikes: [change(times) for times in spikes])
    _, text = examine(tmp_path, session, "times", severity)
    assert message in text


def test_damaged_spikes_are_an_error_and_not_an_exception(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_healthy())
    with h5py.File(path, "a") as file:
        file["sessions/synthetic01-01/units/spike_times"][7] = np.nan
    _, text = findings_of(path, "spikes", "error")
    assert "1 spike times" in text
    _, text = findings_of(write_nwb(tmp_path / "b.nwb", units=False), "units", "error")
    assert "no units table" in text


@pytest.fixture(scope="session")
def demo_files(tmp_path_factory):
    from brainbench.datasets.synthetic import make_rodgers_demo
    from tests.factories.recordings import make_stimuli

    folder = tmp_path_factory.mktemp("demo-check")
    make_rodgers_demo(folder, make_stimuli())
    return folder
