import json
import re

import numpy as np
import pytest

from brainbench.core.errors import DataFileNotFoundError, UsageError
from brainbench.core.files import to_json
from brainbench.datasets import check, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.datasets.synthetic import write_files
from tests.datasets.checks.healthy_sessions import GEOMETRY, findings_of, make_healthy
from tests.factories.recordings import HUMAN, as_recordings, quiet_design


def test_a_healthy_session_is_told_so(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_healthy())
    checkup = check(path, conditions="trials:stimulus")
    assert (checkup.verdict, checkup.count("error"), checkup.count("warning")) == ("note", 0, 0)
    assert re.search(r"touch \(first-contact\) .*5 to 30 ms", str(checkup))
    assert str(checkup).startswith(f"{path}: 1 session, 0 errors, 0 warnings, ")
    assert json.loads(to_json(checkup))["findings"][0]["check"] == "clock"


# Files


def test_a_folder_is_judged_as_a_whole_worst_first(tmp_path):
    write_files(tmp_path, GEOMETRY, quiet_design(animals=1, units=5, trials=5), format="h5")
    (tmp_path / "broken.h5").write_bytes(b"no HDF5")
    (tmp_path / "copy.h5").write_bytes((tmp_path / "sub-synthetic01_ses-01.h5").read_bytes())
    checkup = check(tmp_path)
    assert checkup.files == 3
    assert [item.severity for item in checkup.findings[:2]] == ["error", "error"]
    assert re.search(r"broken\.h5.*HDF5", str(checkup))
    assert "hold the same spikes (5 of 5 units)" in str(checkup)
    with pytest.raises(DataFileNotFoundError):
        check(tmp_path / "nothing.h5")
    with pytest.raises(UsageError, match=r"'stimulus' .*TABLE:COLUMN"):
        check(tmp_path, conditions="stimulus")


def test_counted_recordings_are_said_to_be_beyond_checking(tmp_path):
    path = write_recordings(tmp_path / "a.h5", as_recordings(GEOMETRY, quiet_design(animals=2, units=4, trials=3)))
    assert "already counted" in findings_of(path, "file", "note")[1]


def test_a_session_without_tables_is_an_error(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_session("m", "1", [np.arange(5.0)], {}))
    assert "no interval tables" in findings_of(path, "tables", "error")[1]


@pytest.mark.shared
def test_real_files_pass_without_false_alarm(reference):
    """The human file is good; its clock cannot be judged for want of touch."""
    checkup = check(reference / "nwb" / HUMAN, conditions="encoding_table:stimCategory")
    assert checkup.count("error") == checkup.count("warning") == 0, str(checkup)
    for path in sorted((reference / "nwb").glob("*ET_AL*")) + sorted((reference / "nwb").glob("*2018*")):
        assert check(path).verdict == "error"
