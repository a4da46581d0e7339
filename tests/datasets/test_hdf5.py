import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.trials.session_trials import fingerprint
from tests.factories.recordings import make_simple_session


def test_sessions_written_and_read_give_the_same_recordings(tmp_path):
    sessions = [
        make_simple_session(subject=subject, session=session, seed=seed, unit_columns={"depth": [10.0, 20.0, 30.0]})
        for seed, (subject, session) in enumerate([("m1", "1"), ("m1", "2"), ("m2", "1")])
    ]
    together = write_recordings(tmp_path / "all.h5", sessions)
    for session in sessions:
        write_recordings(tmp_path / "parts" / f"{session.subject}{session.session}.h5", session)
    joined = open_recordings(together, conditions="trials:stimulus")
    apart = open_recordings(tmp_path / "parts", conditions="trials:stimulus")
    xr.testing.assert_identical(joined.drop_attrs(), apart.drop_attrs())
    assert joined.attrs["content_hash"] == apart.attrs["content_hash"]
    assert joined["depth"].values[:3].tolist() == [10.0, 20.0, 30.0]
    first = sessions[0].units.data
    spikes = np.split(first["spike_times"], first["spike_times_index"][:-1])[0]
    assert joined["counts"].values[0, 0, 0] == np.sum((spikes >= 1.0) & (spikes < 2.0))


def test_counted_recordings_come_back_as_they_were(tmp_path):
    write_recordings(tmp_path / "a.h5", make_simple_session(synthetic=True))
    counted = open_recordings(tmp_path / "a.h5", conditions="trials:stimulus", bin=0.25)
    again = open_recordings(write_recordings(tmp_path / "b.h5", counted))
    xr.testing.assert_equal(counted, again)
    assert again.attrs["vocabulary"] == ["a", "b", "c"]
    assert again.attrs["synthetic"] is True
    assert again.attrs["content_hash"] == counted.attrs["content_hash"]


def test_counts_of_another_byte_order_are_the_same_recordings(tmp_path):
    write_recordings(tmp_path / "a.h5", make_simple_session())
    path = write_recordings(tmp_path / "b.h5", open_recordings(tmp_path / "a.h5", conditions="trials:stimulus"))
    with h5py.File(path, "a") as file:
        for name in ("counts", "duration", "time"):
            values = file[name][...]
            del file[name]
            file[name] = values.astype(values.dtype.newbyteorder(">"))
    again = open_recordings(path)
    # Another fingerprint is that of an edited copy, whose scores stand on a board of their own.
    assert fingerprint(again) == again.attrs["fingerprint"]


def test_options_cannot_apply_to_counted_recordings(tmp_path):
    write_recordings(tmp_path / "a.h5", make_simple_session())
    write_recordings(tmp_path / "b.h5", open_recordings(tmp_path / "a.h5", conditions="trials:stimulus"))
    with pytest.raises(UsageError, match=r"b\.h5 .*counted"):
        open_recordings(tmp_path / "b.h5", bin=0.1)


def test_a_version_of_the_future_is_refused(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_simple_session())
    with h5py.File(path, "a") as file:
        file.attrs["version"] = 2
    with pytest.raises(DataError, match=r"version 2.*version 1.*newer"):
        open_recordings(path, conditions="trials:stimulus")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_simple_session())
    before = path.read_bytes()
    with pytest.raises(UsageError, match="received 3"):
        write_recordings(path, [make_simple_session(), 3])
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["a.h5"]


def test_a_missing_part_of_the_layout_is_named(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_simple_session())
    with h5py.File(path, "a") as file:
        del file["sessions/mouse-1/tables"]
    with pytest.raises(DataError, match="/sessions/mouse-1/tables"):
        open_recordings(path, conditions="trials:stimulus")
