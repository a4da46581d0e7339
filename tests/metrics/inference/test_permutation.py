"""Permutation tests: exactness, calibration, independence of order."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from brainbench.core.errors import UsageError
from brainbench.metrics import compare, permutation_test
from brainbench.metrics.inference.permutation import label_orders, layer_p, make_test, tail_p
from brainbench.metrics.rdms.comparison import permuted_pairs, square
from tests.factories.animals import make_rdm


def test_all_orders_of_the_stimuli_are_taken_once():
    orders = np.concatenate(list(label_orders(6, 0, step=100)))
    assert [tuple(order) for order in orders] == list(itertools.permutations(range(6)))


def test_permuting_labels_permutes_rows_and_columns():
    rng = np.random.default_rng(0)
    rdm, order = rng.random(10), rng.permutation(5)
    permuted = rdm[permuted_pairs(order[None])[0]]
    np.testing.assert_array_equal(square(permuted), square(rdm)[np.ix_(order, order)])


def test_the_exact_p_equals_counting_by_hand():
    rng = np.random.default_rng(1)
    model, brain = make_rdm(rng, 5), np.stack([make_rdm(rng, 5) for _ in range(3)])
    values = []
    for order in itertools.permutations(range(5)):
        permuted = square(model)[np.ix_(order, order)][np.triu_indices(5, 1)]
        values.append(np.mean([np.corrcoef(permuted, animal)[0, 1] for animal in brain]))
    found = permutation_test(model, brain)
    assert found.exact
    assert found.count == 120
    assert found.observed == pytest.approx(values[0])
    assert found.p == np.mean(np.array(values) >= values[0] - 1e-12)
    np.testing.assert_allclose(np.sort(found.null), np.sort(values), atol=1e-12)
    assert found.method == "one-sided permutation of stimulus labels, all 120 orders"


def test_the_smallest_p_is_reached_by_the_truth():
    model = make_rdm(np.random.default_rng(2))
    found = permutation_test(model, model)
    assert found.p == found.smallest == pytest.approx(0.00139, abs=5e-6)
    assert found.status == "ok"


def test_orders_that_map_an_rdm_onto_itself_tie_with_the_observed_one():
    categories = (np.arange(6) // 3)[:, None] != np.arange(6) // 3
    model = categories[np.triu_indices(6, 1)] * 0.3 + 0.1
    # Two categories of three: 3!·3!·2 of the 720 orders leave the RDM as it is.
    assert permutation_test(model, model).p == pytest.approx(72 / 720)


@pytest.mark.parametrize(("stimuli", "smallest"), [(2, 1.0), (3, 1 / 6)])
def test_fewer_than_four_stimuli_have_no_p_but_state_the_smallest(stimuli, smallest):
    rng = np.random.default_rng(3)
    found = permutation_test(make_rdm(rng, stimuli), make_rdm(rng, stimuli))
    assert np.isnan(found.p)
    assert found.smallest == pytest.approx(smallest)
    assert found.status == "undefined"
    assert found.reason.startswith(f"{stimuli} stimuli allow no p below")


def test_many_stimuli_take_ten_thousand_random_orders_and_count_themselves():
    rng = np.random.default_rng(4)
    model = make_rdm(rng, 9)
    found = permutation_test(model, model)
    assert not found.exact
    assert found.count == 10_001
    assert found.p == pytest.approx(1 / 10_001)
    assert found.method.endswith("10,000 random orders, (b+1)/(n+1)")


def test_random_and_exact_p_agree(monkeypatch):
    rng = np.random.default_rng(5)
    model, brain = make_rdm(rng, 6), make_rdm(rng, 6)
    exact = permutation_test(model, brain).p
    monkeypatch.setattr("brainbench.metrics.inference.permutation.EXACT_STIMULI", 5)
    assert permutation_test(model, brain, seed=7).p == pytest.approx(exact, abs=0.02)


@pytest.mark.parametrize("stimuli", [6, 10])
def test_the_order_of_stimuli_and_animals_is_irrelevant(stimuli):
    rng = np.random.default_rng(6)
    model, brain = make_rdm(rng, stimuli), np.stack([make_rdm(rng, stimuli) for _ in range(4)])
    pairs = permuted_pairs(rng.permutation(stimuli)[None])[0]
    expected = permutation_test(model, brain)
    found = permutation_test(model[pairs], brain[::-1][:, pairs])
    assert found.p == expected.p
    np.testing.assert_allclose(np.sort(found.null), np.sort(expected.null), atol=1e-12)


def test_missing_pairs_and_flat_rdms_have_no_p_and_a_reason():
    rng = np.random.default_rng(7)
    model, brain = make_rdm(rng), make_rdm(rng)
    broken = model.copy()
    broken[0] = np.nan
    assert "missing pairs" in permutation_test(broken, brain).reason
    assert "constant RDM" in permutation_test(np.ones(15), brain).reason
    assert np.isnan(permutation_test(np.ones(15), brain).p)


@pytest.mark.parametrize("method", ["spearman", "tau-b", "whitened-pearson"])
def test_any_comparison_can_be_permuted(method):
    rng = np.random.default_rng(8)
    model, brain = make_rdm(rng, 5), make_rdm(rng, 5)
    orders = np.array(list(itertools.permutations(range(5))))
    values = compare(model[permuted_pairs(orders)], brain, method=method)
    found = permutation_test(model, brain, method=method)
    assert found.p == pytest.approx(np.mean(values >= values[0] - 1e-12))


def _null_p_values(count, seed, animals=4):
    """A model that knows nothing, against animals that share a geometry."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(count):
        shared = rng.normal(size=(6, 10))
        brain = np.stack([make_rdm(rng) + square_free(shared, rng) for _ in range(animals)])
        result.append(permutation_test(make_rdm(rng), brain).p)
    return np.array(result)


def square_free(shared, rng):
    """Distances of a noisy copy of shared patterns."""
    noisy = shared + 0.5 * rng.normal(size=shared.shape)
    return np.array([np.mean((noisy[i] - noisy[j]) ** 2) for i, j in itertools.combinations(range(len(noisy)), 2)])


def test_p_values_of_unrelated_models_are_uniform():
    p = _null_p_values(300, seed=10)
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert 0.02 <= (p <= 0.05).mean() <= 0.09


@pytest.mark.slow
def test_p_values_of_unrelated_models_are_calibrated_in_two_thousand_simulations():
    p = _null_p_values(2000, seed=11)
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert 0.04 <= (p <= 0.05).mean() <= 0.06


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="one model RDM"):
        permutation_test(np.ones((2, 15)), np.ones(15))
    with pytest.raises(UsageError, match="of the same stimuli"):
        permutation_test(np.ones(15), np.ones(6))


def test_orders_without_a_value_do_not_make_p_smaller():
    null = np.array([1.0, 2.0, 0.0, 0.0, -np.inf, np.nan, -np.inf, np.nan])
    assert tail_p(null) == 0.5
    assert tail_p(np.stack([null, np.arange(8.0)], axis=1)).tolist() == [0.5, 1.0]
    assert make_test(null, exact=True).p == 0.5


def test_orders_without_a_value_take_no_part_in_the_largest_layer_or_in_the_words():
    null = np.array([[0.5, 0.1], [0.6, np.nan], [0.1, 0.2], [0.7, np.nan]])
    assert layer_p(null)[1].tolist() == [0.75, 1.0]
    test = make_test(np.array([0.4, -np.inf, 0.2]), exact=True)
    assert "0.30" in test.summary(1)


@pytest.mark.parametrize("seed", [-1, 1.5, np.nan, "1"])
def test_a_seed_is_whole_also_where_all_orders_are_taken(seed) -> None:
    with pytest.raises(UsageError, match=f"seed .*{seed}"):
        permutation_test(np.arange(6.0), np.arange(6.0), seed=seed)
