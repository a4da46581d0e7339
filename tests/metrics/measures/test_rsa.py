from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics import rdm
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.measures.rsa import RSA, _products, non_negative, unique_part
from brainbench.metrics.rdms.comparison import LINEAR, permuted_pairs
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from tests.factories.candidates import DESIGN, make_candidates


def _rdm(features: np.ndarray) -> np.ndarray:
    return rdm(features, method="sqeuclidean")


def _study(seed: int, *, hidden: float, network: str, stimuli: int = 16, layers: int = 3, noise: float = 0.3):
    """Layers, the control and animals [6, P] whose geometry is raw input and something hidden, in shares."""
    rng = np.random.default_rng(seed)
    raw, inner = rng.normal(size=(stimuli, 6)), rng.normal(size=(stimuli, 6))
    truth = (1 - hidden) * _rdm(raw) / _rdm(raw).mean() + hidden * _rdm(inner) / _rdm(inner).mean()
    brain = truth + noise * truth.std() * rng.normal(size=(6, truth.size))
    features = {
        "copy": lambda: raw @ np.linalg.qr(rng.normal(size=(6, 6)))[0],
        "mixed": lambda: raw @ rng.normal(size=(6, 40)),
        "hidden": lambda: inner,
        "unrelated": lambda: rng.normal(size=(stimuli, 20)),
    }[network]
    return {f"layer {index}": _rdm(features()) for index in range(layers)}, {"raw input": _rdm(raw)}, brain


def _part(study, comparison: str = "whitened-cosine", **options):
    layers, controls, brain = study
    animals = [SubjectRDM("animal", each, np.empty(0), np.empty((0, 2, len(each)))) for each in brain]
    return unique_part(layers, controls, animals, comparison=comparison, factors=np.ones(len(brain)), **options)


@pytest.mark.parametrize("comparison", list(LINEAR))
def test_a_copy_of_the_raw_input_has_no_unique_part_and_the_hidden_network_nearly_all(comparison):
    part = _part(_study(0, hidden=0.5, network="copy"), comparison)
    assert part.unique == pytest.approx(0, abs=1e-7)
    assert part.controls_alone == pytest.approx(0, abs=1e-7)
    assert part.shared == pytest.approx(part.total, abs=1e-7)
    part = _part(_study(0, hidden=1.0, network="hidden"), comparison)
    assert part.status == "ok"
    assert part.unique > 0.9 * part.total > 0.5
    assert part.low > 0
    assert part.total == pytest.approx(part.unique + part.shared + part.controls_alone)


@pytest.mark.slow
def test_networks_that_add_nothing_are_rarely_found_to_have_a_part_of_their_own():
    kinds = ("mixed", "unrelated")
    low = [_part(_study(seed, hidden=0.5, network=kinds[seed % 2], stimuli=12), splits=4).low for seed in range(24)]
    assert np.count_nonzero(np.array(low) > 0) <= 2


@pytest.mark.slow
def test_the_order_of_the_stimuli_changes_nothing_and_a_seed_repeats_it():
    layers, controls, brain = _study(3, hidden=0.5, network="hidden")
    first = _part((layers, controls, brain))
    assert first == _part((layers, controls, brain))
    moved = permuted_pairs(np.random.default_rng(1).permutation(16)[None])[0]
    parts = [{name: values[moved] for name, values in side.items()} for side in (layers, controls)]
    second = _part((*parts, brain[:, moved]))
    assert second.unique == pytest.approx(first.unique, abs=1e-9)
    assert second.low == pytest.approx(first.low, abs=1e-9)


@pytest.mark.slow
def test_a_committed_layer_is_the_only_one_and_the_layer_is_chosen_where_weights_are_fitted():
    layers, controls, brain = _study(4, hidden=1.0, network="unrelated")
    hidden, *_ = _study(4, hidden=1.0, network="hidden")
    layers["hidden"] = hidden["layer 0"]
    assert _part((layers, controls, brain)).layer == "hidden"
    assert _part((layers, controls, brain), committed="layer 1").layer == "layer 1"


def test_what_cannot_be_split_says_why():
    layers, controls, brain = _study(5, hidden=0.5, network="hidden")
    assert "ranks, which do not add up" in _part((layers, controls, brain), "spearman").reasons[0]
    assert "no control has differences" in _part((layers, {"flat": np.ones(120)}, brain)).reasons[0]
    assert "no layer has a value" in _part(({"lost": np.full(120, np.nan)}, controls, brain)).reasons[0]
    few = _study(5, hidden=0.5, network="hidden", stimuli=9)
    part = _part(few)
    assert (part.status, part.reasons) == (
        "undefined",
        ("9 stimuli are too few to fit some and judge the others; at least 10 are needed",),
    )
    assert part.stated["interval"] is None


@pytest.mark.parametrize("comparison", list(LINEAR))
def test_products_of_a_half_are_those_of_its_rdms_with_and_without_each_stimulus(comparison):
    rng = np.random.default_rng(0)
    rdms = np.stack([np.ones(36), *(_rdm(rng.normal(size=(9, 5))) for _ in range(3))])
    half = np.array([0, 2, 3, 5, 7, 8])
    products = _products(rdms, half, comparison)
    for place in range(-1, len(half)):
        rest = half if place < 0 else np.delete(half, place)
        vectors = LINEAR[comparison](rdms[:, permuted_pairs(rest[None], 9)[0]])
        np.testing.assert_allclose(products[place + 1], vectors @ vectors.T, atol=1e-9)


def test_non_negative_weights_are_those_of_scipy():
    rng = np.random.default_rng(1)
    columns, aims = rng.normal(size=(50, 30, 4)), rng.normal(size=(50, 30))
    weights = non_negative(columns.swapaxes(1, 2) @ columns, np.einsum("nij,ni->nj", columns, aims))
    for matrix, aim, row in zip(columns, aims, weights, strict=True):
        np.testing.assert_allclose(row, nnls(matrix, aim)[0], atol=1e-6)


def test_comparisons_without_a_stimulus_are_those_of_the_other_stimuli():
    from brainbench.scoring.recovery.boards import draw_board

    candidates = make_candidates(8)
    animals = draw_board(candidates, DESIGN, 0, 0)[2]
    metric = RSA()
    layers = [metric.layer(values) for values in candidates[1].features.values()]
    # The general way makes every RDM anew without the stimulus.
    np.testing.assert_allclose(
        metric.compare_without(layers, animals), Metric.compare_without(metric, layers, animals), atol=1e-12
    )


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"comparison": "pearsn"}, "'pearson'"), ({"brain_method": "crosnobis"}, "'crossnobis'"),
        ({"model_method": "sqeuclid"}, "'sqeuclidean'"), ({"noise": "dag"}, "'diag'"), ({"splits": 0}, "splits .*0"),
        ({"splits": float("nan")}, "splits .*nan"),
    ],
)  # fmt: skip
def test_a_comparison_of_rdms_is_checked_when_it_is_made(options, told):
    with pytest.raises(UsageError, match=told):
        RSA(**options)


@pytest.mark.parametrize("comparison", ["whitened-cosine", "pearson"])
def test_agreement_from_products_is_that_of_each_animal_with_the_mean_of_the_others(comparison):
    rng = np.random.default_rng(0)
    metric, rdms = RSA(comparison=comparison), rng.gamma(3.0, size=(4, 15))
    animals = [SubjectRDM(f"m{row}", each, np.empty(0), np.empty((0, 2, 15))) for row, each in enumerate(rdms)]
    orders = rng.permuted(np.tile(np.arange(6), (5, 4, 1)), axis=-1)
    factors = rng.random(4) + 1
    each_by_each = super(RSA, metric).agreement_null(animals, factors, orders)
    np.testing.assert_allclose(metric.agreement_null(animals, factors, orders), each_by_each, atol=1e-12)


def test_more_stimuli_take_fewer_splits():
    def splits(stimuli: int) -> int:
        labels = np.repeat(np.arange(stimuli), 4)
        responses = np.random.default_rng(0).normal(size=(len(labels), 5))
        return len(RSA().animal("m", [Trials(responses, labels)], stimuli).split_half_r)

    assert [splits(count) for count in (40, 80, 640)] == [300, 150, 20]
