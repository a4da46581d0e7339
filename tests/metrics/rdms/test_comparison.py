"""Comparisons against scipy and rsatoolbox."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from brainbench.core.errors import UsageError
from brainbench.metrics import RDM, compare, rdm
from brainbench.metrics.rdms import comparison
from brainbench.metrics.rdms.comparison import (
    COMPARISONS,
    compare_all,
    permuted_comparisons,
    permuted_pairs,
    products,
    products_without,
)
from tests.factories.animals import THEIRS


def _make_rdms(count, stimuli=6, seed=0, ties=False):
    rng = np.random.default_rng(seed)
    rdms = rng.gamma(3.0, 1.0, size=(count, stimuli * (stimuli - 1) // 2))
    return np.round(rdms) if ties else rdms


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("stimuli", [4, 6, 18])
@pytest.mark.parametrize("method", COMPARISONS)
def test_comparisons_equal_rsatoolbox(method, stimuli, ties):
    rsa = pytest.importorskip("rsatoolbox.rdm")
    a, b = _make_rdms(3, stimuli, 1, ties), _make_rdms(4, stimuli, 2, ties)
    expected = rsa.compare(rsa.RDMs(a), rsa.RDMs(b), method=THEIRS[method])
    np.testing.assert_allclose(compare(a[:, None], b[None], method=method), expected, atol=1e-10)
    np.testing.assert_allclose(compare_all(a, b, method=method), expected, atol=1e-10)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("method", COMPARISONS)
def test_pairs_missing_in_both_are_left_out_as_in_rsatoolbox(method):
    rsa = pytest.importorskip("rsatoolbox.rdm")
    a, b = _make_rdms(1, 6, 1), _make_rdms(1, 6, 2)
    a[:, [2, 7]] = b[:, [2, 7]] = np.nan
    expected = rsa.compare(rsa.RDMs(a), rsa.RDMs(b), method=THEIRS[method])[0, 0]
    # rsatoolbox' closed form for whitening is exact for complete RDMs only; ours inverts the covariance.
    if method.startswith("whitened"):
        expected = rsa.compare(rsa.RDMs(a), rsa.RDMs(b), method=THEIRS[method], sigma_k=np.eye(6))[0, 0]
    np.testing.assert_allclose(
        compare(a[0], b[0], method=method), expected, atol=2e-6 if "whitened" in method else 1e-10
    )


@pytest.mark.parametrize(
    ("method", "reference"),
    [("pearson", stats.pearsonr), ("spearman", stats.spearmanr), ("tau-b", stats.kendalltau)],
)
def test_a_pair_missing_on_one_side_is_left_out(method, reference):
    a, b = _make_rdms(1, 6, 3)[0], _make_rdms(2, 6, 4)
    b[1, 3] = np.nan
    keep = np.arange(15) != 3
    expected = [reference(a, b[0])[0], reference(a[keep], b[1][keep])[0]]
    np.testing.assert_allclose(compare(a, b, method=method), expected, atol=1e-12)


def test_layers_permutations_and_animals_broadcast():
    layers, orders, animals = _make_rdms(3, 6, 5), _make_rdms(4, 6, 6), _make_rdms(5, 6, 7)
    result = compare((layers[:, None] + orders)[:, :, None], animals)
    assert result.shape == (3, 4, 5)
    np.testing.assert_allclose(result[2, 1, 4], stats.pearsonr(layers[2] + orders[1], animals[4])[0], atol=1e-13)


@pytest.mark.parametrize("method", COMPARISONS)
def test_an_rdm_without_differences_has_no_direction(method):
    flat = np.full(15, 0.1) * (1 + 1e-16)
    result = float(compare(flat, _make_rdms(1)[0], method=method))
    if method in ("rho-a", "tau-a"):
        assert result == 0
    elif "cosine" in method:
        assert np.isfinite(result)
        assert np.isnan(compare(np.zeros(15), _make_rdms(1)[0], method=method))
    else:
        assert np.isnan(result)


def test_small_differences_on_a_large_offset_are_not_called_constant():
    a, b = 1e8 + 1e-3 * _make_rdms(1, 6, 1)[0], _make_rdms(1, 6, 2)[0]
    np.testing.assert_allclose(compare(a, b), stats.pearsonr(a - 1e8, b)[0], atol=1e-6)


def test_comparisons_without_any_common_pair_are_nan():
    a, b = np.full(15, np.nan), _make_rdms(1)[0]
    assert np.isnan(compare(a, b))
    assert np.isnan(compare([1.0], [2.0])), "two stimuli have one pair"


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.sampled_from(COMPARISONS), st.integers(3, 8))
def test_permuting_the_stimuli_of_both_changes_nothing_and_arguments_commute(seed, method, stimuli):
    rng = np.random.default_rng(seed)
    a, b = rng.gamma(2.0, size=(2, stimuli * (stimuli - 1) // 2))
    pairs = permuted_pairs(rng.permutation(stimuli)[None])[0]
    expected = compare(a, b, method=method)
    np.testing.assert_allclose(compare(a[pairs], b[pairs], method=method), expected, atol=1e-12)
    np.testing.assert_allclose(compare(b, a, method=method), expected, atol=1e-12)
    assert abs(float(expected)) <= 1 + 1e-12


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="did you mean 'pearson'"):
        compare(np.ones(3), np.ones(3), method="pearsson")
    with pytest.raises(UsageError, match="RDMs of 3 and 4 stimuli"):
        compare(np.ones(3), np.ones(6))
    with pytest.raises(UsageError, match=r"K\(K−1\)/2 entries"):
        compare(np.ones(5), np.ones(5))
    with pytest.raises(UsageError, match="do not broadcast"):
        compare(np.ones((2, 3)), np.ones((4, 3)))
    with pytest.raises(UsageError, match="must be RDM vectors"):
        compare([[1, 2, 3], [1, 2]], np.ones(3))


@pytest.mark.parametrize("wrong", [[1, 2, np.inf], [1, -np.inf, 2], [1e200, 2, 3], [1, 2j, 3], ["1", "2", "3"]])
def test_what_is_no_dissimilarity_is_not_taken_for_a_missing_one(wrong) -> None:
    assert compare([1, 2, np.nan], [1, 2, 4]) == pytest.approx(1.0)
    with pytest.raises(UsageError, match="a must"):
        compare(wrong, [1, 2, 4])


@pytest.mark.parametrize("method", ["cosine", "whitened-cosine"])
def test_products_without_a_stimulus_follow_from_those_of_all(method):
    rng, count = np.random.default_rng(3), 7
    left, right = rng.normal(size=(2, 21)) ** 2, rng.normal(size=(3, 21))
    found = products_without(left, right, method)
    for stimulus in range(count):
        pairs = permuted_pairs(np.delete(np.arange(count), stimulus)[None], count)[0]
        expected = products(left[:, None, pairs], right[None, :, pairs], method)
        np.testing.assert_allclose(found[..., stimulus], expected, atol=1e-12)


@pytest.mark.parametrize("method", ["pearson", "spearman", "cosine", "whitened-cosine", "whitened-pearson"])
@pytest.mark.parametrize(("layers", "block"), [(2, 1 << 24), (5, 1 << 24), (5, 2 * 81)])
def test_many_stimuli_in_blocks_give_what_few_give_at_once(method, layers, block, monkeypatch):
    rng = np.random.default_rng(0)
    sides = _make_rdms(layers, 9, 1), _make_rdms(3, 9, 2)
    chunks = [rng.permuted(np.tile(np.arange(9), (4, 1)), axis=1) for _ in range(2)]
    expected = list(permuted_comparisons(*sides, iter(chunks), method))
    without = [products_without(*sides, name) for name in ("cosine", "whitened-cosine")]
    monkeypatch.setattr(comparison, "_FEW_STIMULI", 1)
    monkeypatch.setattr(comparison, "_BLOCK_ELEMENTS", block)
    np.testing.assert_allclose(list(permuted_comparisons(*sides, iter(chunks), method)), expected, atol=1e-12)
    for name, values in zip(("cosine", "whitened-cosine"), without, strict=True):
        np.testing.assert_allclose(products_without(*sides, name), values, rtol=1e-10)


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
