import numpy as np

from brainbench.scoring.neural_responses import without_time


def test_the_time_rule_averages_only_what_was_recorded():
    responses = np.array([[[1.0, np.nan], [3.0, np.nan]], [[np.nan, 4.0], [5.0, 8.0]]])
    np.testing.assert_array_equal(without_time(responses, "mean"), [[2.0, np.nan], [5.0, 6.0]])
    assert without_time(responses, "concatenate").shape == (2, 4)
