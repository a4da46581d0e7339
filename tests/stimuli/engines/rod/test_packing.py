"""Whiskers and motions as arrays of named numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core import rotations
from brainbench.core.errors import UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.motion_pieces import Cutting
from brainbench.stimuli.engines.rod.kernels import specialize
from brainbench.stimuli.engines.rod.packing import (
    KNOT,
    PackedMotions,
    PackedSurface,
    beam_compliance,
    capacity_for,
    follicle_track,
    knots_alike,
    pack_chains,
    pseudo_normals,
    still_knots,
)
from brainbench.stimuli.motion.jobs import StillFollicle
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.whiskers.whisker import build_chain, quadrature
from tests.factories.engine_scenes import C2
from tests.factories.gradients import Swing

wp = pytest.importorskip("warp")

CUTTING = Cutting(0.0, 0.05, 1e-4, 1e-4)


@pytest.mark.parametrize("hinges", [2, 3])
def test_packed_links_are_the_records_of_the_kernels(hinges):
    wp.init()
    structs = specialize("state", hinges=hinges)
    packed = pack_chains(12, [build_chain(C2, 8)], False, hinges)
    for name, kind in (("build", structs.LinkBuild), ("inertia", structs.LinkInertia), ("taper", structs.LinkTaper)):
        assert packed[name].dtype.names == np.dtype(kind.numpy_dtype()).names
    # mm and mg; places without a link stay empty.
    assert packed["build"]["length"][:, 0].sum() == pytest.approx(C2.arc_length * 1e3)
    assert (packed["build"]["mass"][8:] == 0).all()
    assert (packed["build"]["mass"][:8] > 0).all()


def test_a_chain_takes_the_smallest_kernel_that_holds_it():
    assert [capacity_for(links) for links in (1, 12, 13, 100)] == [12, 12, 24, 100]


def test_tracks_stand_one_behind_the_other_and_far_places_keep_their_digits():
    motions = PackedMotions()
    moving = follicle_track(Swing(), C2.arc_length, CUTTING)
    still = motions.add_straight(still_knots(np.array([1000.0, 0.0, 0.001]), (1.0, 0.0, 0.0, 0.0)))
    index = motions.add(moving)
    arrays = motions.arrays()
    assert (still.tolist(), index) == ([0], 1)
    assert arrays["cell"][arrays["first"][1]] == 1
    assert arrays["cell"][arrays["first"][1] + arrays["count"][1] - 1] == len(moving.knots)
    np.testing.assert_allclose(arrays["coarse"][0] + arrays["place"][0], [1e6, 0.0, 1.0])
    assert (np.abs(arrays["place"]) <= 16).all()


def test_knots_of_another_motion_have_the_signs_of_the_first_and_one_that_bends_is_refused():
    track = follicle_track(Swing(), C2.arc_length, CUTTING)
    track.knots["quaternion"] *= -1
    knots = knots_alike(track, Swing().pose, rotations.base_rotation, (0.0, 0.05), "a base")
    assert knots.dtype == KNOT
    np.testing.assert_allclose(knots["quaternion"], track.knots["quaternion"])
    still = follicle_track(StillFollicle(), C2.arc_length, CUTTING)
    with pytest.raises(UsageError, match="stands still at the given values"):
        knots_alike(still, Swing().pose, rotations.base_rotation, (0.0, 0.05), "a base")


@pytest.mark.parametrize("lift", [0.0, 1e-10, -1e-10])
def test_a_triangle_without_a_width_in_a_sharp_edge_does_not_hide_the_other_side(lift):
    """A roof of 33° whose ridge from 0 to 1 has a corner 4 in the middle that one of its two sides does not use."""
    corners = np.array([[0, 0, 0], [10, 0, 0], [5, 3, -10], [5, -3, -10], [4, 0, lift]], dtype=float)
    faces = np.array([[0, 1, 2], [0, 4, 1], [0, 3, 4], [4, 3, 1], [0, 2, 3], [1, 3, 2]])
    found = pseudo_normals(corners, faces)
    up = np.array([0.0, 0.0, 1.0])
    # The ridge and its middle belong to both sides, which are mirror images of each other.
    np.testing.assert_allclose(found[0, 6], up, atol=1e-6)  # edge 0–1 of the side that is whole
    np.testing.assert_allclose(found[2, 5], up, atol=1e-6)  # edge 0–4
    np.testing.assert_allclose(found[3, 5], up, atol=1e-6)  # edge 4–1
    np.testing.assert_allclose(found[1, 4:], np.tile(up, (3, 1)), atol=1e-6)
    np.testing.assert_allclose(found[2, 3], up, atol=1e-6)  # corner 4
    assert PackedSurface.of(corners, faces).triangles == 5
    usual = pseudo_normals(corners[:4], np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    np.testing.assert_allclose(found[0, [0, 1, 2, 3]], usual[0, [0, 1, 2, 3]], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("label", ["pyramid", "stairs", "house", "polygon"])
def test_hulls_with_such_triangles_have_no_whisker_inside_before_they_arrive(label):
    (scene,) = (scene for scene in get_recipe("objects").scenes if scene.label == label)
    jobs = scene.jobs()
    times = np.arange(1, 4) * 1e-3
    traces = get_engine("rod").run(
        [type(job)(job.whisker, job.follicle, job.obstacles, times) for job in jobs], Fidelity(links=10, time_step=1e-3)
    )
    assert [trace.reason for trace in traces if trace.reason] == []


@pytest.mark.parametrize("tip", [1.0, 0.2])
def test_joints_and_the_rod_between_them_are_the_beam(tip):
    """Deflection and slope of a cantilever at its end s under a force there: ∫ (s − x)²/EI dx and ∫ (s − x)/EI dx."""
    whisker = replace(C2, curvature=0.0, tip_radius=tip * C2.base_radius)
    chain = build_chain(whisker, 11)
    near, there, near_offset, there_offset = beam_compliance(chain)
    for link, k in np.ndindex(11, 4):
        s = whisker.arc_length * (link + k / 3) / 11
        length, moments = chain.nodes[1], s - chain.nodes[: link + 1]
        turn = offset = 0.0
        for i in range(link + 1):
            turn -= moments[i] / chain.stiffness[i]
            place, far = (3, moments[i + 1]) if i < link else (k, 0.0)
            share = place / 3
            offset += length * (turn * share + moments[i] * near_offset[i, place] + far * there_offset[i, place])
            turn += moments[i] * near[i, place] + far * there[i, place]
        joints = [np.sum(moments**order / chain.stiffness[: link + 1]) for order in (1, 2)]
        x, weights = quadrature(0.0, s, chain.nodes)
        beam = [np.sum(weights * (s - x) ** order / whisker.bending_stiffness(x)) for order in (1, 2)]
        np.testing.assert_allclose(np.add(joints, (turn, offset)), beam, rtol=1e-6, atol=1e-12 * beam[0])
