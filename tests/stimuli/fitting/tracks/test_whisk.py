"""Traces of whisk: binary, text and HDF5, with labels and follicles."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.fitting import TrackOptions, read_shapes
from tests.factories import whisker_tracks as tracks

SCALE, RATE = 5e-5, 500.0
SHAPES = tracks.bent_shapes()
PIXELS = SHAPES / SCALE * [1, -1]


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


@pytest.mark.parametrize("write", [tracks.write_whiskers, tracks.write_whiskers_text])
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
