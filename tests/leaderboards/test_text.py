"""What pages say of a model: how to load it, how it was trained."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brainbench.core.records import Interval, SubjectScore
from leaderboards import build_leaderboard
from leaderboards import text as words
from leaderboards.ranking import comparisons
from tests.factories.html_page import Page


def _with(record, name="net", **changes):
    card = replace(record.card, **changes)
    return replace(record, score=replace(record.score, name=name), card=card)


def test_the_lines_that_load_a_model_run_for_every_kind(make_record):
    import torch

    twin = _with(make_record(), "s4-small", objective="untrained", seed=3, family="s4")
    lines = words.loading(twin)
    assert len(lines.splitlines()) == 3
    made: dict[str, torch.nn.Module] = {}
    exec(lines, made)
    from brainbench import load_model

    for one, other in zip(made["model"].parameters(), load_model("s4-small", seed=3).parameters(), strict=True):
        assert torch.equal(one, other)
    trained = _with(make_record(), "s4-small.simclr", objective="simclr", family="s4", seed=1)
    assert "load_model('s4-small.simclr')" in words.loading(trained)
    own = _with(make_record(), "a.py:Mine", family="user module", seed=0)
    assert "load_user_model('a.py:Mine', seed=0)" in words.loading(own)
    assert "names no model to load" in words.loading(_with(make_record(), family="features computed elsewhere"))


def test_a_trained_models_page_shows_accuracy_and_training(make_record, tmp_path):
    record = _with(
        make_record(), "net.simclr", objective="simclr", augmentation="physical + 75% masking", top1=0.41, top5=0.72,
        accuracy_interval=Interval(0.38, 0.44, method="Wilson score"), accuracy_data="abc123", twin="net",
        training={"epochs": 20, "published_epochs": 100, "learning_rate": 0.01, "masking": 0.75, "clip": None},
    )  # fmt: skip
    (path,) = (build_leaderboard([record], tmp_path / "site").parent / "models").iterdir()
    text = Page(path).text
    for shown in ("0.410", "[0.380, 0.440]", "0.720", "abc123", "published epochs 100", "learning rate 0.01", "0.75"):
        assert shown in text
    assert "untrained twin net" in text
    assert "clip" not in text
    rows = words.training_rows(replace(record.card, training={**record.card.training, "objective": "simclr"}))
    assert [label for label, _ in rows].count("objective") == 1


def test_numbers_have_true_minus_signs_and_no_negative_zero():
    assert words.number(-0.1234) == "−0.123"
    assert words.number(-0.0001) == "0.000"


def test_layers_show_their_corrected_p_where_the_record_states_it(make_record, tmp_path):
    from leaderboards import write_report

    record = make_record()
    tests = [{"layer": "conv3", "p": 0.01, "p_corrected": 0.0312}, {"layer": 4}, "nonsense"]
    provenance = {**record.score.provenance, "statistics": {"layer_tests": tests}}
    record = replace(record, score=replace(record.score, provenance=provenance))
    text = Page(write_report(record, tmp_path / "r.html")).text
    assert "p, corrected" in text
    assert "0.031" in text


def test_statistics_of_the_provenance_are_rounded_and_what_a_table_shows_is_not_repeated():
    statistics = {
        "monte_carlo_error": {"value": 0.000271728075387, "p": 0},
        "layer_tests": [{"layer": "conv3", "p": 0.01}],
        "bootstrap": {"draws": 1000, "interval": {"low": -0.46965415, "high": 0.8}, "spread": [1 / 3]},
    }
    rows = dict(words.provenance_rows({"statistics": statistics, "settings": {"bin": 0.0123456}}))
    assert rows["statistics: monte carlo error"] == "value: 0.000272, p: 0"
    assert rows["statistics: bootstrap"] == "draws: 1000, interval: low: -0.47, high: 0.8, spread: 0.333"
    assert rows["settings: bin"] == "0.0123456"
    assert "statistics: layer tests" not in rows


def _on(score, values):
    return replace(score, subjects=tuple(SubjectScore(f"m{i}", v, v, 0.9, "ok", 9, 9) for i, v in enumerate(values)))


def test_five_animals_tell_apart_what_overlapping_intervals_do_not(make_record):
    from scipy.stats import ttest_rel

    record = make_record()
    brain, mine = [0.3, 0.4, 0.5, 0.6, 0.7], [0.36, 0.47, 0.55, 0.68, 0.75]
    raw, random = record.baselines["raw input"], record.baselines["random features"]
    record = replace(
        record,
        score=_on(record.score, mine),
        baselines={"raw input": _on(raw, brain), "random features": _on(random, mine[:4])},
    )
    interval = ttest_rel(mine, brain).confidence_interval(0.95)
    above, overlap, *_ = comparisons(record)
    assert above == (
        f"Above raw input (0.223): difference {np.mean(np.subtract(mine, brain)):.3f} "
        f"[{interval.low:.3f}, {interval.high:.3f}], paired over 5 animals."
    )
    assert overlap.startswith("Not told apart from random features (0.487): the intervals overlap")
