"""Tasks as data: registry, goals, objects, scenes, reset, thermometers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import hands, tasks
from robotics_bridge.physics import Geometry
from robotics_bridge.tasks.objects import (
    ObjectShape,
    ball,
    box,
    screwdriver,
    slots,
    with_sizes,
)
from robotics_bridge.tasks.scenes import build
from robotics_bridge.tasks.task import ObjectRandomisation


def test_shapes_share_their_slots_and_scale_in_all_lengths() -> None:
    shapes = (box(0.04, 0.05, 0.06), screwdriver(0.2, 0.1, 0.02, 0.004))
    assert slots(shapes) == ("box", "capsule", "cylinder")
    sizes = with_sizes(shapes, (0.5, 2.0))
    assert len(sizes) == 16
    assert sizes[0].extent == pytest.approx((0.02, 0.025, 0.03))
    assert max(shape.solids[0].position for shape in sizes) == pytest.approx((0.0, 0.3, 0.0))
    assert with_sizes(shapes, (1.0, 1.0)) == shapes
    with pytest.raises(UsageError, match=r"size .*received 0\.0"):
        ObjectRandomisation(size=(0.0, 1.0))
    with pytest.raises(UsageError, match=r"received 0\.2 m of 0\.1 m"):
        screwdriver(0.1, 0.2, 0.02, 0.004)


@pytest.mark.parametrize("count", [1, 2, 3, 6, 8, 17])
def test_a_few_environments_have_objects_of_all_sizes(count: int) -> None:
    shapes = tuple(box(0.01 * (index + 1), 0.02, 0.02) for index in range(count))
    edges = np.array([shape.extent for shape in with_sizes(shapes, (0.5, 1.5))])
    np.testing.assert_allclose(np.sort(edges[:8, 1]), 0.02 * np.linspace(0.5, 1.5, 8))
    assert len(np.unique(edges.round(9), axis=0)) == 8 * count


def test_blocks_weigh_what_their_density_says() -> None:
    task = tasks.load("in_palm_rotate")
    model = build(task, hands.load("xhand1"))
    for each, shape in zip(model.models, model.shapes, strict=True):
        body = each.body("object").id
        volume = np.prod(shape.extent) * (np.pi / 4 if shape.name.startswith("cylinder") else 1)
        assert each.body_mass[body] == pytest.approx(task.density * volume, rel=1e-6)


@pytest.mark.parametrize("size", [0.0, np.nan, np.inf, "a"])
def test_objects_have_sizes_in_metres(size) -> None:
    with pytest.raises(UsageError, match="size of a sphere"):
        Geometry(kind="sphere", size=(size,))
    with pytest.raises(UsageError, match=r"metres must .*at most 3\.0; received 20"):
        ball(20.0)
    with pytest.raises(UsageError, match="sphere"):
        Geometry(kind="sphere", size=0.01)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"), [("solids", ()), ("extent", (np.nan, 1, 1)), ("extent", (1, 1)), ("bottom", np.nan)]
)
def test_outer_measures_of_objects_are_lengths(name, value) -> None:
    with pytest.raises(UsageError, match="solid" if name == "solids" else name):
        replace(ball(0.02), **{name: value})
    assert isinstance(ball(0.02).scaled(2.0), ObjectShape)
