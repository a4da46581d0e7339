"""Tracks of every tracker give the shapes that were written, in SI units."""

from __future__ import annotations

import pickle

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.fitting import TrackOptions, read_shapes
from brainbench.stimuli.tracks.readers import bezier, pickled_names
from tests.factories import whisker_tracks as tracks

SCALE, RATE = 5e-5, 500.0
SHAPES = tracks.bent_shapes()
PIXELS = SHAPES / SCALE * [1, -1]


def write_whiskers_text(path, traces):
    """Write whisk's text file of traces."""
    lines = ["whisker1 (frame,id,time,n,x1,y1,thick1,score1...,xn,yn,thickn,scoren)"]
    for (frame, number), points in traces.items():
        cells = [frame, number, frame, len(points), *(cell for x, y in points for cell in (x, y, 1, 1))]
        lines.append(",".join(map(str, cells)))
    path.write_text("\n".join(lines) + "\n")
    return path


def write_whiskerman_hdf5(path, control, follicle, tracked):
    """Write the same of one whisker in MATLAB's format 7.3, whose axes are reversed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("r3all", control), ("fp3_all", follicle), ("tracked", tracked[:, None])):
            file[f"whisker/{name}"] = np.asarray(values, dtype=float).T
    return path


def _options(**changes):
    return TrackOptions(metres_per_pixel=SCALE, frame_rate=RATE, **changes)


def _two_whiskers():
    """Two traces a frame whose numbers change places, half of them written tip first."""
    traces, labels, follicles = {}, {}, {}
    for frame, points in enumerate(PIXELS):
        for label, trace in enumerate((points, points + np.array([0, 40]))):
            key = (frame, (label + frame) % 2)
            traces[key], labels[key], follicles[key] = (trace[::-1] if frame % 2 else trace), label, trace[0]
    return traces, labels, follicles


@pytest.mark.parametrize("write", [tracks.write_whiskers, write_whiskers_text])
def test_whisk_traces_are_chosen_by_label_and_turned_by_follicle(tmp_path, write):
    traces, labels, follicles = _two_whiskers()
    path = write(tmp_path / "a.whiskers", traces)
    table = tracks.write_measurements(tmp_path / "a.csv", labels, follicles)
    found = read_shapes(path, _options(identities=str(table), track="0"))
    np.testing.assert_allclose(found["shape"].values, SHAPES, atol=1e-7)
    with pytest.raises(UsageError, match=r"\(label\).*as track.* '0', '1'"):
        read_shapes(path, _options(identities=str(table)))
    with pytest.raises(UsageError, match="identities"):
        read_shapes(path, _options())


def test_two_traces_of_a_frame_with_one_label_are_refused(tmp_path):
    traces, labels, follicles = _two_whiskers()
    path = tracks.write_whiskers(tmp_path / "a.whiskers", traces)
    # As whisk writes it before the whiskers are told apart.
    table = tracks.write_measurements(tmp_path / "a.csv", dict.fromkeys(labels, 0), follicles)
    with pytest.raises(UsageError, match="several traces of the label 0"):
        read_shapes(path, _options(identities=str(table)))


def test_a_single_trace_needs_no_identity_and_its_base_is_the_end_that_moves_less(tmp_path):
    traces = {(frame, 7 + frame): points[:: 1 if frame % 3 else -1] for frame, points in enumerate(PIXELS)}
    found = read_shapes(tracks.write_whiskers(tmp_path / "a.whiskers", traces), _options())
    np.testing.assert_allclose(found["shape"].values, SHAPES, atol=1e-7)


def test_whiskiwrap_files_are_read(tmp_path):
    traces = {(frame, 0): points for frame, points in enumerate(PIXELS)}
    follicles = {key: points[0] for key, points in traces.items()}
    found = read_shapes(tracks.write_whiskiwrap(tmp_path / "a.hdf5", traces, follicles), _options())
    np.testing.assert_allclose(found["shape"].values, SHAPES, atol=1e-7)


def test_a_cut_off_whisk_file_is_refused(tmp_path):
    traces = {(frame, 0): points for frame, points in enumerate(PIXELS)}
    path = tracks.write_whiskers(tmp_path / "a.whiskers", traces)
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(DataError, match="cut off or damaged"):
        read_shapes(path, _options())


def _same(dataset, shapes=SHAPES):
    np.testing.assert_allclose(dataset["shape"].values, shapes, atol=1e-8)
    np.testing.assert_allclose(np.diff(dataset["time"].values), 1 / RATE)


def test_a_table_of_points_is_read_in_metres_with_y_up(tmp_path):
    _same(read_shapes(tracks.write_points(tmp_path / "a.csv", SHAPES), _options()))


def test_times_count_from_the_zero_frame(tmp_path):
    path = tracks.write_points(tmp_path / "a.csv", SHAPES, frames=range(100, 112))
    assert read_shapes(path, _options(zero_frame=98))["time"].values[0] == pytest.approx(2 / RATE)


def test_three_axes_are_kept(tmp_path):
    shapes = tracks.bent_shapes(axes=3)
    _same(read_shapes(tracks.write_points(tmp_path / "a.csv", shapes), _options()), shapes)


@pytest.mark.parametrize("name", ["csv", "table"])
def test_deeplabcut_points_below_the_likelihood_are_missing(tmp_path, name):
    likelihood = np.full(PIXELS.shape[:2], 0.9)
    likelihood[3, 4] = 0.2
    write = {"csv": tracks.write_deeplabcut_csv, "table": tracks.write_deeplabcut_table}[name]
    path = write(tmp_path / ("a.csv" if name == "csv" else "a.h5"), PIXELS, likelihood)
    expected = SHAPES.copy()
    expected[3, 4] = np.nan
    dataset = read_shapes(path, _options())
    _same(dataset, expected)
    assert any("points" in fault for fault in dataset.attrs["faults"])


def test_deeplabcut_parts_are_taken_in_the_order_asked_for(tmp_path):
    path = tracks.write_deeplabcut_csv(tmp_path / "a.csv", PIXELS, np.ones(PIXELS.shape[:2]), individuals="mouse1")
    found = read_shapes(path, _options(parts=("p0", "p4", "p9"), track="mouse1"))
    _same(found, SHAPES[:, [0, 4, 9]])
    with pytest.raises(UsageError, match="p9"):
        read_shapes(path, _options(parts=("p99",)))


def test_names_in_a_pickle_are_read_and_nothing_is_executed():
    names = [("net", "base", "x"), ("net", "base", "y")]
    for protocol in range(5):
        assert pickled_names(pickle.dumps(names, protocol), "file") == names

    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("a pickle was loaded",))

    with pytest.raises(DataError, match="not plain texts"):
        pickled_names(pickle.dumps([Bomb()]), "file")


@pytest.mark.parametrize("write", [tracks.write_whiskerman, write_whiskerman_hdf5])
def test_whiskerman_curves_are_evaluated_from_the_follicle(tmp_path, write):
    rng = np.random.default_rng(0)
    t = np.array([0.0, 0.5, 1.0])
    control = np.stack([300 * t, 40 * t**2 + 100, 50 * t], axis=0)[None] + rng.normal(size=(8, 3, 1)) * [[[1.0]]]
    tracked = np.ones(8)
    tracked[[0, 4]] = 0
    path = write(tmp_path / "a.tr4", control[:, :, ::-1], control[:, :, 0], tracked)
    options = _options(track="1", rows_down=False)
    found = read_shapes(path, options)
    expected = bezier(control, 3)[1:] * SCALE
    expected[3] = np.nan
    np.testing.assert_allclose(found["shape"].values, expected, atol=1e-9)
    assert "1 of 7 frames" in found.attrs["faults"][0]


@pytest.mark.parametrize("shorter", [lambda rows: rows[:-1], lambda rows: rows[None]])
def test_each_trace_of_whiskiwrap_has_one_row_of_the_summary(tmp_path, shorter):
    traces = {(frame, 0): points for frame, points in enumerate(PIXELS)}
    path = tracks.write_whiskiwrap(tmp_path / "a.hdf5", traces, {key: points[0] for key, points in traces.items()})
    with h5py.File(path, "a") as file:
        rows = file["summary"][()]
        del file["summary"]
        file["summary"] = shorter(rows)
    with pytest.raises(DataError, match="one row of summary"):
        read_shapes(path, _options())


@pytest.mark.filterwarnings("error")
def test_complex_numbers_are_refused(tmp_path):
    # Their real part alone, with a warning of NumPy, were numbers that nobody wrote.
    traces = {(frame, 0): points for frame, points in enumerate(PIXELS)}
    path = tracks.write_whiskiwrap(tmp_path / "a.hdf5", traces, {key: points[0] for key, points in traces.items()})
    with h5py.File(path, "a") as file:
        del file["pixels_x"]
        file["pixels_x"] = np.ones((len(traces), 10), complex)
    with pytest.raises(DataError, match="complex"):
        read_shapes(path, _options())
    curves = tracks.write_whiskerman(tmp_path / "a.tr4", np.ones((8, 3, 3), complex), np.ones((8, 3)), np.ones(8))
    with pytest.raises(DataError, match="complex"):
        read_shapes(curves, _options(track="1", rows_down=False))


def test_files_that_are_no_tracks_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text("time,Fx\n0,1\n")
    with pytest.raises(DataError, match="is no track"):
        read_shapes(tmp_path / "a.csv", _options())
    (tmp_path / "a.measurements").write_bytes(b"measV1")
    with pytest.raises(UsageError, match="identities"):
        read_shapes(tmp_path / "a.measurements", _options())
    with pytest.raises(DataError, match="There is no track"):
        read_shapes(tmp_path / "b.csv", _options())


def test_times_in_place_of_frame_numbers_are_refused_at_once(tmp_path):
    path = tracks.write_points(tmp_path / "a.csv", SHAPES, frames=range(0, 12_000_000_000, 1_000_000_000))
    with pytest.raises(DataError, match="numbers of frames"):
        read_shapes(path, _options())


def test_points_of_a_frame_may_stand_apart(tmp_path):
    path = tracks.write_points(tmp_path / "a.csv", SHAPES)
    head, *rows = path.read_text().splitlines()
    # First every frame's first point, then every second one.
    mixed = [row for point in range(10) for row in rows[point::10]]
    path.write_text("\n".join([head, *mixed]) + "\n")
    _same(read_shapes(path, _options()))


def test_names_of_columns_that_differ_in_number_are_refused(tmp_path):
    path = tracks.write_deeplabcut_csv(tmp_path / "a.csv", PIXELS, np.ones(PIXELS.shape[:2]))
    path.write_text(path.read_text().replace(",p0,p0,p0,", ",p0,p0,", 1))
    with pytest.raises(DataError, match="differ in length"):
        read_shapes(path, _options())


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"metres_per_pixel": None}, "metres_per_pixel"),
        ({"frame_rate": None}, "frame_rate"),
        ({"metres_per_pixel": 50.0}, "at least 1e-08 and at most 0.01"),
        ({"frame_rate": 0.002}, "frames per second"),
        ({"layout": "whiskermann"}, "whiskerman"),
    ],
)
def test_scale_and_rate_are_required_and_checked(changes, word):
    with pytest.raises(UsageError, match=word):
        TrackOptions(**{"metres_per_pixel": SCALE, "frame_rate": RATE, **changes})
