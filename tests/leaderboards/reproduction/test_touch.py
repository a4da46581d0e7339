"""Claims on touch follow what was planted in the students; every arm of the records is on the page."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from tests.factories.benchmark_programs import benchmark_program

TOUCH = benchmark_program("reproduction.touch")
TYPES = ("bool", "depth")


def _arms(hand: float, tips: float, blind: float = 0.2, noise: float = 0.005) -> dict[str, list[float]]:
    """Success of two students an arm, alike but for their placement."""
    planted = {f"{kind} {place}": value for kind in TYPES for place, value in (("hand", hand), ("tips", tips))}
    planted |= {"none, memory": blind}
    return {"teacher": [0.95]} | {name: [value - noise, value + noise] for name, value in planted.items()}


PLACEMENT = {"rule": "mean", "pairs": [["{} hand", "{} tips"]]}
FELT = {"rule": "least", "pairs": [["{} hand", "none, memory"], ["{} tips", "none, memory"]]}


def test_a_claim_of_likeness_holds_within_its_margin():
    alike = {"rule": "least", "pairs": [["{} hand", "depth hand"], ["depth hand", "{} hand"]], "margin": 0.1}
    for ahead, verdict in ((0.0, "holds"), (0.3, "does not hold")):
        arms = _arms(0.5, 0.5) | {"bool hand": [0.495 + ahead, 0.505 + ahead]}
        assert TOUCH.judge_claim(alike, TYPES, arms, 0.95).verdict == verdict


@pytest.mark.parametrize(
    ("hand", "tips", "verdict"), [(0.8, 0.5, "holds"), (0.5, 0.8, "does not hold"), (0.6, 0.6, "undecided")]
)
def test_a_mean_of_pairs_is_judged_as_planted(hand, tips, verdict):
    judged = TOUCH.judge_claim(PLACEMENT, TYPES, _arms(hand, tips), 0.95)
    assert judged.verdict == verdict
    assert judged.effect.value == pytest.approx(hand - tips, abs=0.02)


def test_of_several_pairs_the_weakest_decides_and_is_named():
    arms = _arms(0.8, 0.8) | {"depth tips": [0.2, 0.21]}
    judged = TOUCH.judge_claim(FELT, TYPES, arms, 0.95)
    assert judged.verdict == "undecided"
    assert judged.weakest == "depth, finger tips less no touch, with memory"
    assert TOUCH.judge_claim(FELT, TYPES, _arms(0.8, 0.8), 0.95).verdict == "holds"


def test_arms_that_were_not_trained_are_left_out():
    arms = _arms(0.8, 0.5)
    assert TOUCH.pairs_of(PLACEMENT, ("depth", "force"), arms) == [["depth hand", "depth tips"]]
    assert TOUCH.judge_claim(PLACEMENT, ("force",), arms, 0.95) is None
    assert TOUCH.pairs_of({**PLACEMENT, "of": ["bool"]}, TYPES, arms) == [["bool hand", "bool tips"]]


def test_intervals_hold_the_truth_as_often_as_they_say():
    draw = np.random.default_rng(1)
    inside = []
    for _ in range(400):
        arms = {
            name: list(0.5 + 0.05 * draw.standard_normal(count))
            for name, count in zip("abcdef", (2, 2, 2, 3, 1, 1), strict=True)
        }
        interval = TOUCH.difference(arms, [["a", "e"], ["b", "f"]], 0.9).interval
        inside.append(interval.low < 0 < interval.high)
    assert 0.86 < np.mean(inside) < 0.94


def test_claims_name_arms_of_the_records_and_say_what_a_test_would_take():
    head, rows = TOUCH.claim_rows()
    assert all(len(row) == len(head) for row in rows)
    verdicts = [row[-1] for row in rows]
    assert all(verdict.split(" ")[0] in {"holds", "does", "undecided", "not", "reached"} for verdict in verdicts)
    assert any(verdict.startswith("not tested, it would take: ") for verdict in verdicts)
    assert TOUCH.stimuli_table().count("\n") == 5


def test_page_and_figure_hold_every_arm_in_words(tmp_path):
    page, figure = TOUCH.write_pages(tmp_path)
    text, words = page.read_text(encoding="utf-8"), "".join(ElementTree.parse(figure).getroot().itertext())
    arms = {row["arm"] for name in (TOUCH.EQUAL, TOUCH.SCREWDRIVER) for row in TOUCH.record_of(name)["students"]}
    assert len(arms) == 29
    for arm in arms:
        assert "_" not in TOUCH.in_words(arm)
        assert f"| {TOUCH.in_words(arm)} |" in text
        assert TOUCH.in_words(arm) in words
