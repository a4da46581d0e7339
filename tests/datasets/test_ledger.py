import h5py
import pytest

from brainbench.core.errors import DataError
from brainbench.datasets import check, inspect, open_recordings, write_recordings
from brainbench.datasets.ledger import Ledger, balance_line
from tests.factories.recordings import make_simple_session, write_nwb


def test_a_balance_that_does_not_close_is_said_and_refused_when_strict():
    ledger = Ledger()
    ledger.find("units", 5)
    ledger.find("units", 0, 3)
    ledger.leave("units", "too deep")
    ledger.leave("trials", "spoiled", 0)
    assert ledger.close() == ["5 units were found, 3 read and 1 left out"]
    with pytest.raises(DataError, match="5 units were found"):
        Ledger(strict=True).add(ledger).close()
    ledger.leave("units", "no spikes")
    assert ledger.close() == []
    assert balance_line(ledger.stated()) == "2 of 5 units: too deep, no spikes"


def test_what_is_lost_is_refused_at_once_when_strict_and_what_was_asked_for_is_not():
    ledger = Ledger(strict=True)
    ledger.leave("trials", "outcome=correct", 3)
    with pytest.raises(DataError, match="a Zarr store"):
        ledger.leave("files", "b.nwb is a Zarr store.", lost=True)


def test_every_kind_of_a_reading_adds_up(tmp_path):
    for name in ("m1", "m2"):
        write_recordings(tmp_path / f"{name}.h5", make_simple_session(subject=name))
    opened = open_recordings(tmp_path, conditions="trials:stimulus", select="stimulus=a|b; units.id=0|1")
    ledger = opened.attrs["ledger"]
    assert list(ledger) == ["files", "animals", "sessions", "tables", "units", "trials", "spikes", "labels"]
    for kind, numbers in ledger.items():
        assert numbers["found"] == numbers["read"] + sum(entry["number"] for entry in numbers["left_out"]), kind
    assert (ledger["units"]["read"], ledger["trials"]["read"], ledger["labels"]["found"]) == (4, 16, 3)
    assert ledger["spikes"]["read"] == int(opened["counts"].sum(skipna=True))
    assert "8 of 24 trials: stimulus=a|b" in balance_line(ledger)


def test_an_animal_that_is_not_read_is_named_by_every_command(tmp_path):
    write_nwb(tmp_path / "a.nwb", subject="m1")
    (tmp_path / "b.nwb.zarr").mkdir()
    (tmp_path / "c.nwb").symlink_to(tmp_path / ".git" / "annex" / "c.nwb")
    (tmp_path / "d.nwb.gz").write_bytes(b"")
    (tmp_path / "pose.h5").write_bytes(b"of another tool")
    stated = {
        "inspect": inspect(tmp_path).ledger,
        "open": open_recordings(tmp_path, conditions="trials:texture").attrs["ledger"],
    }
    for ledger in stated.values():
        assert (ledger["files"]["found"], ledger["files"]["read"]) == (5, 1)
        reasons = " ".join(entry["reason"] for entry in ledger["files"]["left_out"])
        for words in ("b.nwb.zarr is a Zarr store", "c.nwb is a link", "datalad get c.nwb", "ends in .gz", "pose.h5"):
            assert words in reasons
    with pytest.raises(DataError, match=r"b\.nwb\.zarr"):
        open_recordings(tmp_path, conditions="trials:texture", strict=True)


def test_files_of_another_tool_beside_nwb_are_no_loss(tmp_path):
    write_nwb(tmp_path / "a.nwb")
    with h5py.File(tmp_path / "pose.h5", "w") as file:
        file["x"] = [1]
    opened = open_recordings(tmp_path, conditions="trials:texture", strict=True)
    assert "pose.h5 is HDF5 but neither" in balance_line(opened.attrs["ledger"])


def _animals(folder, **labels):
    """Animals of different spikes whose twelve trials have the labels given, in turn."""
    folder.mkdir()
    for seed, (name, stimuli) in enumerate(labels.items()):
        session = make_simple_session(subject=name, columns={"stimulus": stimuli * (12 // len(stimuli))}, seed=seed)
        write_recordings(folder / f"{name}.h5", session)
    return folder


def test_data_sets_that_are_not_installed_are_named_and_other_empty_folders_are_not(tmp_path):
    folder = _animals(tmp_path / "data", m1=["a", "b", "c"])
    for name in ("sub-m2", "empty"):
        (folder / name).mkdir()
    (tmp_path / ".gitmodules").write_text('[submodule "x"]\n\tpath = data/sub-m2\n\turl = ./x\n')
    recordings = open_recordings(folder, conditions="trials:stimulus")
    (reason,) = recordings.attrs["skipped"]
    assert "sub-m2 is a data set of DataLad that is not there yet" in reason
    assert "datalad get sub-m2" in str(inspect(folder))
    with pytest.raises(DataError, match="not there yet"):
        open_recordings(folder, conditions="trials:stimulus", strict=True)


@pytest.mark.parametrize(
    ("labels", "doubted"),
    [
        ({"m1": ["ball", "comb"], "m2": ["bal", "comb"]}, True),
        ({"m1": ["ball", "bal"], "m2": ["ball", "bal"]}, False),  # somebody told them apart
        ({"m1": ["ball1", "comb"], "m2": ["ball2", "comb"]}, False),  # numbered
        ({"m1": ["ball", "comb"], "m2": ["fork", "comb"]}, False),
    ],
)
def test_labels_that_differ_in_a_letter_and_are_in_no_animal_both_are_doubted(tmp_path, labels, doubted):
    folder = _animals(tmp_path / "data", **labels)
    doubts = open_recordings(folder, conditions="trials:stimulus").attrs["doubts"]
    assert any("'bal' and 'ball' are spelt alike" in doubt for doubt in doubts) == doubted
    assert ("spelt alike" in str(check(folder, conditions="trials:stimulus"))) == doubted


def test_an_animal_of_which_no_trial_is_left_is_lost(tmp_path):
    folder = _animals(tmp_path / "data", m1=["a", "b", "c"], m2=["nan"])
    recordings = open_recordings(folder, conditions="trials:stimulus")
    animals = recordings.attrs["ledger"]["animals"]
    assert (animals["found"], animals["read"], animals["left_out"][0]["lost"]) == (2, 1, True)
    with pytest.raises(DataError, match="m2: no trial is left"):
        open_recordings(folder, conditions="trials:stimulus", strict=True)
    chosen = open_recordings(folder, conditions="trials:stimulus", select="subjects=m1", strict=True)
    assert {*chosen["subject"].values.tolist()} == {"m1"}
