"""The drawings of one model: its score over time, and what stimuli and units add to it."""

from __future__ import annotations

from dataclasses import replace

from leaderboards.figures.record import draw_time_course, stimulus_parts, unit_parts
from tests.factories.records import make_record


def _course(**changes):
    interval = {"low": 0.2, "high": 0.6, "level": 0.95, "method": "t"}
    points = [
        {"time": 0.025, "value": None, "r": 0.1, "chance": None, "p": 0.8, "interval": None},
        {"time": 0.075, "value": 0.4, "r": 0.3, "chance": 0.1, "p": 0.01, "interval": interval},
        {"time": 0.125, "value": 0.5, "r": 0.3, "chance": 0.1, "p": 0.3, "interval": None},
    ]
    layers = [
        {"layer": "conv<1>", "latency": 0.03, "interval": {"low": 0.01, "high": 0.05}},
        {"layer": "silent", "latency": None, "interval": None},
    ]
    return {"time_course": {"points": points, "latencies": layers, "bin": 0.05, "largest_lag": 0.1} | changes}


def test_significant_times_are_filled_and_only_known_latencies_are_drawn():
    text = draw_time_course(_course()).render()
    # .4 lies a third of the way from chance (.1) to 1.
    assert 'class="c1"><title>0.075 s: 0.33, p = 0.01' in text
    assert 'class="c1 open"><title>0.125 s' in text
    assert "conv&lt;1&gt;: 30 ms" in text
    assert "silent" not in text


def test_records_without_a_usable_score_over_time_have_no_drawing():
    assert draw_time_course({}) is None
    assert draw_time_course({"time_course": 3}) is None
    assert draw_time_course(_course(points=[])) is None
    assert draw_time_course(_course(largest_lag="far")) is None


def _units(**changes):
    groups = {"layer": {"L<4>": {"value": 0.6, "interval": [0.5, 0.7], "units": 20, "animals": 2}}}
    return {"units": {"animals": {"m0": [0.5, None, 0.7], "m1": [0.2]}, "groups": groups} | changes}


def test_units_are_drawn_by_animal_and_by_group_and_what_is_no_statistic_is_not():
    text = unit_parts(_units()).render()
    assert "<title>m0: 0.600, 3 units" in text
    assert "L&lt;4&gt;: 0.600, 20 units, 2 animals" in text
    assert "layer L&lt;4&gt;" in text
    for broken in ({}, {"units": 3}, _units(animals=[1]), _units(groups={"layer": 3}), _units(animals={"m": ["x"]})):
        assert unit_parts(broken) is None


def test_stimuli_that_add_most_come_first_and_those_in_between_are_counted():
    names = tuple(f"s{index:02d}" for index in range(30))
    without = tuple(0.5 - 0.01 * (index - 10) for index in range(30))
    score = replace(make_record("net", 0.5).score, stimuli=names, without_stimulus=without, chance=0.0, attainable=1.0)
    text = stimulus_parts(score).render()
    assert text.index("s29: +0.19") < text.index("s18: +0.08") < text.index("s00: -0.10")
    assert "(6 in between not drawn)" in text
    assert stimulus_parts(replace(score, without_stimulus=())) is None
