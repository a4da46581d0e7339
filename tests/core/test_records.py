import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import CHANNELS, check_recordings, check_stimulus_set
from brainbench.core.errors import DataError
from brainbench.core.files import to_json
from brainbench.core.provenance import Provenance
from brainbench.core.records import (
    Ceiling,
    Interval,
    LayerScore,
    ModelCard,
    ResultRecord,
    Score,
    SubjectScore,
)
from brainbench.datasets import open_recordings, write_recordings
from tests.factories.recordings import make_simple_session


def _make_score(**changes: object) -> Score:
    score = Score(
        "zhuang",
        0.8,
        "ok",
        r=0.7,
        reliability=0.9,
        interval=Interval(0.6, 1.1, method="t"),
        p=0.01,
        ceiling=Ceiling(0.8, 0.9),
        layer="conv2",
        layers=(LayerScore("conv1", math.nan, math.nan, "undefined"), LayerScore("conv2", 0.8, 0.7)),
        subjects=(SubjectScore("a", 0.8, 0.7, 0.9, units=3, trials=7, layer="conv2"),),
        stimuli=("x", "y", "z"),
        model_rdm=(0.1, 0.2, math.nan),
        provenance={"time": "now", "seed": 0},
    )
    return replace(score, **changes)


def test_a_score_survives_json_with_its_nans():
    score = _make_score(p=math.nan)
    again = Score.from_json(score.to_json())
    assert again.to_json() == score.to_json()
    assert math.isnan(again.p)
    assert math.isnan(again.model_rdm[2])
    assert again.subjects[0].units == 3
    assert isinstance(again.layers, tuple)


def test_a_record_survives_json():
    card = ModelCard("zhuang", parameters=5, accuracy_interval=Interval(0.1, 0.2))
    record = ResultRecord(_make_score(), _make_score(), {"raw input": _make_score()}, card, synthetic=True)
    again = ResultRecord.from_json(record.to_json())
    assert again.to_json() == record.to_json()
    assert again.card == card
    assert again.synthetic


def test_identity_ignores_when_and_where_but_not_what():
    record = ResultRecord(_make_score())
    later = ResultRecord(_make_score(provenance={"time": "later", "seed": 0, "machine": "other"}))
    assert record.identity == later.identity
    assert record.identity != ResultRecord(_make_score(provenance={"time": "now", "seed": 1})).identity
    assert record.identity != ResultRecord(_make_score(value=0.81)).identity


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[1]", "the record is \\[1\\]"),
        ('{"schema": 99}', "schema version 99"),
        ('{"schema": 2}', "lacks 'score'"),
        ('{"schema": 2, "score": {"name": "x", "value": 1, "status": "ok", "colour": 2}}', "no field 'colour'"),
    ],
)
def test_a_bad_record_is_refused_in_words(text: str, message: str):
    with pytest.raises(DataError, match=message):
        ResultRecord.from_json(text)


def test_shipped_records_are_read_and_written_byte_for_byte():
    paths = sorted((Path(__file__).parents[2] / "leaderboards/results").rglob("*.json"))  # not in an installed wheel
    assert len(paths) > 100
    for path in paths:
        text = path.read_text(encoding="utf-8")
        record = ResultRecord.from_json(text)
        assert record.to_json() + "\n" == text, path
        assert record.identity == path.stem.rpartition("--")[2]


def test_provenance_is_typed_and_keeps_what_it_does_not_know():
    stated = {"version": "0.1.0", "recordings": {"source": "demo"}, "seed": 3, "command": 7, "settings": {}}
    origin = _make_score(provenance=stated).provenance
    assert isinstance(origin, Provenance)
    assert (origin.version, origin.recordings["source"]) == ("0.1.0", "demo")
    assert origin.command == ""  # of another kind, so it counts as absent
    assert origin.more == {"seed": 3, "command": 7, "settings": {}}
    assert origin == stated
    assert json.loads(to_json(origin)) == stated


def test_the_summary_says_undefined_and_why():
    text = _make_score(value=math.nan, status="undefined", reasons=("one animal only",)).summary()
    assert "undefined" in text
    assert "one animal only" in text
    assert "nan" not in text


def test_html_of_a_score_escapes_what_it_shows():
    html = _make_score(name="<script>alert(1)</script>")._repr_html_()
    assert "<script>" not in html
    assert "None" not in _make_score(layer=None, best_layer=None)._repr_html_()
    assert "0.8" in html
    assert json.loads(_make_score().to_json())["value"] == 0.8


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
