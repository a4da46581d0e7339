import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.geometry import deviation, winding_number
from brainbench.stimuli.objects import procedural

FAMILIES = procedural.list_families()
CONVEX = {"brick", "cone", "cylinder", "ellipsoid", "lens", "polygon", "pyramid", "superquadric", "wedge"}
UNKNOWN_PARTS = {"bumpy", "carved", "pebble", "perforated"}
"""Families whose convex parts are not known, so that they have none."""
HOLES = {"torus": 1, "ring": 1, "knot": 1, "frame": 1, "mug": 1, "basket": 1, "carved": 5, "horseshoe": 0, "brick": 0}
"""Genus: tunnels through the solid (three crossing bores open six mouths, so five tunnels)."""


def _genus(mesh):
    """Of one closed surface, by Euler's formula V − E + F = 2 − 2g."""
    used = len(np.unique(mesh.faces))
    return (2 - (used - len(mesh.faces) * 3 // 2 + len(mesh.faces))) // 2


def test_there_are_at_least_twenty_four_families_each_described():
    assert len(FAMILIES) >= 24
    assert all(procedural.describe_family(family).endswith(".") for family in FAMILIES)


def _check(shape, family):
    mesh = shape.mesh
    assert str(mesh.diagnosis) == "watertight"
    assert mesh.volume > 0
    assert mesh.diagonal == pytest.approx(1, abs=1e-8)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0, atol=1e-8)
    assert procedural.DETAIL[0] <= len(mesh.faces) <= procedural.DETAIL[1]
    assert shape.label == family
    assert shape.parameters


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_makes_one_closed_outward_body_of_diagonal_one_and_no_two_alike(family):
    members = [procedural.make(family, seed, detail=2000) for seed in range(2)]
    for shape in members:
        _check(shape, family)
        assert bool(shape.part_points) is (family not in UNKNOWN_PARTS)
    assert members[0].mesh.volume != pytest.approx(members[1].mesh.volume, rel=1e-6)


@settings(max_examples=15)
@given(family=st.sampled_from(FAMILIES), seed=st.integers(0, 2**31), detail=st.integers(*procedural.DETAIL))
def test_any_seed_and_detail_give_a_sound_shape(family, seed, detail):
    _check(procedural.make(family, seed, detail=detail), family)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_holds_over_many_seeds(family):
    members = [procedural.make(family, seed, detail=2000) for seed in range(40)]
    for shape in members:
        _check(shape, family)
    assert len({shape.mesh.content_hash for shape in members}) == 40


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_no_surface_runs_through_itself(family):
    rng = np.random.default_rng(0)
    for seed in range(4):
        mesh = procedural.make(family, seed, detail=2000).mesh
        low, high = mesh.bounds
        turns = winding_number(mesh, rng.uniform(low, high, (1500, 3)))
        # Where a closed surface overlaps itself it wraps twice.
        np.testing.assert_allclose(turns, np.round(turns), atol=1e-3)
        assert set(np.round(turns)) <= {0.0, 1.0}, seed


def test_shapes_are_equal_across_processes_and_numbers_of_threads():
    code = (
        "from brainbench.stimuli.objects import procedural\n"
        "print(*[procedural.make(f, 5, detail=3000).mesh.content_hash for f in procedural.list_families()[::4]])"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": "99", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", code]
    if hasattr(os, "sched_setaffinity"):
        command = ["taskset", "-c", str(min(os.sched_getaffinity(0))), *command]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    ours = [procedural.make(family, 5, detail=3000).mesh.content_hash for family in FAMILIES[::4]]
    assert done.stdout.split() == ours


@pytest.mark.parametrize("family", sorted(HOLES))
def test_shapes_have_the_tunnels_of_their_class(family):
    assert {_genus(procedural.make(family, seed, detail=2000).mesh) for seed in range(3)} == {HOLES[family]}


@pytest.mark.parametrize("family", sorted(CONVEX))
def test_convex_families_are_their_own_hull(family):
    shape = procedural.make(family, 2)
    (part,) = shape.parts
    assert part.volume == pytest.approx(shape.mesh.volume, rel=1e-3)


def _check_parts(shape):
    assert deviation(shape.mesh, shape.parts, samples=300).largest < 0.012
    assert all(part.diagnosis.watertight and part.volume > 0 for part in shape.parts)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["cup", "gear", "knot", "orange", "stairs", "twist"])
def test_the_parts_of_a_concave_shape_fill_it_and_leave_its_hollows(family):
    _check_parts(procedural.make(family, 3, detail=2000))


@pytest.mark.slow
@pytest.mark.parametrize("family", sorted(set(FAMILIES) - CONVEX - UNKNOWN_PARTS))
def test_the_parts_of_every_concave_family_fill_it_and_leave_its_hollows(family):
    for seed in range(3):
        _check_parts(procedural.make(family, seed, detail=2000))


@pytest.mark.parametrize("family", ["torus", "vase", "gear", "bumpy"])
def test_detail_changes_the_triangles_and_hardly_the_solid(family):
    coarse, fine = (procedural.make(family, 0, detail=detail) for detail in (2000, 16_000))
    assert len(fine.mesh.faces) > 4 * len(coarse.mesh.faces)
    assert fine.parameters == coarse.parameters
    assert fine.mesh.volume == pytest.approx(coarse.mesh.volume, rel=0.05)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("torsu",), "Unknown shape family 'torsu'; did you mean 'torus'"),
        (("torus", -1), "at least 0; received -1"),
        (("torus", 1.5), "whole number"),
        (("torus", 0, 100), "triangles.*at least 2,000 and at most 20,000; received 100"),
    ],
)
def test_impossible_shapes_are_refused(arguments, message):
    family, seed, detail = (*arguments, *(0, 4000)[len(arguments) - 1 :])
    with pytest.raises(UsageError, match=message):
        procedural.make(family, seed, detail=detail)


# Last, since it forgets what the other tests here made.
@pytest.mark.parametrize("family", ["bumpy", "chair", "vase"])
def test_a_seed_repeats(family):
    first = procedural.make(family, 1, detail=2000)
    procedural.families._make.cache_clear()
    again = procedural.make(family, 1, detail=2000)
    assert again is not first
    assert again.mesh.content_hash == first.mesh.content_hash
    assert again.parameters == first.parameters
