"""Pages say how to get a model and how it was trained."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

from brainbench.core.records import Interval
from leaderboards import build_leaderboard, write_report
from leaderboards import text as words


def test_the_limit_of_a_p_value_is_the_stimuli_or_the_permutations(make_score):
    assert "6 stimuli" in words.p_sentence(make_score(p=1 / 720))
    forty = make_score(p=0.0005, p_smallest=0.0005, stimuli=tuple(map(str, range(40))), model_rdm=(), brain_rdm=())
    assert "stimuli" not in words.p_sentence(replace(forty, p_method=""))
    assert "number of permutations" in words.p_sentence(forty)
    assert "0.0014" in words.p_sentence(make_score(p=0.02))


def _text(page: Path) -> str:
    """Return what a page says, without its tags, styles and scripts."""
    source = re.sub(r"<(style|script)\b.*?</\1>|<[^>]*>", " ", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    return " ".join(html.unescape(source).split())


def _with(record, name="net", **changes):
    card = replace(record.card, **changes)
    return replace(record, score=replace(record.score, name=name), card=card)


def test_only_commands_of_this_package_stand_on_a_page(make_record, tmp_path):
    """The page says "to make this result again", and its reader copies what stands there into a shell."""
    record = make_record()
    for command, stated in (("curl a.example | sh", False), ("brainbench score a; brainbench score b", True)):
        score = replace(record.score, provenance={**record.score.provenance, "command": command})
        page = write_report(replace(record, score=score), tmp_path / "report.html").read_text(encoding="utf-8")
        assert ("make this result again" in page) is stated
        assert (f"<code>{command}</code>" in page) is stated


def test_every_repeatable_model_says_how_to_get_it(make_record):
    import torch

    from brainbench import load_model

    twin = _with(make_record(), "s4-small", objective="untrained", seed=3, family="s4")
    command, python = words.ways_to_get(twin)
    assert command == "brainbench score s4-small --weights-seed 3"
    made = eval(python, {"brainbench": __import__("brainbench")})
    for one, other in zip(made.parameters(), load_model("s4-small", seed=3).parameters(), strict=True):
        assert torch.equal(one, other)
    trained = _with(make_record(), "s4-small.simclr", objective="simclr", family="s4", seed=1)
    assert words.ways_to_get(trained) == [
        "brainbench score s4-small.simclr",
        'brainbench.load_model("s4-small.simclr")',
    ]
    for family in ("user module", "features computed elsewhere", "policy"):
        assert words.ways_to_get(_with(make_record(), family=family)) == []
    assert words.ways_to_get(_with(make_record(), "local-dir:mine.simclr")) == []


def test_a_trained_models_page_shows_accuracy_and_training(make_record, tmp_path):
    record = _with(
        make_record(), "net.simclr", objective="simclr", augmentation="physical + 75% masking", top1=0.41, top5=0.72,
        accuracy_interval=Interval(0.38, 0.44, method="Wilson score"), accuracy_data="abc123", twin="net",
        training={"epochs": 20, "published_epochs": 100, "learning_rate": 0.01, "masking": 0.75, "clip": None},
    )  # fmt: skip
    (path,) = (build_leaderboard([record], tmp_path / "site").parent / "models").iterdir()
    text = _text(path)
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
    text = _text(write_report(record, tmp_path / "r.html"))
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


def test_the_unique_part_is_one_sentence_or_the_reason_for_none(make_score):
    assert words.unique_sentence(make_score()) == ""
    stated = {"status": "ok", "unique": 0.75, "interval": [0.62, 0.88], "shared": 0.02, "controls": ["raw input"]}

    def said(**changes):
        return words.unique_sentence(make_score(provenance={"statistics": {"unique": stated | changes}}))

    assert said() == (
        "Unique part 0.75 [0.62, 0.88], beyond raw input; shared with them 0.02 (0 = equal distances, 1 = all that is "
        "reliable)."
    )
    ridge = make_score(metric="ridge: share of variance", provenance={"statistics": {"unique": stated}})
    assert "(0 = the mean response, 1 = all that is reliable)" in words.unique_sentence(ridge)
    assert said(status="unreliable", reasons=["the score is not ok"]).endswith("; unreliable: the score is not ok.")
    assert said(status="undefined", reasons=["few stimuli"]) == "No unique part: few stimuli."
    assert said(unique="much") == "No unique part: no number is stated."
    assert "\x1b" not in said(controls=["\x1b[31mred"])
