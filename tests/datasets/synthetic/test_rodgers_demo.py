import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import file_hash
from brainbench.datasets import inspect, open_recordings
from brainbench.datasets.synthetic import ensure_rodgers_demo, make_rodgers_demo, read_truth
from brainbench.datasets.trials.session_trials import trials_by_subject
from tests.factories.recordings import LABELS


def make_stimuli():
    """Whisking-like bursts of contact: six stimuli × 110 frames of 9 ms on the mouse's 30 whiskers."""
    random = np.random.default_rng(0)
    cells = [(row, col) for row, number in enumerate((5, 5, 7, 7, 6)) for col in range(number)]
    row, col = np.array(cells).T
    time = np.arange(110) * 0.009
    phase = np.sin(2 * np.pi * 20 * time)[None, :, None]
    shape, place = np.repeat([0, 1], 3)[:, None, None], np.tile([0.0, 1.0, 2.0], 2)[:, None, None]
    bulge = np.where(shape == 0, -((col - 1.5) ** 2), (col - 1.5) ** 2) * 0.12
    depth = np.maximum(phase * np.minimum(time / 0.2, 1.0)[None, :, None] - 0.1 - 0.2 * place - bulge - 0.05 * row, 0.0)
    direction = random.normal(size=(6, len(cells), 6)) + 2.0 * random.normal(size=(1, len(cells), 6))
    scale = np.array([1e-4] * 3 + [1e-6] * 3)
    wrench = depth[..., None] * direction[:, None] * scale + 1e-7 * scale * phase[..., None]
    return xr.Dataset(
        {
            "wrench": (("stimulus", "time", "whisker", "channel"), wrench.astype(np.float32)),
            "contact": (("stimulus", "time", "whisker"), depth > 0),
        },
        {
            "stimulus": list(LABELS),
            "time": time,
            "whisker": [f"{'ABCDE'[r]}{c}" for r, c in cells],
            "row": ("whisker", row),
            "col": ("whisker", col),
            "channel": list(CHANNELS),
        },
        dict.fromkeys(("array", "scene", "fidelity", "seed", "backend", "version"), "test") | {"content_hash": "fake"},
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo")
    make_rodgers_demo(folder, make_stimuli())
    return folder


@pytest.fixture(scope="module")
def dataset(folder):
    return open_recordings(folder)


def correlation(first, second):
    return np.corrcoef(first, second)[0, 1]


def mean_rdm(sessions):
    """RDM of condition means over all units of a subject, as nothing in the package computes it."""
    means = [
        np.stack([np.nanmean(item.responses[item.labels == index, 0], axis=0) for index in range(6)])
        for item in sessions
    ]
    return 1 - np.corrcoef(np.concatenate(means, axis=1))[np.triu_indices(6, 1)]


def half_rdms(sessions, seed):
    halves: tuple[list, list] = ([], [])
    random = np.random.default_rng(seed)
    for trials in sessions:
        labels = trials.labels
        chosen = np.zeros(len(labels), dtype=bool)
        for index in range(6):
            rows = random.permutation(np.flatnonzero(labels == index))
            chosen[rows[: len(rows) // 2]] = True
        for half, part in zip(halves, (chosen, ~chosen), strict=True):
            half.append(trials.take(part))
    return [mean_rdm(half) for half in halves]


def test_four_animals_in_the_rodgers_layout_labelled_synthetic(folder, dataset):
    assert dataset.attrs["layout"] == "rodgers (detected from its columns)"
    assert dataset.attrs["vocabulary"] == list(LABELS)
    assert dataset.attrs["missing"] == {}
    assert dataset.attrs["synthetic"] is True
    assert all(session["synthetic"] for session in dataset.attrs["sessions"])
    found = trials_by_subject(dataset)
    assert list(found) == ["demo01", "demo02", "demo03", "demo04"]
    for sessions in found.values():
        assert 150 <= sum(len(block.labels) for block in sessions) <= 250
        assert 40 <= sum(block.responses.shape[2] for block in sessions) <= 80
    for path in folder.glob("*.nwb"):
        with h5py.File(path) as file:
            for name in ("session_description", "general/subject/description"):
                assert file[name][()].decode().startswith("SYNTHETIC")


def test_the_quirks_of_the_real_files_are_there(folder, dataset):
    for rule in ("stimulus!=nothing", "outcome!=spoil", "direct_delivery!=true", "stim_is_random!=false"):
        assert dataset.attrs["removed"][f"trials: {rule}"] > 0
    for rule in ("optogenetic!=true", "ignore_trial!=true", "outside the recorded span"):
        assert dataset.attrs["removed"][f"trials: {rule}"] > 0
    assert dataset["unit_layer" if "unit_layer" in dataset else "layer"].values.tolist().count("") == 0
    ids = dataset["trial_id"].values[dataset["session"].values == "01"].astype(int)
    assert set(np.diff(np.unique(ids))) - {1}
    with h5py.File(folder / "sub-demo02_ses-01_behavior+ecephys.nwb") as file:
        behaviour = file["processing/behavior"]
        assert "contacts_by_whisker_C0" not in behaviour
        contacts = behaviour["contacts_by_whisker_C1"]
        assert np.any(contacts["start_time"][:] == contacts["stop_time"][:])
        assert np.any(np.diff(file["units/id"][:]) > 1)
        assert len(behaviour["licks/timestamps"]) > 100
    with h5py.File(folder / "sub-demo03_ses-01_behavior+ecephys.nwb") as file:
        assert len(np.unique(file["units/obs_intervals"][:, 1])) == 2


def test_firing_peaks_about_15_ms_after_the_first_contact(folder):
    """The clock check of the real data: contacts and spikes are on one clock."""
    early = open_recordings(folder, window="first-contact-0.06..+0.12", bin=0.005)
    rates = early["counts"].values / early["duration"].values[..., None]
    profile = np.nanmean(rates, axis=(0, 2))
    assert profile[12:18].max() > 1.25 * profile[:12].mean()
    assert 0.005 <= 0.005 * (np.argmax(profile[12:18]) + 0.5) <= 0.030


def test_counts_are_over_dispersed(dataset):
    factors = []
    for sessions in trials_by_subject(dataset).values():
        for trials in sessions:
            for index in range(6):
                counts = trials.responses[trials.labels == index, 0] * 0.8
                mean, spread = np.nanmean(counts, axis=0), np.nanvar(counts, axis=0, ddof=1)
                factors.append(np.sum(spread) / np.sum(mean))
    assert 1.25 < np.mean(factors) < 2.0


def test_measured_geometry_tends_to_the_stored_truth(folder, dataset):
    truth = read_truth(folder)
    assert truth["labels"] == list(LABELS)
    measured = {name: mean_rdm(sessions) for name, sessions in trials_by_subject(dataset).items()}
    own = {name: correlation(rdm, truth["subjects"][name]) for name, rdm in measured.items()}
    assert min(own[name] for name in ("demo01", "demo02")) > 0.85
    assert correlation(np.mean(list(measured.values()), axis=0), truth["shared"]) > 0.8


def test_animals_are_reliable_except_the_one_made_hard_to_read(dataset):
    reliability = {}
    for name, sessions in trials_by_subject(dataset).items():
        r = np.mean([correlation(*half_rdms(sessions, seed)) for seed in range(20)])
        reliability[name] = 2 * r / (1 + r)
    assert reliability["demo01"] > 0.6
    assert reliability["demo02"] > 0.6
    assert reliability["demo04"] < max(reliability.values()) - 0.05


def test_the_same_stimuli_give_the_same_files(folder, tmp_path):
    for path in make_rodgers_demo(tmp_path, make_stimuli()):
        assert file_hash(path) == file_hash(folder / path.name)
    other = make_rodgers_demo(tmp_path / "other", make_stimuli(), seed=1, animals=1)
    assert file_hash(other[0]) != file_hash(folder / other[0].name)


def test_the_order_of_the_stimuli_does_not_matter(folder, tmp_path):
    turned = make_stimuli().isel(stimulus=[3, 1, 5, 0, 4, 2])
    for path in make_rodgers_demo(tmp_path, turned, animals=1):
        assert file_hash(path) == file_hash(folder / path.name)


def test_it_is_small_and_tells_its_progress(tmp_path):
    calls = []
    paths = make_rodgers_demo(tmp_path, make_stimuli(), progress=lambda *state: calls.append(state))
    assert sum(path.stat().st_size for path in paths) < 15e6
    assert calls[-1][:2] == (len(paths), len(paths))


def test_inspection_says_that_it_is_synthetic(folder):
    report = inspect(folder)
    assert report.layout == "rodgers"
    assert "SYNTHETIC" in str(report)
    assert report.proposals[0].labels == LABELS


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_files_are_valid_for_pynwb_and_free_of_critical_findings(folder):
    pynwb = pytest.importorskip("pynwb")
    nwbinspector = pytest.importorskip("nwbinspector")
    allowed = {"BEST_PRACTICE_VIOLATION", "BEST_PRACTICE_SUGGESTION"}
    for path in sorted(folder.glob("*.nwb")):
        assert list(pynwb.validate(path=str(path))) == []
        messages = list(nwbinspector.inspect_nwbfile(nwbfile_path=path, config=nwbinspector.load_config("dandi")))
        assert [message.message for message in messages if message.importance.name not in allowed] == []
        with pynwb.NWBHDF5IO(path, "r") as io:
            units = io.read().units.to_dataframe()
        assert units["spike_times"].map(len).min() > 0


def test_unsuitable_stimuli_are_refused(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    stimuli = make_stimuli()
    with pytest.raises(DataError, match="'convex-close'"):
        make_rodgers_demo("unused", stimuli.isel(stimulus=slice(5)))
    with pytest.raises(DataError, match=r"contact \[stimulus, time, whisker\]"):
        make_rodgers_demo("unused", stimuli.drop_vars("contact"))
    with pytest.raises(DataError, match="'C0', 'C1', 'C2', 'C3'"):
        make_rodgers_demo("unused", stimuli.isel(whisker=slice(10)))
    with pytest.raises(DataError, match="wrench for 'A3'"):
        make_rodgers_demo("unused", stimuli.assign(wrench=stimuli["wrench"].where(stimuli["whisker"] != "A3")))
    with pytest.raises(DataError, match="same for all stimuli"):
        make_rodgers_demo("unused", stimuli.assign(wrench=stimuli["wrench"] * 0))
    with pytest.raises(DataError, match=r"'concave-far' .*'C0', 'C1'"):
        make_rodgers_demo("unused", stimuli.assign(contact=stimuli["contact"] & (stimuli["stimulus"] != "concave-far")))
    with pytest.raises(UsageError, match=r"animals .*received 0"):
        make_rodgers_demo("unused", stimuli, animals=0)
    assert list(tmp_path.iterdir()) == []


def test_the_cache_keeps_them_by_their_stimuli(monkeypatch, tmp_path):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    made = ensure_rodgers_demo(make_stimuli(), animals=1)
    assert ensure_rodgers_demo(make_stimuli(), animals=1) == made
    assert ensure_rodgers_demo(make_stimuli().assign_attrs(content_hash="other"), animals=1) != made
    assert open_recordings(made).attrs["stimuli"] == "rodgers"
