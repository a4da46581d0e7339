import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import CHANNELS, check_recordings, check_stimulus_set
from brainbench.core.errors import DataError
from brainbench.datasets import open_recordings, write_recordings
from tests.factories.recordings import make_simple_session


def _make_stimulus_set() -> xr.Dataset:
    attributes = ("array", "scene", "fidelity", "seed", "backend", "version", "content_hash")
    return xr.Dataset(
        {"wrench": (("stimulus", "time", "whisker", "channel"), np.zeros((1, 2, 1, 6), np.float32))},
        coords={
            "stimulus": ["a"],
            "time": [0.0, 0.1],
            "whisker": ["C2"],
            "row": ("whisker", [2]),
            "col": ("whisker", [2]),
            "channel": list(CHANNELS),
        },
        attrs=dict.fromkeys(attributes, "x"),
    )


def test_a_stimulus_set_is_checked_against_the_contract():
    good = _make_stimulus_set()
    assert check_stimulus_set(good) is good
    with pytest.raises(DataError, match=r"stimulus set .*'wrench'"):
        check_stimulus_set(good.drop_vars("wrench"))
    with pytest.raises(DataError, match=r"'wrench' .*\('time', 'stimulus',"):
        check_stimulus_set(good.transpose("time", "stimulus", "whisker", "channel"))
    with pytest.raises(DataError, match="coordinate 'row'"):
        check_stimulus_set(good.drop_vars("row"))
    with pytest.raises(DataError, match="expected \\['Fx'"):
        check_stimulus_set(good.assign_coords(channel=list(CHANNELS[::-1])))
    bare = good.copy()
    bare.attrs = {}
    with pytest.raises(DataError, match=r"attribute .*'backend'"):
        check_stimulus_set(bare)


@pytest.mark.parametrize(
    ("coordinate", "values"),
    [("stimulus", ["x" * 201]), ("stimulus", [""] * 0), ("time", [0.1, 0.0]), ("time", [0.0, np.nan]), ("row", [-1]),
     ("row", [5]), ("col", [7]), ("col", [2.0])],
)  # fmt: skip
def test_a_stimulus_set_with_impossible_coordinates_is_refused(coordinate, values):
    good = _make_stimulus_set()
    (dim,) = good[coordinate].dims
    odd = good.isel({dim: slice(len(values))}).assign_coords({coordinate: (dim, np.array(values))})
    with pytest.raises(DataError, match=r"stimulus set|whole number"):
        check_stimulus_set(odd)


def test_names_of_a_stimulus_set_differ():
    good = _make_stimulus_set()
    for dim in ("stimulus", "whisker"):
        with pytest.raises(DataError, match=dim):
            check_stimulus_set(xr.concat([good, good], dim))


def test_recordings_without_duration_are_refused():
    dataset = xr.Dataset({"counts": (("trial", "time", "unit"), np.zeros((1, 1, 1)))})
    with pytest.raises(DataError, match=r"recordings .*'duration'"):
        check_recordings(dataset)


def test_labels_of_recordings_are_those_of_the_vocabulary_each_once(tmp_path):
    good = open_recordings(write_recordings(tmp_path / "a.h5", make_simple_session()), conditions="trials:stimulus")
    for vocabulary, told in ((["a", "b", "c", "a"], "'a' twice"), (["a", "b"], "lacks: 'c'")):
        with pytest.raises(DataError, match=told):
            check_recordings(good.assign_attrs(vocabulary=vocabulary))
