import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from tests.factories.recordings import make_simple_session, write_nwb


def write(path, made=None, **options):
    return write_recordings(path, made or make_simple_session(**options))


def test_missing_files_and_empty_searches_are_named(tmp_path):
    write(tmp_path / "session.h5")
    with pytest.raises(DataFileNotFoundError, match=r"sesion.h5'; did you mean 'session.h5'"):
        open_recordings(tmp_path / "sesion.h5", conditions="trials:stimulus")
    with pytest.raises(DataFileNotFoundError, match=r"matches no file"):
        open_recordings(str(tmp_path / "*.nwb"), conditions="trials:stimulus")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataFileNotFoundError, match=r"/empty' .*\.nwb"):
        open_recordings(tmp_path / "empty", conditions="trials:stimulus")


def test_damaged_files_are_refused_with_the_reason(tmp_path):
    whole = write(tmp_path / "a.h5").read_bytes()
    cases = {
        "cut.h5": (whole[: len(whole) // 2], "is truncated"),
        "text.nwb": (b"subject,trial\n", "is not an HDF5 file.*NWB 2.x"),
        "empty.nwb": (b"", r"is not an HDF5 file \(it is empty\)"),
        "lfs.nwb": (b"version https://git-lfs.github.com/spec/v1\n", "pointer that git-lfs"),
    }
    for name, (content, message) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError, match=message):
            open_recordings(tmp_path / name, conditions="trials:stimulus")


def test_foreign_hdf5_is_refused_with_what_it_holds(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["voltage"] = np.zeros(3)
    with pytest.raises(DataError, match="it holds voltage"):
        open_recordings(tmp_path / "a.h5", conditions="trials:stimulus")


def test_a_folder_with_nwb_files_leaves_other_hdf5_files_alone(tmp_path):
    write_nwb(tmp_path / "a.nwb")
    write_nwb(tmp_path / ".hidden.nwb")
    (tmp_path / "pose.h5").write_bytes(b"of another tool")
    assert open_recordings(tmp_path, conditions="trials:texture").attrs["source"].endswith("a.nwb")


def test_globs_lists_and_layouts_name_sources(tmp_path):
    paths = [write(tmp_path / f"m{index}.h5", subject=f"m{index}", seed=index) for index in range(3)]
    by_glob = open_recordings(str(tmp_path / "m[01].h5"), conditions="trials:stimulus")
    by_list = open_recordings(paths[:2], conditions="trials:stimulus")
    xr.testing.assert_identical(by_glob.drop_attrs(), by_list.drop_attrs())
    with pytest.raises(UsageError, match="'rodgrs'; did you mean 'rodgers'"):
        open_recordings(f"rodgrs:{tmp_path}")
    with pytest.raises(UsageError, match=r"'rodgers:' .*rodgers:PATH"):
        open_recordings("rodgers:")
    with pytest.raises(UsageError, match="ask for recordings='demo'"):
        open_recordings("rodgers:demo")
    with pytest.raises(UsageError, match="simulated stimuli"):
        open_recordings("demo")


@pytest.mark.parametrize("source", [3, None])
def test_a_source_of_another_kind_is_refused(source):
    with pytest.raises(UsageError, match=f"received {source}"):
        open_recordings(source)
