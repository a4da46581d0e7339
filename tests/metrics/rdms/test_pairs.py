"""RDMs that show themselves."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics import RDM, compare, rdm


def _draw(shown):
    return ElementTree.fromstring(shown._repr_html_())


def test_a_named_rdm_stands_for_its_values():
    values = rdm(np.random.default_rng(0).normal(size=(4, 9)))
    named = RDM(values, ["a", "b", "c", "d"], title="x")
    assert compare(named, values) == pytest.approx(1.0)
    np.testing.assert_array_equal(np.asarray(named), values)
    assert named.between("b", "d") == named.between("d", "b") == values[4]
    assert named.matrix.shape == (4, 4)
    assert len(named) == 6


def test_the_table_has_a_cell_with_its_value_for_every_pair():
    named = RDM([0.0, 0.25, 1.0], ["near", "medium", "far"], title="of <touch>")
    root = _draw(named)
    colours = {cell.get("title"): cell.get("style") for cell in root.iter("td") if cell.get("title")}
    assert len(colours) == 6
    assert "near – far: 0.25" in colours
    assert [cell.text for cell in root.iter("td") if cell.get("title")] == ["0", "0.25", "0", "1", "0.25", "1"]
    assert "rgb(240,246,245)" in colours["near – medium: 0"]
    assert "rgb(14,77,84)" in colours["medium – far: 1"]
    assert [head.text for head in root.iter("th") if head.text] == ["near", "medium", "far"] * 2
    assert root.find("caption").text == "of <touch> of 3 stimuli, from 0 to 1"


def test_missing_pairs_and_equal_pairs_can_be_drawn():
    missing = _draw(RDM([np.nan, 1.0, 2.0])).find("tr/td[@title='0 – 1: nan']")
    assert "rgb(214,208,196)" in missing.get("style")
    assert _draw(RDM([2.0, 2.0, 2.0])) is not None
    assert _draw(RDM([np.nan] * 3)) is not None


def test_many_stimuli_are_drawn_without_names_and_very_many_are_told():
    forty = _draw(RDM(np.arange(780.0)))
    assert len(list(forty.iter("td"))) == 1600
    assert not [shown.text for shown in (*forty.iter("th"), *forty.iter("td")) if shown.text]
    assert RDM(np.ones(499_500))._repr_html_() == "<p>RDM: 1000 stimuli, 499,500 pairs</p>"


def test_what_is_no_rdm_is_refused():
    with pytest.raises(UsageError, match="3 stimuli; received 2 names"):
        RDM([1, 2, 3], ["a", "b"])
    with pytest.raises(UsageError, match=r"received shape \(2, 3\)"):
        RDM(np.ones((2, 3)))
    with pytest.raises(UsageError, match="stimulus of this RDM 'z'"):
        RDM([1, 2, 3]).between("0", "z")


def test_stimuli_of_one_name_cannot_be_told_apart() -> None:
    with pytest.raises(UsageError, match="'near' more than once"):
        RDM([1.0, 2.0, 3.0], ["near", "near", "far"])
