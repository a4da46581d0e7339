import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.measures.rsa import RSA
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
