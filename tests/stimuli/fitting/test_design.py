"""Designs tell objects apart in fewer whisks, and say when they cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli import PlacedObject, Scene, WhiskerArray, Whisking
from brainbench.stimuli.fitting.design import DesignOptions, _Evaluator, _soft_least, design
from brainbench.stimuli.objects.solid import cylinder

QUICK = DesignOptions(iterations=2, starts=2, check="fast")


def _scenes(*radii, place=(0.0105, 0.002, 0.003), frequency=20.0):
    array = WhiskerArray.of("mouse", whiskers="C2")
    return [
        Scene(
            f"r{radius}", array, (PlacedObject(cylinder(radius, 0.02), position=place),), Whisking(frequency=frequency)
        )
        for radius in radii
    ]


def test_a_chosen_motion_needs_fewer_whisks():
    found = design(_scenes(3e-4, 6e-4), ["protraction", "retraction"], options=QUICK)
    (before, after), *_ = found.distances.values()
    assert found.status == "ok"
    assert found.whisks == pytest.approx(before / after)
    assert found.whisks == pytest.approx(found.time)
    assert found.whisks < 0.8
    assert found.scenes[0].whisking.protraction == found.values["protraction"]


@pytest.mark.slow
def test_distances_are_those_of_the_wrenches_over_the_noise():
    options = replace(QUICK, iterations=1, starts=1)
    one, other = (design(_scenes(3e-4, 6e-4), ["object_x"], options=replace(options, force_noise=f, moment_noise=m))
                  for f, m in ((2e-6, 1e-8), (4e-6, 2e-8)))  # fmt: skip
    np.testing.assert_allclose(next(iter(one.distances.values()))[0], 4 * next(iter(other.distances.values()))[0])


def test_the_slope_of_the_search_is_that_of_differences():
    names = ("frequency", "protraction", "object_y")
    evaluator = _Evaluator(_scenes(3e-4, 4.5e-4, 6e-4), names, replace(QUICK, fidelity="balanced"), "rod")
    values, scales = np.array([20.0, 0.5, 0.0]), np.array([1.0, 0.05, 1e-4])
    least, slope = evaluator.slope(values, scales)
    assert least == pytest.approx(_soft_least(evaluator.distances([values])[0])[0], rel=1e-2)
    # The number of readings goes in steps with the frequency, which its difference would not see.
    for index in (1, 2):
        shift = 1e-3 * scales * (np.arange(3) == index)
        ends = [evaluator.slope(values + sign * shift, scales)[0] for sign in (1, -1)]
        assert slope[index] == pytest.approx((ends[0] - ends[1]) / (2 * shift[index]), rel=0.02)


def test_equal_objects_cannot_be_told_apart():
    array = _scenes(3e-4)[0]
    found = design([array, replace(array, label="twin")], ["protraction"], options=QUICK)
    assert found.status == "undefined"
    assert "felt alike" in found.reason


def test_wrong_requests_are_refused():
    with pytest.raises(UsageError, match="at least two scenes"):
        design(_scenes(3e-4), ["protraction"])
    with pytest.raises(UsageError, match="protraction"):
        design(_scenes(3e-4, 6e-4), ["protracton"])
    with pytest.raises(UsageError, match="more than once"):
        design(_scenes(3e-4, 6e-4), ["protraction", "protraction"])
    with pytest.raises(UsageError, match="same whisking"):
        design([*_scenes(3e-4), *_scenes(6e-4, frequency=10.0)], ["protraction"])
    one, other = _scenes(3e-4, 6e-4)
    with pytest.raises(UsageError, match="same whiskers"):
        design([one, replace(other, array=WhiskerArray.of("mouse", whiskers="C1"))], ["protraction"])
    with pytest.raises(UsageError, match="a lower and a higher"):
        design(_scenes(3e-4, 6e-4), ["frequency"], bounds={"frequency": (20.0, 20.0)})
    with pytest.raises(UsageError, match="with bounds 'protraction'"):
        design(_scenes(3e-4, 6e-4), ["frequency"], bounds={"protraction": (0.1, 0.2)})
    with pytest.raises(UsageError, match="outside the bounds"):
        design(_scenes(3e-4, 6e-4), ["frequency"], bounds={"frequency": (4.0, 8.0)})


@pytest.mark.parametrize(
    ("name", "value"),
    [("force_noise", 0.0), ("moment_noise", -1e-9), ("rate", float("nan")), ("iterations", 0), ("starts", -1)],
)
def test_options_out_of_range_are_refused(name: str, value: float):
    with pytest.raises(UsageError, match=name):
        DesignOptions(**{name: value})


def test_fidelities_of_a_design_are_read_at_once():
    with pytest.raises(UsageError, match="did you mean 'accurate'"):
        DesignOptions(check="acurate")
