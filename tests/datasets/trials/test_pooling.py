import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import UsageError
from brainbench.datasets import blocks, open_recordings, pooled, write_recordings
from tests.factories.recordings import make_simple_session


@pytest.fixture
def dataset(tmp_path):
    """Two animals; both have a session "1", the second also one without the stimulus "c"."""
    sessions = [
        make_simple_session(subject="m1"),
        make_simple_session(subject="m2", seed=1),
        make_simple_session(
            subject="m2", session="2", seed=2, columns={"stimulus": np.resize(np.array(["a", "b"]), 12)}
        ),
    ]
    return open_recordings(write_recordings(tmp_path / "a.h5", sessions), conditions="trials:stimulus")


def test_an_animal_is_the_pool_unless_asked_otherwise(dataset):
    xr.testing.assert_identical(pooled(dataset), dataset)
    assert {name: len(items) for name, items in blocks(dataset).items()} == {"m1": 1, "m2": 2}


def test_every_session_can_be_its_own_subject(dataset):
    result = pooled(dataset, "session")
    found = blocks(result)
    assert list(found) == ["m1/1", "m2/1", "m2/2"]
    assert result.attrs["missing"] == {"m2/2": ["c"]}
    assert dataset.attrs["missing"] == {}
    np.testing.assert_array_equal(found["m2/2"][0].responses, blocks(dataset)["m2"][1].responses)


def test_all_animals_can_be_one_subject_with_their_sessions_apart(dataset):
    ((name, sessions),) = blocks(pooled(dataset, "all")).items()
    assert name == "all"
    assert [block.responses.shape for block in sessions] == [(12, 1, 3)] * 3
    assert len({key for block in sessions for key in block.keys}) == 36


def test_pools_of_the_same_recordings_are_told_apart(dataset):
    hashes = {pooled(dataset, by).attrs["content_hash"] for by in ("subject", "session", "all")}
    assert len(hashes) == 3


def test_an_unknown_pool_suggests_the_nearest(dataset):
    with pytest.raises(UsageError, match="Unknown pool 'sesion'; did you mean 'session'"):
        pooled(dataset, "sesion")
