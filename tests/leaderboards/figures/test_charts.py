"""Figures stand where the numbers say, and say what they lack when the records cannot fill them."""

from __future__ import annotations

import doctest
import math
from dataclasses import replace
from itertools import pairwise
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from brainbench.core.records import GraphEdge, GraphNode, Interval, ModelGraph
from leaderboards.boards import rank
from leaderboards.figures import svg
from leaderboards.figures.charts import board_figures, regression
from leaderboards.figures.record import diagram, layers
from leaderboards.figures.svg import Drawing, standalone


def _figures(*records):
    (board,) = rank(records)
    return {figure.key: figure for figure in board_figures(board)}


def _trained(record, objective="supervised", augmentation=None, masking=0.0, top1=0.4, **changes):
    card = replace(record.card, objective=objective, augmentation=augmentation, top1=top1, twin="net", **changes)
    return replace(record, card=replace(card, training={"masking": masking}, weights=f"{augmentation}{masking}{top1}"))


def _texts(drawing: Drawing) -> list[str]:
    root = ElementTree.fromstring(drawing.render())
    return [item.text or "" for item in root.iter() if item.tag.endswith(("text", "title"))]


def test_figures_that_the_records_cannot_fill_say_what_they_lack(make_record):
    figures = _figures(replace(make_record("net"), card=None))
    assert figures["accuracy"].lacking.startswith("no record states a task accuracy")
    assert "at least 3 are needed" in figures["accuracy-fit"].lacking
    assert "more than one augmentation" in figures["augmentation"].lacking
    assert "more than one share of masked steps" in figures["masking"].lacking
    assert {key for key, figure in figures.items() if figure.drawing} == {"fit", "layers", "rdms", "rdm-lines"}


def test_every_figure_is_drawn_when_the_records_hold_what_it_needs(make_record):
    records = [
        replace(make_record("net", 0.3), card=replace(make_record().card, objective="untrained", seed=0, top1=None))
    ]
    for i, augmentation in enumerate(("physical", "image", "none")):
        records.append(_trained(make_record(f"net.{i}", 0.5 + 0.1 * i), "simclr", augmentation, top1=0.1 + 0.1 * i))
        records.append(_trained(make_record(f"net.s{i}", 0.4 + 0.1 * i), top1=0.3 + 0.1 * i))
    records.append(_trained(make_record("net.3", 0.9), "simclr", "physical", 0.75, top1=0.5))
    figures = _figures(*records)
    assert [key for key, figure in figures.items() if figure.drawing is None] == []
    for figure in figures.values():
        root = ElementTree.fromstring(standalone(figure.drawing))
        assert root.attrib["aria-label"]
        places = [float(item.attrib[name]) for item in root.iter() for name in ("x", "x1", "x2") if name in item.attrib]
        assert all(-1 <= place <= figure.drawing.width + 1 for place in places)
        assert "nan" not in figure.drawing.render()
    assert "r = " in figures["accuracy-fit"].caption
    assert any("untrained twin 0.300" in text for text in _texts(figures["fit"].drawing))


def test_only_supervised_networks_enter_their_own_panel(make_record):
    records = [_trained(make_record(f"net.s{i}", 0.4 + 0.1 * i), top1=0.3, top5=0.5 + 0.1 * i) for i in range(4)]
    records.append(_trained(make_record("net.other", 0.9), "simclr", top1=0.1, top5=0.2))
    figures = _figures(*records)
    tips = [text for text in _texts(figures["supervised-fit"].drawing) if "neural fit" in text]
    assert len([text for text in tips if text.startswith("net.")]) == 4
    assert "r = 1.00" in figures["supervised-fit"].caption
    assert "r = 1.00" not in figures["accuracy-fit"].caption
    texts = _texts(figures["parameters-accuracy"].drawing)
    assert "net.other: parameters 3.79888e+07, top-5 accuracy 0.200" in texts
    # One record without top-5 brings all to top-1, so that one axis has one meaning.
    mixed = _figures(*records, _trained(make_record("net.mixed", 0.5), top1=0.3))
    assert any("top-1 accuracy" in text for text in _texts(mixed["accuracy-fit"].drawing))


def test_the_accuracy_of_a_twin_comes_from_the_trained_record_or_else_from_its_own(make_record):
    plain = replace(make_record("net", 0.3), card=replace(make_record().card, objective="untrained", seed=0, top1=None))
    trained = make_record("net.supervised", 0.5)
    alone = _figures(plain, _trained(trained))["accuracy"]
    assert "No record states the accuracy of an untrained twin" in alone.caption
    told = _figures(plain, _trained(trained, twin_top1=0.25))["accuracy"]
    assert "untrained twin 0.250" in _texts(told.drawing)
    assert "No record states" not in told.caption


def test_untrained_networks_do_not_count_among_the_models_cut_from_the_accuracies(make_record):
    card = replace(make_record().card, objective="untrained", top1=0.1)
    plain = [replace(make_record(f"net{i}"), card=replace(card, weights=str(i))) for i in range(svg.SHOWN + 1)]
    figure = _figures(_trained(make_record("net.supervised")), *plain)["accuracy"]
    assert "Shown are the first" not in figure.caption
    assert "Shown are the first" in _figures(*plain)["accuracy"].caption


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=4, max_size=20))
def test_regression_agrees_with_scipy(points):
    x, y = (np.array(values) for values in zip(*points, strict=True))
    slope, start, r, interval = regression(list(x), list(y))
    if np.ptp(x) < 1e-3 or np.ptp(y) < 1e-3:
        return
    expected = stats.linregress(x, y)
    assert slope == pytest.approx(expected.slope, abs=1e-6, rel=1e-6)
    assert start == pytest.approx(expected.intercept, abs=1e-5, rel=1e-6)
    assert r == pytest.approx(expected.rvalue, abs=1e-6)
    if interval is not None and abs(r) < 0.999:
        known = stats.pearsonr(x, y).confidence_interval(0.95)
        assert (interval.low, interval.high) == (
            pytest.approx(known.low, abs=1e-5),
            pytest.approx(known.high, abs=1e-5),
        )


def test_a_variable_whose_variance_vanishes_has_no_regression():
    assert math.isnan(regression([0.0, 0.0, 0.0, 1.5e-299], [0.0, 0.0, 0.0, 1.0])[2])


def test_names_above_panels_end_inside_the_drawing(make_record):
    names = [f"zhuang-intersection-ln-small+mamba.masked{index}" for index in range(4)]
    drawing = _figures(*map(make_record, names))["layers"].drawing
    root = ElementTree.fromstring(drawing.render())
    titles = [item for item in root.iter() if item.get("class") == "small title"]
    assert len(titles) == 4
    # Bold letters of 10.5 pixels are about 6.7 pixels wide.
    assert max(float(item.get("x")) + 6.7 * len(item.text) for item in titles) < drawing.width


def test_layers_stand_at_their_scores(make_record):
    drawing = layers([make_record("net")])
    assert drawing is not None
    texts = _texts(drawing)
    assert any(text.startswith("conv4: 0.688") for text in texts)


def test_a_diagram_holds_every_part_and_folds_repeated_blocks():
    blocks = tuple(GraphNode(f"attender.block{i}", "attender", "self-attention") for i in range(1, 9))
    nodes = (
        GraphNode("input", "input", "forces", shape=(30, 5, 7)),
        GraphNode("encoder.a", "encoder", "conv"),
        GraphNode("encoder.b", "encoder", "conv", "GRU"),
        GraphNode("encoder.c", "encoder", "linear"),
        *blocks,
    )
    edges = [GraphEdge(a.name, b.name) for a, b in pairwise(nodes)]
    edges += [GraphEdge("encoder.b", "encoder.a", True), GraphEdge("encoder.a", "encoder.c")]
    drawing = diagram(ModelGraph(nodes, tuple(edges)), "net")
    texts = _texts(drawing)
    for name in ("input", "a", "b", "c", "8 × block"):
        assert name in texts
    assert "conv · GRU" in texts
    assert "1 feedback connections" in drawing.title
    assert drawing.render().count("feedback") == 2  # the title and one dashed line


def test_an_interval_off_the_axis_is_held_at_its_end(make_record):
    figures = _figures(make_record("far", 7.0, interval=Interval(6.5, 7.5)), make_record("near", 0.4))
    assert figures["fit"].drawing is not None


def test_the_examples_hold():
    for module in (svg, svg):
        found = doctest.testmod(module)
        assert found.attempted
        assert found.failed == 0


def test_an_ablation_changes_one_thing_at_a_time(make_record):
    records = [
        _trained(make_record("net.a", 0.9), "simclr", "physical", 0.75),
        _trained(make_record("net.b", 0.5), "simclr", "physical"),
        _trained(make_record("net.c", 0.4), "simclr", "image"),
    ]
    figures = _figures(*records)
    shown = [text for text in _texts(figures["augmentation"].drawing) if text.startswith("net.")]
    assert {text.split(":")[0] for text in shown} == {"net.b, physical", "net.c, image"}
    shown = [text for text in _texts(figures["masking"].drawing) if text.startswith("net.")]
    assert {text.split(":")[0] for text in shown} == {"net.a, 75% masked", "net.b, 0% masked"}


def test_an_ablation_compares_what_was_tested_on_the_same_sweeps(make_record):
    records = [
        _trained(make_record("net.a", 0.9), "simclr", "physical", accuracy_data="old"),
        _trained(make_record("net.b", 0.5), "simclr", "physical", accuracy_data="new"),
        _trained(make_record("net.c", 0.4), "simclr", "image", accuracy_data="new"),
        _trained(make_record("net.d", 0.3), "simclr", "none", accuracy_data="older"),
    ]
    shown = [text for text in _texts(_figures(*records)["augmentation"].drawing) if text.startswith("net.")]
    assert {text.split(":")[0] for text in shown} == {"net.b, physical", "net.c, image"}
