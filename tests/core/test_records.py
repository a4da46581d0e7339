import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from brainbench.core.errors import DataError
from brainbench.core.records import Ceiling, Interval, LayerScore, ModelCard, ResultRecord, Score, SubjectScore


def three_stimuli_score(**changes: object) -> Score:
    """Return a score of two layers, one animal and three stimuli."""
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
    score = three_stimuli_score(p=math.nan)
    again = Score.from_json(score.to_json())
    assert again.to_json() == score.to_json()
    assert math.isnan(again.p)
    assert math.isnan(again.model_rdm[2])
    assert again.subjects[0].units == 3
    assert isinstance(again.layers, tuple)


def test_a_record_survives_json():
    card = ModelCard("zhuang", parameters=5, accuracy_interval=Interval(0.1, 0.2))
    record = ResultRecord(
        three_stimuli_score(), three_stimuli_score(), {"raw input": three_stimuli_score()}, card, synthetic=True
    )
    again = ResultRecord.from_json(record.to_json())
    assert again.to_json() == record.to_json()
    assert again.card == card
    assert again.synthetic


def test_identity_ignores_when_and_where_but_not_what():
    record = ResultRecord(three_stimuli_score())
    later = ResultRecord(three_stimuli_score(provenance={"time": "later", "seed": 0, "machine": "other"}))
    assert record.identity == later.identity
    assert record.identity != ResultRecord(three_stimuli_score(provenance={"time": "now", "seed": 1})).identity
    assert record.identity != ResultRecord(three_stimuli_score(value=0.81)).identity


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a readable JSON text"),
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


def test_the_summary_says_undefined_and_why():
    text = three_stimuli_score(value=math.nan, status="undefined", reasons=("one animal only",)).summary()
    assert "undefined" in text
    assert "one animal only" in text
    assert "nan" not in text


def test_html_of_a_score_escapes_what_it_shows():
    html = three_stimuli_score(name="<script>alert(1)</script>")._repr_html_()
    assert "<script>" not in html
    assert "None" not in three_stimuli_score(layer=None, best_layer=None)._repr_html_()
    assert "0.8" in html
    assert json.loads(three_stimuli_score().to_json())["value"] == 0.8
