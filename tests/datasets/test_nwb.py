import re
from datetime import UTC, datetime

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import inspect, open_recordings, write_recordings
from brainbench.datasets.nwb import read_nwb
from brainbench.datasets.sessions import make_session
from brainbench.datasets.trials.session_trials import trials_by_subject
from tests.factories.recordings import HUMAN, write_nwb

INTRACELLULAR = {
    "LantyerEtAl2018_170328_AB_277_ST50_C.nwb": "2 VoltageClampSeries",
    "LantyerEtAl2018_180817_ME_9_CC.nwb": "10 CurrentClampSeries",
    "FergusonEtAl2015_PYR5_rebound.nwb": "10 CurrentClampSeries",
}


def test_interval_tables_in_processing_modules_are_found(tmp_path):
    path = write_nwb(tmp_path / "a.nwb")
    dataset = open_recordings(path, conditions="pokes:side")
    assert dataset.attrs["vocabulary"] == ["1", "2"]
    assert dataset["unit_id"].values.tolist() == ["17"]
    assert np.all(dataset["counts"].values == 10)


def test_natural_order_is_used_for_conditions_without_a_layout(tmp_path):
    dataset = open_recordings(write_nwb(tmp_path / "a.nwb"), conditions="trials:texture")
    assert dataset.attrs["vocabulary"] == ["P20", "P100"]


def test_the_subject_comes_from_the_file_else_from_its_name(tmp_path):
    named = open_recordings(write_nwb(tmp_path / "x.nwb", subject="m7"), conditions="trials:texture")
    assert set(named["subject"].values) == {"m7"}
    guessed = open_recordings(
        write_nwb(tmp_path / "sub-k2_ses-3_ecephys.nwb", subject="", session=""), conditions="trials:texture"
    )
    assert (guessed["subject"].values[0], guessed["session"].values[0]) == ("k2", "3")
    assert re.search("subject_id.*'k2'", "".join(guessed.attrs["notes"]))
    for name in ("one", "two"):
        write_nwb(tmp_path / "unnamed" / f"{name}.nwb", subject="")
    assert "'one', 'two'" in " ".join(
        open_recordings(tmp_path / "unnamed", conditions="trials:texture").attrs["doubts"]
    )


def test_files_without_units_are_skipped_in_a_folder_and_refused_alone(tmp_path):
    write_nwb(tmp_path / "a.nwb", session="1")
    alone = write_nwb(tmp_path / "sub" / "b.nwb", session="2", units=False)
    dataset = open_recordings(tmp_path, conditions="trials:texture")
    assert "b.nwb has no units table" in "".join(dataset.attrs["notes"])
    with pytest.raises(DataError, match=r"b\.nwb .*trials, pokes"):
        open_recordings(alone, conditions="trials:texture")


def test_sessions_without_the_table_are_skipped_with_the_reason_and_refused_when_strict(tmp_path):
    own = {"start_time": [0.0, 1.0, 2.0, 3.0], "stop_time": [0.5, 1.5, 2.5, 3.5], "kind": ["a", "b", "a", "b"]}
    sessions = {"1": {"trials": own}, "2": {"epochs": own}}
    for name, tables in sessions.items():
        write_recordings(tmp_path / f"{name}.h5", make_session("m", name, [np.arange(0.1, 4, 0.1)], tables))
    dataset = open_recordings(tmp_path, conditions="trials:kind")
    assert set(dataset["session"].values) == {"1"}
    (reason,) = dataset.attrs["skipped"]
    assert "2.h5" in reason
    assert "epochs" in reason
    with pytest.raises(UsageError, match="trials"):
        open_recordings(tmp_path, conditions="trials:kind", strict=True)
    with pytest.raises(DataError, match=r"no table 'trails'; its tables: 'trials'"):
        open_recordings(tmp_path, conditions="trails:kind")


def test_a_copy_under_another_session_name_is_recognised(tmp_path):
    write_nwb(tmp_path / "a.nwb", session="1", identifier="same")
    write_nwb(tmp_path / "b.nwb", session="2", identifier="same")
    with pytest.raises(DataError, match=r"a\.nwb and .*b\.nwb hold the same spikes"):
        open_recordings(tmp_path, conditions="trials:texture")


def test_synthetic_files_are_recognised_by_keyword_or_description(tmp_path):
    for number, options in enumerate(({"keywords": ["synthetic"]}, {"description": "SYNTHETIC session"}, {})):
        path = write_nwb(tmp_path / f"{number}.nwb", **options)
        assert open_recordings(path, conditions="trials:texture").attrs["synthetic"] is (number < 2)


def test_nwb_1_is_refused(tmp_path):
    with h5py.File(tmp_path / "old.nwb", "w") as file:
        file["nwb_version"] = "NWB-1.0.6"
    with pytest.raises(DataError, match=r"NWB-1\.0\.6; .*2\.x"):
        open_recordings(tmp_path / "old.nwb")


def test_raw_voltage_is_not_read(tmp_path):
    path = write_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "a") as file:
        # 20 GB on paper, a hole on disk: reading it would not fit the memory of any test machine.
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        plist.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((160_000_000, 64))
        h5py.h5d.create(file["acquisition"].id, b"voltage", h5py.h5t.NATIVE_INT16, space, plist)
    assert path.stat().st_size > 20e9
    assert open_recordings(path, conditions="trials:texture").sizes["trial"] == 6
    assert inspect(path).sessions[0].units.spikes == 120


def test_a_table_name_that_occurs_twice_carries_its_module(tmp_path):
    path = write_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "a") as file:
        file.copy("processing/behavior/pokes", "intervals/pokes")
        session = read_nwb(file, path)
        assert set(session.tables) == {"trials", "pokes", "behavior/pokes"}


def test_enumerated_labels_are_names_since_their_numbers_differ_between_files(tmp_path):
    for path, names in ((tmp_path / "a.nwb", "ab"), (tmp_path / "b.nwb", "ba")):
        write_nwb(path, subject=path.stem, session=path.stem)
        with h5py.File(path, "a") as file:
            trials = file["intervals/trials"]
            rows = len(trials["id"])
            trials["kind"] = np.array([names.index("ab"[row % 2]) for row in range(rows)], np.uint8)
            trials["kind"].attrs["neurodata_type"] = "EnumData"
            trials["kind_elements"] = [name.encode() for name in names]
    dataset = open_recordings(tmp_path, conditions="trials:kind")
    assert dataset.attrs["vocabulary"] == ["a", "b"]
    one, two = (dataset["stimulus"].values[dataset["subject"].values == name].tolist() for name in "ab")
    assert one == two
    with h5py.File(path, "a") as file:
        file["intervals/trials/kind"][0] = 2
    with pytest.raises(DataError, match=r"'kind'.* 2 "):
        open_recordings(path, conditions="trials:kind")


def test_labels_of_an_enumerated_type_are_names_since_their_numbers_differ_between_files(tmp_path):
    for path, names in ((tmp_path / "a.nwb", "ab"), (tmp_path / "b.nwb", "ba")):
        write_nwb(path, subject=path.stem, session=path.stem)
        kind = h5py.enum_dtype({name: number for number, name in enumerate(names)}, basetype="u1")
        with h5py.File(path, "a") as file:
            trials = file["intervals/trials"]
            numbers = [names.index("ab"[row % 2]) for row in range(len(trials["id"]))]
            trials.create_dataset("kind", data=np.array(numbers, np.uint8), dtype=kind)
    dataset = open_recordings(tmp_path, conditions="trials:kind")
    assert dataset.attrs["vocabulary"] == ["a", "b"]
    one, two = (dataset["stimulus"].values[dataset["subject"].values == name].tolist() for name in "ab")
    assert one == two


@pytest.mark.filterwarnings("ignore")
def test_files_written_by_pynwb_are_read(tmp_path):
    """Another writer: booleans, text, ragged columns, electrode references and observed spans."""
    pynwb = pytest.importorskip("pynwb")
    start = datetime(2020, 1, 1, tzinfo=UTC)
    file = pynwb.NWBFile("a session", "id-1", start, session_id="s9")
    file.subject = pynwb.file.Subject(subject_id="rat3", species="Rattus norvegicus")
    device = file.create_device("probe")
    group = file.create_electrode_group("shank", "d", "S1", device)
    for _ in range(2):
        file.add_electrode(group=group, location="S1")
    file.add_unit_column("layer", "cortical layer")
    file.add_unit_column("inhibitory", "putatively")
    for unit, layer in ((12, "4"), (5, "2/3")):
        spans = [[0.0, 10.0]] if unit == 12 else [[0.0, 3.5], [3.5, 6.0]]
        file.add_unit(
            id=unit,
            spike_times=np.arange(0.05, spans[-1][1], 0.1),
            obs_intervals=spans,
            electrodes=[0, 1],
            electrode_group=group,
            layer=layer,
            inhibitory=unit == 5,
        )
    file.add_trial_column("grating", "spatial frequency")
    file.add_trial_column("rewarded", "bool")
    for trial in range(8):
        file.add_trial(
            start_time=float(trial), stop_time=trial + 1.0, grating=[0.5, 2.0, 10.0][trial % 3], rewarded=trial != 7
        )
    with pynwb.NWBHDF5IO(tmp_path / "a.nwb", "w") as io:
        io.write(file)
    dataset = open_recordings(tmp_path / "a.nwb", conditions="trials:grating", select="rewarded=true")
    assert dataset.attrs["vocabulary"] == ["0.5", "2", "10"]
    assert dataset.attrs["removed"]["trials: rewarded=true"] == 1
    assert (dataset["subject"].values[0], dataset["session"].values[0]) == ("rat3", "s9")
    assert dataset["unit_id"].values.tolist() == ["5", "12"]
    assert dataset["layer"].values.tolist() == ["2/3", "4"]
    assert dataset["inhibitory"].values.tolist() == [1.0, 0.0]
    np.testing.assert_array_equal(dataset["counts"].values[:, 0, 1], 10)
    # The second unit's spans touch, so the trial across their seam was recorded; the last one was not.
    np.testing.assert_array_equal(dataset["counts"].values[:, 0, 0], [10] * 6 + [np.nan])
    kinds = {column.name: column.kind for column in inspect(tmp_path / "a.nwb").sessions[0].tables[0].columns}
    assert kinds["rewarded"] == "boolean"


@pytest.mark.shared
def test_human_units_go_through_to_an_rdm(reference):
    dataset = open_recordings(reference / "nwb" / HUMAN, conditions="encoding_table:stimCategory")
    assert dataset.attrs["vocabulary"] == ["0", "1", "2"]
    assert (dataset.sizes["trial"], dataset.sizes["unit"]) == (90, 35)
    ((block,),) = trials_by_subject(dataset).values()
    means = np.stack([block.responses[block.labels == index, 0].mean(axis=0) for index in range(3)])
    distances = 1 - np.corrcoef(means)[np.triu_indices(3, 1)]
    assert np.all((distances > 0) & (distances < 1))


@pytest.mark.shared
@pytest.mark.filterwarnings("ignore")
def test_human_counts_equal_those_of_pynwb(reference):
    """pynwb reads independently of us; it warns of what else is odd in this file."""
    pynwb = pytest.importorskip("pynwb")
    path = reference / "nwb" / HUMAN
    dataset = open_recordings(path, conditions="recognition_table:boundary_type", window="fixcross_time..+2")
    with pynwb.NWBHDF5IO(path, "r") as io:
        file = io.read()
        table = file.intervals["recognition_table"].to_dataframe().reset_index(drop=True)
        spikes = [file.units["spike_times"][index] for index in range(len(file.units))]
    order = np.argsort(table["start_time"].to_numpy(), kind="stable")
    begin = table["fixcross_time"].to_numpy()[order]
    expected = [[np.sum((times >= low) & (times < low + 2)) for times in spikes] for low in begin]
    np.testing.assert_array_equal(dataset["counts"].values[:, 0], expected)
    np.testing.assert_array_equal(dataset["stimulus"].values.astype(int), table["boundary_type"].to_numpy()[order])


@pytest.mark.shared
@pytest.mark.parametrize(("name", "series"), INTRACELLULAR.items())
def test_intracellular_files_are_refused_in_one_sentence_and_inspected(reference, name, series):
    path = reference / "nwb" / name
    with pytest.raises(DataError, match=rf"\d+ intracell.*\({series}\)") as error:
        open_recordings(path, conditions="trials:stimulus")
    assert "\n" not in str(error.value)
    report = inspect(path)
    assert series in str(report)
    assert report.sessions[0].units is None
    assert report.proposals == ()


@pytest.mark.shared
def test_a_probe_export_without_trials_says_what_it_lacks(reference):
    path = reference / "nwb" / "pynapple_A8604-211122.nwb"
    report = inspect(path)
    assert (report.sessions[0].units.units, report.sessions[0].units.spikes) == (3, 21_354)
    assert report.sessions[0].subject == path.stem
    with pytest.raises(DataError, match=r"no interval.*'epochs'"):
        open_recordings(path)
    with pytest.raises(UsageError, match=r"'trials'.*'epochs'"):
        open_recordings(path, conditions="trials:stimulus")


def test_sessions_are_built_from_arrays_with_ids():
    session = make_session("m", "1", [np.zeros(2)], {"t": {"start_time": [0.0]}}, unit_columns={"id": [99]})
    assert session.units.ids().tolist() == [99]


def test_units_without_an_area_have_the_one_that_all_their_electrodes_share(tmp_path):
    path = write_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "a") as file:
        file["general/extracellular_ephys/electrodes/location"] = ["M1", "S1", "S1"]
        file["units/electrodes"] = [1, 2]
        file["units/electrodes_index"] = [2]
        file["units/electrodes_index"].attrs["neurodata_type"] = "VectorIndex"
    assert open_recordings(path, conditions="trials:texture")["area"].values.tolist() == ["S1"]
    for electrodes in ([0, 1], [1, -1], [1, 7]):
        with h5py.File(path, "a") as file:
            file["units/electrodes"][...] = electrodes
        assert open_recordings(path, conditions="trials:texture")["area"].values.tolist() == [""]
    with h5py.File(path, "a") as file:
        file["units/electrodes_index"][...] = 5
    assert open_recordings(path, conditions="trials:texture")["area"].values.tolist() == [""]
