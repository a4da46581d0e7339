"""The drawing of a score over time."""

from __future__ import annotations

from leaderboards.figures.record import draw_time_course


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
