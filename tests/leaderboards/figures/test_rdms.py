"""Pictures of RDMs exist where there is a matrix, and say what they show."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from leaderboards.boards import rank
from leaderboards.figures.rdms import MOST_GROUPS, rdm_lines, rdm_panel, rdm_picture
from tests.factories.records import BRAIN_RDM


@pytest.mark.parametrize(
    ("pairs", "labels"), [((), ()), ((), ("a",)), ((0.1, 0.2), ("a", "b", "c")), ((math.nan,), "ab")]
)
def test_there_is_no_picture_without_a_matrix(pairs, labels):
    assert rdm_picture(pairs, labels) is None


def test_undefined_pairs_are_counted_and_a_constant_matrix_is_drawn():
    picture = rdm_picture((0.5, math.nan, 0.5), ("a", "b", "c"))
    assert picture is not None
    assert "from 0.5 to 0.5" in picture.description
    assert "Undefined pairs: 1." in picture.description


def _lines(*records):
    (board,) = rank(records)
    figure = rdm_lines(board)
    return figure, re.findall(r'<path d="M([^"z]+)" class="trace', figure.drawing.render()) if figure.drawing else []


def test_a_flattened_rdm_that_differs_in_scale_alone_lies_on_the_brains(make_record):
    record = make_record("net")
    scaled = tuple(3 * value + 2 for value in BRAIN_RDM)
    alike = replace(record, score=replace(record.score, model_rdm=scaled), baselines={})
    figure, (brain, model) = _lines(alike)
    assert model == brain
    heights = [float(point.split()[1]) for point in brain.split("L")]
    assert heights == sorted(heights, reverse=True)  # upwards, in the order of the brain's dissimilarity
    assert f"{len(BRAIN_RDM)} pairs" in figure.caption
    _, (_, other) = _lines(replace(alike, score=replace(record.score, model_rdm=scaled[::-1])))
    assert other != brain


def test_many_pairs_are_drawn_in_groups_and_undefined_ones_left_out(make_record):
    record = make_record("net")
    labels = tuple(f"s{i}" for i in range(20))
    brain = tuple(float(i) for i in range(190))
    score = replace(
        record.score, stimuli=labels, model_rdm=brain, brain_rdm=(math.nan, *brain[1:]), without_stimulus=()
    )
    figure, (line, _) = _lines(replace(record, score=score, baselines={}))
    assert len(line.split("L")) == MOST_GROUPS
    assert f"189 pairs of stimuli in {MOST_GROUPS} groups" in figure.caption
    empty = replace(score, model_rdm=())
    assert "no record holds" in _lines(replace(record, score=empty, baselines={}))[0].lacking


def test_a_bar_shows_the_range_of_each_matrix(make_record):
    record = make_record()
    size = len(record.score.stimuli)
    pairs = tuple(np.linspace(0.25, 4.0, size * (size - 1) // 2))
    (board,) = rank([replace(record, score=replace(record.score, brain_rdm=pairs, model_rdm=()))])
    drawing = rdm_panel(board).drawing
    assert "0.25" in drawing.render()
    assert ">4<" in drawing.render()
    # The brain's, and that of the raw input, which the record brings.
    assert drawing.render().count('preserveAspectRatio="none"') == 2
