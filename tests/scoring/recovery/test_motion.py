"""Motions that tell two networks apart: the objective, its gradient, and what is said of them on other objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.core.records import Interval
from brainbench.datasets.synthetic import PopulationDesign
from brainbench.metrics import compare, rdm
from brainbench.scoring.recovery import RecoveryDesign, design_for_networks
from brainbench.scoring.recovery.motion import _Evaluator, _judge, _Network
from brainbench.stimuli import PlacedObject, Scene, WhiskerArray, Whisking, simulate, to_grid
from brainbench.stimuli.fitting.design import DesignOptions
from brainbench.stimuli.objects.solid import cylinder
from brainbench.stimuli.scenes.scene import Frames

pytest.importorskip("warp")

NAMES = ("zhuang-small.simclr", "resnet18-small.supervised")
QUICK = DesignOptions(fidelity="fast", check="fast", iterations=2, starts=2, searches=1)
FEW = RecoveryDesign(PopulationDesign(animals=4, units=30))


def _scenes(count=8, whiskers="C2", **frames):
    array = WhiskerArray.of("mouse", whiskers=whiskers)
    read = Frames(**{"first": 0.051, "interval": 3e-3, "count": 60, **frames})
    return [
        Scene(f"r{r}", array, (PlacedObject(cylinder(1e-4 * r, 0.02), position=(0.0105, 0.002, 0.003)),),
              Whisking(frequency=20), frames=read)
        for r in range(2, 2 + count)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def networks():
    return [_Network.of(name, "any") for name in NAMES]


def test_the_contrast_is_what_a_recovery_compares(networks):
    evaluator = _Evaluator(_scenes(5), ("protraction",), networks, "fast", "rod")
    values = np.array([0.5])
    one, other = (rdm(some, method="sqeuclidean") for some in evaluator.features(values))
    assert evaluator.contrast(values) == pytest.approx(1 - compare(one, other, method="whitened-cosine"), rel=1e-6)


def test_the_input_that_is_differentiated_is_that_of_simulated_stimuli(networks):
    scenes = _scenes(4, whiskers="C1,D2", average=3)
    evaluator = _Evaluator(scenes, ("protraction",), networks, "fast", "rod")
    dataset = simulate(scenes, fidelity=evaluator.fidelity, cache=False)
    jobs = evaluator._jobs(np.array([scenes[0].whisking.protraction]))
    traces = evaluator.engine.run(jobs, evaluator.fidelity)
    wrench = torch.tensor(np.stack([trace.wrench for trace in traces]))
    expected = to_grid(dataset)
    np.testing.assert_allclose(evaluator._input(wrench).numpy(), expected, atol=1e-6 * np.abs(expected).max())


def test_the_slope_is_that_of_small_differences():
    precise = [_Network.of(name, "any") for name in NAMES]
    for network in precise:
        network.model.module.double()
    evaluator = _Evaluator(_scenes(5), ("protraction", "object_y"), precise, "balanced", "rod")
    evaluator.fidelity = replace(evaluator.fidelity, precision="double")
    values, scales = np.array([0.5, 0.0]), np.array([0.05, 1e-4])
    _, slope = evaluator.slope(values, scales)
    # Whiskers stick and slip, so that differences must be small; in single precision these would be rounding alone.
    for index, change in ((0, 1e-7), (1, 1e-9)):
        ends = [evaluator.slope(values + sign * change * np.eye(2)[index], scales)[0] for sign in (1, -1)]
        assert slope[index] == pytest.approx((ends[0] - ends[1]) / (2 * change), rel=1e-3)


def test_the_worth_of_a_slope_is_that_of_simulated_stimuli(networks):
    evaluator = _Evaluator(_scenes(5), ("protraction", "object_y"), networks, "balanced", "rod")
    values = np.array([0.5, 0.0])
    worth, _ = evaluator.slope(values, np.array([0.05, 1e-4]))
    assert worth == pytest.approx(evaluator.worths([values])[0], rel=0.1)


@pytest.mark.slow
def test_a_chosen_motion_is_compared_with_the_given_one_on_other_objects():
    found = design_for_networks(_scenes(), NAMES, ["object_y"], options=QUICK, study=FEW, boards=3)
    assert found.search == "gradient"
    assert found.layers == dict.fromkeys(NAMES, "decoder")
    assert found.contrast[1] >= found.contrast[0] > 0
    assert -0.003 <= found.values["object_y"] <= 0.003
    assert (found.status == "ok") == (found.gain.low > 0)
    assert found.leads[1] - found.leads[0] == pytest.approx((found.gain.low + found.gain.high) / 2)
    moved = found.scenes[0].objects[0].position[1]
    assert moved == pytest.approx(0.002 + found.values["object_y"])
    again = design_for_networks(_scenes(), NAMES, ["object_y"], options=QUICK, study=FEW, boards=3)
    assert again.values == found.values
    assert again.gain == found.gain


class _Plain(torch.nn.Module):
    """Reads the sum of each channel over the grid: no named layers, so that hooks read it."""

    def __init__(self, power):
        super().__init__()
        self.power = power
        self.scale = torch.nn.Parameter(torch.ones(()))

    def forward(self, x):
        return self.scale * x.sum(dim=(3, 4)) ** self.power


class _Other(_Plain):
    pass


def test_networks_without_gradients_are_told_apart_by_trials():
    study = replace(FEW, layer="output")
    found = design_for_networks(_scenes(), [_Plain(1), _Other(2)], ["object_y"], options=QUICK, study=study, boards=3)
    assert found.search == "trials"
    assert found.contrast[1] >= found.contrast[0]


@pytest.mark.parametrize(
    ("gain", "same", "status", "words"),
    [
        (Interval(0.01, 0.2, 0.95, "t"), False, "ok", ""),
        (Interval(-0.01, 0.2, 0.95, "t"), False, "unreliable", "other objects and animals"),
        (Interval(0.0, 0.0, 0.95, "t"), True, "unreliable", "no motion was better"),
        (None, False, "undefined", "alike to all held-out objects"),
    ],
)
def test_nothing_gained_is_said(gain, same, status, words):
    found = _judge(gain, same)
    assert found[0] == status
    assert words in found[1]


def test_wrong_requests_are_refused():
    with pytest.raises(UsageError, match="at least 8"):
        design_for_networks(_scenes(7), NAMES, ["object_y"])
    with pytest.raises(UsageError, match="two networks apart; received 1"):
        design_for_networks(_scenes(), NAMES[:1], ["object_y"])
    with pytest.raises(UsageError, match="given twice"):
        design_for_networks(_scenes(), [NAMES[0]] * 2, ["object_y"])
    with pytest.raises(UsageError, match="did you mean 'object_y'"):
        design_for_networks(_scenes(), NAMES, ["objekt_y"])
    with pytest.raises(UsageError, match="cannot be run on other motions"):
        design_for_networks(_scenes(), [{"layer": np.zeros((8, 3))}, NAMES[0]], ["object_y"])
