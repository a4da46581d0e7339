import math

import numpy as np
import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.datasets.whisking.sweep_files import CELLS, read_sweep
from tests.factories.published_sweeps import sweep_data, write_sweep


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "rate", "conditions"),
    [
        ("sweep_example_1000hz.npz", 1000, (0.03, -0.005, math.radians(30), 0.008, 0.04)),
        ("sweep_example_110hz.npz", 110, (0.03, -0.003, math.radians(102), 0.005, 0.04)),
    ],
)
def test_published_sweeps_are_read_in_newtons(reference, name, rate, conditions):
    path = reference / "published" / name
    sweep = read_sweep(path)
    data = np.load(path)["data"]
    kept = np.delete(data, [5, 6, 12, 13, 34], axis=1)
    np.testing.assert_array_equal(sweep.data, kept)
    np.testing.assert_allclose(sweep.wrench()[..., :3], kept[..., :3] / 1e3, rtol=1e-7)
    np.testing.assert_allclose(sweep.wrench()[..., 3:], kept[..., 3:] / 1e6, rtol=1e-7)
    assert (sweep.label, sweep.shape, sweep.rate) == (49, "04530566/eb00c722894c3d70c40386bdd72f9a0", rate)
    assert sweep.conditions == pytest.approx(conditions)


@pytest.mark.shared
def test_values_that_the_published_cleaning_replaced_are_found_where_the_raw_run_is_wrong(reference):
    where = read_sweep(reference / "published" / "sweep_example_110hz.npz").faulty()
    # Whisker 12 is wild in row 60 and whisker 25 infinite in Fy of row 70 (MANIFEST of the reference).
    expected = np.zeros((110, 30, 6), dtype=bool)
    expected[60, 12] = expected[70, 25, 1] = True
    np.testing.assert_array_equal(where["repeated"], expected)
    assert not any(where[name].any() for name in ("too large", "missing", "unwritten"))


def test_values_that_cannot_be_trusted_are_counted_and_missing(tmp_path):
    data = sweep_data(1, cells=30)
    data[7, 3, 1], data[9, 4, 5], data[20, 5, :2], data[0, 6, 0] = 1000.5, -math.inf, math.nan, 0.25
    data[30, 8] = data[29, 8]
    sweep = read_sweep(write_sweep(tmp_path / "a.npz", rate=110, data=data))
    counts = {name: int(where.sum()) for name, where in sweep.faulty().items()}
    assert counts == {"repeated": 6, "too large": 2, "missing": 2, "unwritten": 1}
    assert np.isnan(sweep.wrench()).sum() == 4
    assert sweep.conditions == pytest.approx((0.045, -0.003, math.radians(102), 0.005, 0.02))


def test_a_whisker_at_rest_is_no_fault(tmp_path):
    data = sweep_data(1)
    data[40:, 0] = data[40, 0]
    assert not read_sweep(write_sweep(tmp_path / "a.npz", data=data)).faulty()["repeated"].any()


@pytest.mark.parametrize(("label", "number"), [("?", None), ("7", 7), (3.0, 3), (-1, None), (math.nan, None)])
def test_a_label_is_a_number_or_nothing(tmp_path, label, number):
    assert read_sweep(write_sweep(tmp_path / "a.npz", label=label)).label == number
    assert read_sweep(write_sweep(tmp_path / "b.npz", leave_out=("label",))).label is None


@pytest.mark.parametrize(
    ("changed", "culprit"),
    [
        ({"data": np.zeros((100, 35, 6))}, r"\[100, 35, 6\]"),
        ({"data": np.zeros((110, 29, 6))}, r"\[110, 29, 6\]"),
        ({"data": np.full((110, 35, 6), "1")}, "<U1"),
        ({"data": np.ones((110, 35, 6))}, "5, 6, 12, 13, 34"),
        ({"data": np.array([None, 1])}, "Python objects"),
        ({"h": "low"}, "'low'"),
        ({"leave_out": ("data",)}, "shape, label, h, d, t"),
        ({"leave_out": ("d",)}, "data, shape, label, h, t"),
    ],
)
def test_what_is_no_sweep_is_named(tmp_path, changed, culprit):
    path = write_sweep(tmp_path / "odd.npz", **changed)
    with pytest.raises(DataError, match=culprit) as error:
        read_sweep(path)
    assert "odd.npz" in str(error.value)


def test_a_damaged_file_is_named(tmp_path):
    path = write_sweep(tmp_path / "short.npz")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DataError, match=r"short\.npz"):
        read_sweep(path)
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(DataError, match=r"text\.npz"):
        read_sweep(tmp_path / "text.npz")
    np.save(tmp_path / "alone.npy", sweep_data(0))
    with pytest.raises(DataError, match=r"alone\.npy"):
        read_sweep(tmp_path / "alone.npy")
    flipped = bytearray(write_sweep(tmp_path / "flip.npz").read_bytes())
    flipped[2000] ^= 255
    (tmp_path / "flip.npz").write_bytes(flipped)
    with pytest.raises(DataError, match=r"flip\.npz"):
        read_sweep(tmp_path / "flip.npz")
    with pytest.raises(DataFileNotFoundError, match=r"none\.npz"):
        read_sweep(tmp_path / "none.npz")


def test_the_whiskers_are_those_of_the_mouse_in_the_order_of_the_array():
    from brainbench.stimuli import WhiskerArray

    assert CELLS.tolist() == [mount.row * 7 + mount.col for mount in WhiskerArray.mouse()]
