"""Drawings: scales, ticks and text."""

from __future__ import annotations

import math
from xml.etree import ElementTree

from hypothesis import given
from hypothesis import strategies as st

from leaderboards.figures.svg import STYLE, Drawing, Scale, scale_of


@given(low=st.floats(-3, 2), width=st.floats(0.1, 5), value=st.floats(-10, 10))
def test_scales_keep_order_and_stay_inside(low, width, value):
    scale = Scale(low, low + width, 10, 200)
    assert 10 <= scale.at(value) <= 200
    assert scale.at(low) == 10
    assert all(low - 1e-6 <= tick <= low + width + 1e-6 for tick in scale.ticks)


def test_logarithmic_ticks_are_round():
    assert Scale(2e5, 7e7, 0, 1, log=True).ticks == [1e6, 1e7]
    assert Scale(3e5, 4e6, 0, 1, log=True).ticks == [5e5, 1e6, 2e6]
    assert math.isclose(scale_of([math.nan, 0.4], 0, 1).low, 0.0)


def test_text_in_drawings_is_escaped():
    drawing = Drawing(10, 10, "<a title='x'>")
    drawing.text(0, 0, "</text><script>")
    drawing.rect(0, 0, 1, 1, tip="<b>")
    root = ElementTree.fromstring(drawing.render(style=STYLE))
    assert not [item for item in root.iter() if "script" in item.tag]
