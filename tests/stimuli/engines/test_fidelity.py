"""Presets and the measured table behind them."""

import json
from dataclasses import replace
from importlib import resources

import pytest

from brainbench.core.errors import UsageError
from brainbench.core.files import to_plain
from brainbench.stimuli.engines.fidelity import RESOLUTION, Fidelity, list_presets, measured


def _table():
    return {Fidelity(**point.settings): point for point in measured()}


def test_presets_are_on_record_as_accurate_as_they_promise():
    for name, promise in zip(list_presets(), (0.04, 0.02, 0.008), strict=True):
        assert _table()[Fidelity.preset(name)].error <= promise


TAILS = {
    "fast": (0.037, 0.37, None),
    "balanced": (0.014, 0.15, 0.42),
    "accurate": (0.0075, 0.046, 0.33),
}
"""Errors between objects, on slipping off and on release as the documentation says: median, 90 %, worst.

None: one of them is unstable."""


def test_tails_of_presets_are_on_record_as_the_documentation_says():
    text = resources.files("brainbench.stimuli").joinpath("fidelity_table.json").read_text(encoding="utf-8")
    points = {_setting(point): point for point in json.loads(text)["points"] if not point.get("collision")}
    for preset, tails in TAILS.items():
        point = points["rod", Fidelity.preset(preset)]
        expected = [tail and pytest.approx(tail, rel=0.05) for tail in tails]
        assert [point[f"hard_{name}"] for name in ("50", "90", "worst")] == expected
        assert point["error_50"] < point["hard_50"]


def _setting(point):
    return point["backend"], Fidelity(**{name: point.get(name) for name in RESOLUTION} | {"solver": point["solver"]})


def test_presets_cost_more_as_they_get_more_accurate():
    costs = [_table()[Fidelity.preset(name)].cost for name in list_presets()]
    assert costs == sorted(costs)


def test_auto_takes_the_cheapest_measured_setting_that_is_good_enough():
    for error in (0.1, 0.02, 0.005):
        good = [point for point in measured() if point.error <= error]
        assert _table()[replace(Fidelity.auto(error=error), error=None)].cost == min(point.cost for point in good)


def test_a_smaller_error_costs_more_and_is_promised_to_each_whisker():
    chosen = [Fidelity.auto(error=error) for error in (0.1, 0.02, 0.005)]
    costs = [_table()[replace(fidelity, error=None)].cost for fidelity in chosen]
    assert costs == sorted(set(costs))
    assert [fidelity.error for fidelity in chosen] == [0.1, 0.02, 0.005]


def test_auto_in_a_text_is_auto():
    assert Fidelity.parse("auto=0.1") == Fidelity.auto(error=0.1)
    assert Fidelity.parse("auto=0.1,links=9") == replace(Fidelity.auto(error=0.1), links=9)
    with pytest.raises(UsageError, match="received ''"):
        Fidelity.parse("auto")


def test_auto_refuses_what_was_never_measured():
    with pytest.raises(UsageError, match=r"1e-06; .*time_step"):
        Fidelity.auto(error=1e-6)
    with pytest.raises(UsageError, match=r"error .*received 0"):
        Fidelity.auto(error=0)
    with pytest.raises(UsageError, match="'mujocco'; did you mean 'mujoco'"):
        Fidelity.auto(backend="mujocco")


def test_links_per_mm_give_long_whiskers_more_links():
    fidelity = Fidelity(links=6, links_per_mm=1.0)
    assert fidelity.link_count(0.003) == 6
    assert fidelity.link_count(0.0205) == 21
    with pytest.raises(UsageError, match="at most 100"):
        Fidelity(links_per_mm=10).link_count(0.05)


def test_stiff_whiskers_get_shorter_steps():
    fidelity = Fidelity(time_step=1e-4, steps_per_period=25)
    assert fidelity.step(100.0) == 1e-4
    assert fidelity.step(1000.0) == pytest.approx(4e-5)
    assert Fidelity(time_step=1e-4).step(1000.0) == 1e-4


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"links": 1}, r"links .*at least 2 and at most 100; received 1"),
        ({"links_per_mm": 0.0}, r"links_per_mm .*received 0"),
        ({"time_step": 0.1}, r"time_step .*received 0\.1"),
        ({"steps_per_period": 1}, r"steps_per_period .*received 1"),
    ],
)
def test_impossible_settings_are_refused(values, message):
    with pytest.raises(UsageError, match=message):
        Fidelity(**values)


def test_an_unknown_preset_suggests_the_nearest():
    with pytest.raises(UsageError, match="did you mean 'balanced'"):
        Fidelity.preset("balance")


def test_a_preset_in_a_text_may_be_changed_value_by_value():
    assert Fidelity.parse("balanced") == Fidelity.preset("balanced")
    changed = Fidelity.parse("fast, links=12, time_step=5e-4, steps_per_period=none, solver=quasistatic")
    assert changed == replace(
        Fidelity.preset("fast"), links=12, time_step=5e-4, steps_per_period=None, solver="quasistatic"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("balancd", "balanced"),
        ("fast,link=3", "'links'"),
        ("fast,links=9,twist=true,links=12", "'links' more than once"),
        ("fast,links=many", r"'links' takes a whole number.*received 'many'"),
        ("fast,time_step=", r"'time_step' takes a number.*received ''"),
        ("fast,solver=static", "quasistatic"),
        ("fast,time_step=1", "time_step .*at most 0.005"),
        ("fast,contact_tolerance=0", "contact_tolerance .*at least 1e-12"),
        ("fast,contact_tolerance=1e-9", "contact_tolerance .*1e-06 in single precision; received 1e-09"),
    ],
)
def test_a_wrong_text_is_answered_in_words(text, message):
    with pytest.raises(UsageError, match=message):
        Fidelity.parse(text)


def test_a_value_that_came_later_leaves_old_hashes_alone():
    assert "solver" not in to_plain(Fidelity())
    assert to_plain(Fidelity(solver="quasistatic"))["solver"] == "quasistatic"
    assert "contact_tolerance" not in to_plain(Fidelity())
    assert to_plain(Fidelity(contact_tolerance=1e-5))["contact_tolerance"] == 1e-5


def test_contacts_may_be_solved_more_strictly_in_double_precision():
    assert Fidelity.parse("balanced,precision=double,contact_tolerance=1e-9").contact_tolerance == 1e-9
    assert Fidelity.parse("auto=0.05,contact_tolerance=none").contact_tolerance is None


def test_twist_is_in_hashes_only_where_it_is_on():
    pinned = to_plain(Fidelity(twist=False))
    assert "twist" not in pinned
    assert to_plain(Fidelity(twist=True)) == {**pinned, "twist": True}


@pytest.mark.parametrize(("text", "twist"), [("true", True), ("False", False), ("none", None)])
def test_twist_is_stated_in_a_text(text, twist):
    assert Fidelity.parse(f"fast,twist={text}").twist is twist


def test_a_twist_that_is_neither_true_nor_false_is_refused():
    with pytest.raises(UsageError, match="received 'maybe'"):
        Fidelity.parse("fast,twist=maybe")


@pytest.mark.parametrize("twist", [True, False])
def test_only_a_fidelity_that_leaves_twist_open_takes_that_of_the_scenes(twist):
    assert Fidelity().resolved(twist).twist is twist
    assert Fidelity(twist=not twist).resolved(twist).twist is not twist
