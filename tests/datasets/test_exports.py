import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import export, open_recordings, write_recordings
from tests.factories.recordings import HUMAN, make_simple_session, write_nwb, write_rodgers


def same(one, two):
    xr.testing.assert_identical(one.drop_attrs(), two.drop_attrs())
    assert one.attrs["content_hash"] == two.attrs["content_hash"]


@pytest.mark.parametrize("suffix", [".nwb", ".h5"])
def test_a_copy_is_counted_to_the_same_numbers(tmp_path, suffix):
    path = write_rodgers(tmp_path / "a.h5", units={"layer": ["4", "5b"], "depth": [400.0, 900.0]})
    (copy,) = export(path, tmp_path / f"copy{suffix}")
    same(open_recordings(path, bin=0.1), open_recordings(copy, bin=0.1))
    assert open_recordings(copy).attrs["layout"] == "rodgers (detected from its columns)"
    (again,) = export(copy, tmp_path / f"again{suffix}")
    same(open_recordings(copy), open_recordings(again))


@pytest.mark.parametrize("suffix", [".nwb", ".h5"])
@pytest.mark.parametrize("select", ["units.depth=300..", "stimulus=a|b", "units.id=2; stimulus!=a", "min_spikes=481"])
def test_a_selection_copied_equals_a_selection_read(tmp_path, suffix, select):
    """Also where the span was taken from the first spike of a unit that is not copied."""
    session = make_simple_session(unit_columns={"depth": [100.0, 400.0, 500.0]})
    first = session.units.data["spike_times"]
    first[480:][first[480:] < 2.0] = 2.5
    if select.startswith("min"):
        session.units.data["spike_times_index"][:] = [480, 960, 1440]
        session.units.data["spike_times_index"][0] = 479
    path = write_recordings(tmp_path / "a.h5", session)
    (copy,) = export(path, tmp_path / f"b{suffix}", select=select)
    same(
        open_recordings(path, conditions="trials:stimulus", select=select),
        open_recordings(copy, conditions="trials:stimulus"),
    )


def test_raw_data_stay_behind(tmp_path):
    path = write_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "a") as file:
        file["acquisition/voltage/data"] = np.zeros((100_000, 8), dtype=np.int16)
    (copy,) = export(path, tmp_path / "b.nwb")
    assert path.stat().st_size > 1_600_000
    assert copy.stat().st_size < 100_000
    with h5py.File(copy) as file:
        assert list(file["acquisition"]) == []
    same(open_recordings(path, conditions="pokes:side"), open_recordings(copy, conditions="pokes:side"))


def test_a_folder_gets_one_file_per_session(tmp_path):
    sessions = [make_simple_session(subject="m/1"), make_simple_session(subject="m2", session="2", synthetic=True)]
    path = write_recordings(tmp_path / "all.h5", sessions)
    files = export(path, tmp_path / "folder")
    assert sorted(file.name for file in files) == ["sub-m-1_ses-1.nwb", "sub-m2_ses-2.nwb"]
    joined = open_recordings(tmp_path / "folder", conditions="trials:stimulus")
    same(open_recordings(path, conditions="trials:stimulus"), joined)
    assert {item["subject"]: item["synthetic"] for item in joined.attrs["sessions"]} == {"m/1": False, "m2": True}
    one = export(path, tmp_path / "m2", select="subjects=m2")
    assert len(one) == 1
    with pytest.raises(UsageError, match="'m3'; did you mean 'm2'"):
        export(path, tmp_path / "m3", select="subjects=m3")


def test_a_copy_never_takes_the_place_of_its_source(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_simple_session())
    (nwb,) = export(path, tmp_path / "folder")
    before = {file: file.read_bytes() for file in (path, nwb)}
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    for source, target in ((path, path), (nwb, nwb), (nwb, nwb.parent), (nwb, tmp_path / "link")):
        with pytest.raises(UsageError, match=f"place of its source .*{source.name}"):
            export(source, target)
    assert {file: file.read_bytes() for file in before} == before


def test_what_cannot_be_written_is_refused_in_words(tmp_path):
    session = make_simple_session()
    path = write_recordings(tmp_path / "a.h5", [session, make_simple_session(session="2", seed=1)])
    with pytest.raises(UsageError, match="one session, these are 2"):
        export(path, tmp_path / "b.nwb")
    with pytest.raises(UsageError, match=r"received 'b\.mat'"):
        export(path, tmp_path / "b.mat")
    with pytest.raises(DataError, match=r"at least 9999 spikes"):
        export(path, tmp_path / "b.h5", select="min_spikes=9999")
    del session.tables["trials"].data["stop_time"]
    with pytest.raises(DataError, match=r"c\.h5:mouse-1 .*stop_time.*\.h5"):
        export(write_recordings(tmp_path / "c.h5", session), tmp_path / "c.nwb")
    assert not (tmp_path / "c.nwb").exists()
    with pytest.raises(DataError, match=r"1 files .*d\.nwb"):
        export(write_nwb(tmp_path / "d.nwb", units=False), tmp_path / "e.nwb")


def validate(path):
    pynwb = pytest.importorskip("pynwb")
    assert list(pynwb.validate(path=str(path))) == []
    with pynwb.NWBHDF5IO(path, "r") as io:
        return io.read().units.to_dataframe()


@pytest.mark.filterwarnings("ignore")
def test_a_copy_is_valid_for_pynwb(tmp_path):
    path = write_rodgers(tmp_path / "a.h5", units={"layer": ["4", "5b"], "inhibitory": [True, False]})
    (copy,) = export(path, tmp_path / "b.nwb")
    units = validate(copy)
    assert units["layer"].tolist() == ["4", "5b"]
    (copy,) = export(path, tmp_path / "c.nwb", select="servo_position=far; units.layer=4")
    assert len(validate(copy)) == 1


@pytest.mark.shared
@pytest.mark.filterwarnings("ignore")
def test_the_human_file_is_copied_valid_and_equal(reference, tmp_path):
    path = reference / "nwb" / HUMAN
    (copy,) = export(path, tmp_path / "copy.nwb")
    assert len(validate(copy)) == 35
    for conditions in ("encoding_table:stimCategory", "recognition_table:boundary_type"):
        same(open_recordings(path, conditions=conditions), open_recordings(copy, conditions=conditions))
