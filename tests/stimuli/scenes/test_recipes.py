import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation, euler_matrix
from brainbench.stimuli.motion.recorded import Trajectory
from brainbench.stimuli.objects.solid import box, rodgers_solid
from brainbench.stimuli.scenes.recipes import describe_recipe, get_recipe, list_recipes
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS

LABELS = ("convex-close", "convex-medium", "convex-far", "concave-close", "concave-medium", "concave-far")
NEEDS = {name: {"objects": [box((0.01, 0.02, 0.03))]} for name in GRIDS}
NEEDS["rodgers-recorded"] = {"trajectory": Trajectory(("RC2",), np.zeros((1, 1000, 3))), "whiskers": "C*"}


def _unbent_hits(scene):
    """Frames [n, whisker] in which the unbent whisker would run into an object, by geometry alone."""
    from scipy.spatial import ConvexHull

    times = np.linspace(0, 0.08, 81)
    hits = np.zeros((len(times), len(scene.array)), bool)
    for j, job in enumerate(scene.jobs()):
        position, euler = job.follicle.pose(times)
        line = job.whisker.centre_line(np.linspace(0, job.whisker.arc_length, 60))
        shape = np.column_stack([line, np.zeros(len(line))])
        points = position[:, None] + np.einsum("nij,pj->npi", base_rotation(euler), shape)
        for obstacle in job.obstacles:
            for part in obstacle.parts:
                planes = ConvexHull(part.vertices).equations
                hits[:, j] |= (points @ planes[:, :3].T + planes[:, 3] < 0).all(-1).any(-1)
    return times, hits


def test_rodgers_is_listed_and_described():
    assert "rodgers" in list_recipes()
    assert "Rodgers (2022)" in describe_recipe("rodgers")


def test_every_recipe_loads_and_has_a_description():
    for name in list_recipes():
        assert get_recipe(name, **NEEDS.get(name, {})).scenes
        assert describe_recipe(name)


def test_the_instant_recipe_differs_in_its_readings_alone():
    mean, instant = get_recipe("rodgers"), get_recipe("rodgers-instant")
    assert mean.scenes[0].frames.average == 18
    assert instant.scenes[0].frames.average == 1
    assert "instantaneously" in instant.description
    for first, second in zip(mean.scenes, instant.scenes, strict=True):
        drop = {"frames": None}
        assert {**first.config(), **drop} == {**second.config(), **drop}
        np.testing.assert_array_equal(first.frames.times, second.frames.times)


def test_an_unknown_recipe_suggests_the_nearest():
    with pytest.raises(UsageError, match="'rogers'; did you mean 'rodgers'"):
        get_recipe("rogers")


def test_the_six_stimuli_come_in_their_fixed_order():
    recipe = get_recipe("rodgers")
    assert recipe.labels == LABELS
    assert all(len(scene.array) == 30 for scene in recipe.scenes)
    assert len(get_recipe("rodgers", whiskers="C0-C3").scenes[0].array) == 4


@pytest.mark.parametrize(
    ("label", "x", "y"),
    [
        ("convex-close", 0, 21),
        ("convex-medium", 1, 22),
        ("convex-far", 2, 23),
        ("concave-close", -1, 21),
        ("concave-medium", 0, 22),
        ("concave-far", 1, 23),
    ],
)
def test_each_solid_stands_where_the_published_rule_places_its_bounding_box(label, x, y):
    (placed,) = get_recipe("rodgers").scenes[LABELS.index(label)].objects
    angle = math.radians(155 if label.startswith("convex") else -25)
    turned = rodgers_solid().mesh.vertices * 1e3 @ euler_matrix((0, 0, angle)).T
    expected = [x - turned[:, 0].min(), y + turned[:, 1].min(), 3]
    np.testing.assert_allclose(np.array(placed.position) * 1e3, expected, atol=1e-4)
    assert placed.rotation == pytest.approx((0, 0, angle))
    assert placed.solid.diagonal == pytest.approx(0.055)


def test_the_head_stands_where_the_published_simulation_puts_it():
    head = get_recipe("rodgers").scenes[0].head
    offset = euler_matrix((0, math.radians(15), 0)) @ [0, 13, 1.5]
    np.testing.assert_allclose(np.array(head.position) * 1e3, np.array([-5, -10, 0]) + offset, atol=1e-4)


def test_the_convex_face_bulges_towards_the_whiskers_and_the_concave_face_recedes():
    recipe = get_recipe("rodgers")
    for label, sign in (("convex-medium", 1), ("concave-medium", -1)):
        scene = recipe.scenes[LABELS.index(label)]
        centres = np.array([part.vertices.mean(axis=0) for part in scene.jobs()[0].obstacles[0].parts])
        chord = (centres[0] + centres[-1]) / 2
        # The whiskers start near the origin of the array frame.
        assert sign * (np.linalg.norm(chord) - np.linalg.norm(centres, axis=1).min()) > 0 or sign < 0
        middle = centres[len(centres) // 2]
        assert sign * (np.linalg.norm(chord) - np.linalg.norm(middle)) > 1e-3


@pytest.mark.parametrize("whiskers", ["all", "C0-C3"])
def test_whisking_runs_into_every_stimulus_but_never_before_it_has_started(whiskers):
    counts = []
    for scene in get_recipe("rodgers", whiskers=whiskers).scenes:
        times, hits = _unbent_hits(scene)
        assert hits.any(), scene.label
        assert times[hits.any(axis=1)][0] > 0.01
        counts.append(int(hits.any(axis=0).sum()))
    # Nearer objects are met by more whiskers.
    assert counts[0] > counts[2]
    assert counts[3] > counts[5]
    assert sorted(counts[:3], reverse=True) == counts[:3]
    assert sorted(counts[3:], reverse=True) == counts[3:]
