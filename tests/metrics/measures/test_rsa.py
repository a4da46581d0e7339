import numpy as np
import pytest

from brainbench.core.contracts import Trials
from brainbench.core.errors import UsageError
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from tests.factories.candidates import DESIGN, make_candidates


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
