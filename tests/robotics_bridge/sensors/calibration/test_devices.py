"""A device that a ball presses is recovered, and what is wrong with it is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError
from robotics_bridge.sensors.calibration.devices import fit_device
from robotics_bridge.sensors.calibration.presses import Presses
from robotics_bridge.sensors.noise.model import Noise
from tests.factories.pressed_devices import FAULTS, KINDS, outcomes, plant, tilts


def test_a_device_is_recovered_within_its_intervals_and_not_accused(tmp_path) -> None:
    planted = plant(0, shape=(2, 2), touches=12)
    fit = fit_device(planted.presses)
    assert fit.held_out < 0.05
    assert tilts(planted, fit).max() < 2
    assert np.mean([np.mean(values) for values in outcomes(planted, fit).values()]) > 0.8
    assert not fit.faults
    assert fit.status == "ok"
    fit.save(tmp_path / "device.json", "pad")
    assert Noise.load(tmp_path / "device.json") == fit.noise
    draws = fit.draws(40)
    spread = np.std([np.log(draw.law()["stiffness"]) for draw in draws])
    assert spread == pytest.approx(np.sqrt(fit.spread[0, 0]), rel=0.4)
    assert draws[0].law() == fit.draws(1)[0].law()


@pytest.mark.parametrize(
    ("seed", "kind"),
    [
        (20_000, "1 × 1"),
        (91, "3 × 3 taxels"),
        pytest.param(43, "3 × 3 taxels", marks=pytest.mark.slow),
        pytest.param(20_000, "ball of 3 mm", marks=pytest.mark.slow),
    ],
)
def test_a_fit_finds_its_way_out_of_a_wrong_place(seed: int, kind: str) -> None:
    # From one start these end with reversed axes, at an edge of the touches, or with intervals of a false slope.
    planted = plant(seed, **KINDS[kind])
    fit = fit_device(planted.presses)
    assert fit.held_out < 0.05
    assert tilts(planted, fit).max() < 2
    assert not fit.faults
    error = np.array([row["place"] - planted.device.place[n] for n, row in enumerate(fit.taxels)])
    assert np.abs(error / [row["place_error"] for row in fit.taxels]).max() < 2.5


def test_a_fit_that_cannot_be_trusted_is_uncertain_and_says_which_presses_decide() -> None:
    planted = plant(0, shape=(2, 2), touches=12)
    probes = planted.presses.probes
    far = np.array(probes.position)
    far[3] += [0.05, 0, 0]
    fit = fit_device(Presses(planted.presses.log, replace(probes, position=far, pitch=None), planted.presses.radius))
    assert fit.status == "uncertain"
    assert any("Never touched, and left where they should be: '3'; press there" in doubt for doubt in fit.doubts)
    log = planted.presses.log
    rows = np.arange(len(log.time)) > 0.85 * len(log.time)
    other = np.where(rows[:, None], 1.6 * log.readings, log.readings)
    fit = fit_device(Presses(replace(log, readings=other), probes, planted.presses.radius))
    assert fit.status == "uncertain"
    assert any("held out the law errs by" in doubt for doubt in fit.doubts)


@pytest.mark.parametrize("fault", ["axes", *(pytest.param(fault, marks=pytest.mark.slow) for fault in FAULTS)])
def test_a_planted_fault_is_named(fault: str) -> None:
    assert fault in {entry.kind for entry in fit_device(plant(10_001, fault, shape=(2, 2), touches=12).presses).faults}


@pytest.mark.parametrize(
    ("axes", "text"), [(3, "give -x, -y, -z where x, y, z belong"), (1, "fall where the ball presses")]
)
def test_a_device_that_reads_what_it_does_to_the_ball_is_fitted_and_named(axes: int, text: str) -> None:
    """No taxel is worse than the others, and the law was bent to fit them: it erred by 40 % without a fault."""
    presses = plant(3, shape=(2, 2), touches=12, axes=axes).presses
    log = replace(presses.log, readings=-presses.log.readings)
    fit = fit_device(Presses(log, presses.probes, presses.radius))
    assert fit.held_out < 0.05
    assert [(fault.kind, fault.taxel, fault.text) for fault in fit.faults] == [("axes", "", f"all taxels {text}")]


@pytest.mark.parametrize(
    ("kind", "order"),
    [
        ({"shape": (2, 2), "touches": 12}, [1, 0, 2, 3]),
        ({"shape": (2, 2), "touches": 12, "axes": 1}, [1, 2, 3, 0]),
        ({"shape": (3, 3)}, [8, 7, 6, 5, 4, 3, 2, 1, 0]),
        ({"shape": (3, 3)}, [0, 3, 6, 1, 4, 7, 2, 5, 8]),
    ],
)
def test_columns_in_another_order_than_the_taxels_are_named_and_put_right(kind, order) -> None:
    """Near taxels were said to be shifted, and far ones left the fit uncertain without a word of their order."""
    presses = plant(0, **kind).presses
    log, count = presses.log, len(order)
    parts = log.readings.reshape(len(log.time), count, -1)
    mixed = Presses(replace(log, readings=parts[:, order].reshape(len(log.time), -1)), presses.probes, presses.radius)
    fit, right = fit_device(mixed), fit_device(presses)
    assert [fault.kind for fault in right.faults] == []
    (fault,) = fit.faults
    assert fault.kind == "order"
    column = order.index(0)  # of the first taxel
    assert column == 0 or f"that of {column} reads what 0 should" in fault.text
    assert (fit.status, fit.held_out, fit.law()) == (right.status, right.held_out, right.law())


def test_a_dead_column_among_exchanged_ones_is_still_named() -> None:
    presses = plant(0, shape=(2, 2), touches=12).presses
    parts = presses.log.readings.reshape(len(presses.log.time), 4, -1)[:, [1, 0, 2, 3]].copy()
    parts[:, 0] = 0.5
    log = replace(presses.log, readings=parts.reshape(len(parts), -1))
    fit = fit_device(Presses(log, presses.probes, presses.radius))
    assert [(fault.kind, fault.taxel) for fault in fit.faults] == [("order", ""), ("dead", "1")]


def test_a_device_of_one_channel_is_recovered() -> None:
    planted = plant(3, shape=(2, 2), touches=12, axes=1)
    fit = fit_device(planted.presses)
    assert fit.held_out < 0.05
    assert not fit.faults


def test_stuck_taxels_and_too_few_presses_are_told() -> None:
    presses = plant(0, shape=(2, 2), touches=6).presses
    few = np.arange(len(presses.log.time)) < 100
    log = presses.log
    with pytest.raises(DataError, match=r"holds \d touches of the ball; a fit of a device needs 5"):
        fit_device(Presses(replace(log, time=log.time[few], readings=log.readings[few], ball=presses.ball[few]),
                           presses.probes, presses.radius))  # fmt: skip
    with pytest.raises(DataError, match="stuck at one value"):
        fit_device(Presses(replace(log, readings=0 * log.readings), presses.probes, presses.radius))
