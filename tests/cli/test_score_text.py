"""What the terminal says of a score, from records whose truth is known."""

from dataclasses import replace

import pytest

from brainbench.cli.score_text import left_out, score_text
from brainbench.core.records import Interval, ModelCard
from brainbench.core.statistics import compare_scores
from tests.factories.records import draw_board, make_record


def test_the_first_lines_say_what_the_weights_are_and_whether_raw_input_is_beaten():
    good, level = draw_board({"good": 0.8, "level": 0.1}, raw=0.1)
    assert "above raw input" in score_text(good).splitlines()[1].lower()
    assert score_text(level).splitlines()[1].startswith("Not told apart from raw input")
    found = compare_scores(good.score, good.baselines["raw input"])
    assert f"{found.difference:.2f}" in score_text(good).splitlines()[1]
    assert score_text(good).splitlines()[2].startswith("Score")


@pytest.mark.parametrize(
    ("card", "told"),
    [
        (ModelCard("zhuang", "zhuang", "untrained", seed=0), "(random weights, seed 0)"),
        (ModelCard("zhuang", "zhuang", "simclr", seed=1), "(trained: simclr)"),
        (ModelCard("mine.py:make", "user module", seed=2), "(your code, seed 2)"),
    ],
)
def test_the_headline_tells_random_weights_from_trained_ones(card, told):
    assert told in score_text(replace(make_record(), card=card)).splitlines()[0]


def test_an_undefined_score_prints_its_reason_and_nothing_that_does_not_exist():
    text = score_text(make_record(status="undefined", layer=None, best_layer=None, interval=None))
    assert "None" not in text
    assert "nan" not in text
    assert "two of three animals are noise" in text.splitlines()[1]


def test_an_interval_past_what_can_exist_is_cut_and_noted():
    text = score_text(make_record(reliability=0.9, reliability_interval=Interval(0.7, 1.1)))
    assert "0.90 [0.70, 1.00]" in text
    assert "cut at 1" in text


def test_what_was_not_used_is_told():
    told = "\n".join(left_out({"removed": {"trials: outside the recorded span": 1, "units: no spikes": 0}}))
    assert "outside the recorded span (1)" in told
    assert "no spikes" not in told


def test_a_title_of_the_user_replaces_the_name_of_the_file(run, files):
    asked = ("--conditions", "trials:texture", "--out", files["out"])
    folder = run("score", files["features"], "--recordings", f"{files['recordings']}/*.h5", *asked)
    assert folder.out.splitlines()[0].endswith("data")
    titled = run("score", files["features"], "--recordings", files["recordings"], "--title", "Two mice", *asked)
    assert titled.out.splitlines()[0].endswith("Two mice")
