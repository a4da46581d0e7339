"""Contact point and force from shapes, against the elastica of the references and the rod engine's shapes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import ContactOptions, find_contacts, new_shapes
from brainbench.stimuli.fitting.contacts import STEPS, LoadedWhisker, normal_offsets
from brainbench.stimuli.validation import peg
from brainbench.stimuli.whiskers.whisker import build_chain

WHISKER = WhiskerArray.of("rat")["C2"].whisker


def _joints(links):
    chain = build_chain(WHISKER, links)
    return chain.nodes, chain.points[None, :, :2]


@pytest.mark.parametrize("links", [10, 20])
def test_points_of_the_curve_have_no_distance_although_the_chords_do(links):
    nodes, joints = _joints(links)
    points = WHISKER.centre_line(np.linspace(0.0005, 0.031, 77))[None]
    offsets = normal_offsets(nodes, joints, points)
    sagitta = 2 * abs(WHISKER.curvature) * (WHISKER.arc_length / links) ** 2 / 8
    assert np.abs(offsets).max() < 0.01 * sagitta


def test_the_distance_is_signed_and_across_the_curve():
    nodes, joints = _joints(20)
    s = np.linspace(0.002, 0.03, 15)
    angle = WHISKER.tangent_angle(s)
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    # A point to the left of the curve: the curve lies to its right, at minus the distance.
    points = (WHISKER.centre_line(s) + 1e-4 * normal + 1e-5 * along)[None]
    np.testing.assert_allclose(normal_offsets(nodes, joints, points)[0, :, 0], -1e-4, atol=1e-8)


def test_in_space_there_are_two_distances_of_the_same_length():
    nodes, joints = _joints(20)
    space = np.pad(joints, ((0, 0), (0, 0), (0, 1)))
    s = np.linspace(0.002, 0.03, 9)
    points = np.pad(WHISKER.centre_line(s), ((0, 0), (0, 1)))[None] + np.array([0, 0, 3e-5])
    offsets = normal_offsets(nodes, space, points)
    assert offsets.shape == (1, 9, 2)
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=-1), 3e-5, rtol=1e-6)
    np.testing.assert_allclose(offsets[..., 1], -3e-5, rtol=1e-6)


def test_missing_points_and_lost_frames_are_missing():
    nodes, joints = _joints(10)
    both = np.concatenate([joints, np.full_like(joints, np.nan)])
    points = np.repeat(WHISKER.centre_line(np.array([0.005, 0.01, 0.02]))[None], 2, axis=0)
    points[0, 1] = np.nan
    offsets = normal_offsets(nodes, both, points)[..., 0]
    assert np.isnan(offsets).tolist() == [[False, True, False], [True, True, True]]


MOUSE, RAT = (WhiskerArray.of(species)["C2"].whisker for species in ("mouse", "rat"))


def _press(whisker, at, depth):
    """Return the arc (m) of a contact and the force (N) that bends a straight whisker by so much of its length."""
    arc = at * whisker.arc_length
    straight = replace(whisker, curvature=0.0)
    return arc, depth * whisker.arc_length / references.point_load_deflection(straight, 1.0, arc)


def _shape(whisker, arc, force, *, points=60, turn=0.3, traced=0.97):
    """Return points of the loaded whisker, turned as a whole, and the place of the contact."""
    shape = LoadedWhisker(whisker).shapes(np.array([[1e-3, 2e-3, turn]]), np.array([arc]), np.array([force]))
    length = whisker.arc_length
    beyond = np.linspace(0, 1, len(shape.place[0]) - STEPS)[1:]
    arcs = np.concatenate([np.linspace(0, arc, STEPS + 1), arc + (length - arc) * beyond])
    s = np.linspace(0, traced * length, points)
    return np.stack([np.interp(s, arcs, column) for column in shape.place[0].T], axis=1), shape.contact[0]


@pytest.mark.slow
@pytest.mark.parametrize(("whisker", "at", "depth"), [(MOUSE, 0.3, 0.1), (RAT, 0.5, -0.05), (RAT, 0.8, 0.15)])
def test_shapes_are_those_of_the_elastica(whisker, at, depth):
    length = whisker.arc_length
    contact = references.elastica(whisker, at * length, depth * length + whisker.curvature * (at * length) ** 2)
    force = float(np.hypot(*contact.force) * np.sign(contact.moment))
    found = LoadedWhisker(whisker).shapes(np.zeros((1, 3)), np.array([contact.arc]), np.array([force]))
    np.testing.assert_allclose(found.contact[0], contact.point, atol=2e-8)
    assert found.moment[0] == pytest.approx(contact.moment, rel=1e-5)
    np.testing.assert_allclose(found.force[0] * force, contact.force, rtol=1e-5, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(("whisker", "at", "depth"), [(MOUSE, 0.4, 0.12), (RAT, 0.6, -0.1), (RAT, 0.8, 0.15)])
def test_force_and_place_come_back_within_a_tenth_at_20_micrometres(whisker, at, depth):
    arc, force = _press(whisker, at, depth)
    points, place = _shape(whisker, arc, force)
    rng = np.random.default_rng(3)
    noisy = points + rng.normal(size=(8, *points.shape)) * 20e-6
    found = find_contacts(new_shapes(np.arange(8) / 500, noisy), whisker, options=ContactOptions(noise=20e-6))
    assert np.median(np.abs(found["force"] / force - 1)) < 0.1
    assert np.median(np.abs(found["arc"] - arc)) < 0.02 * whisker.arc_length
    np.testing.assert_allclose(np.median(found["point"], axis=0), place, atol=0.02 * whisker.arc_length)
    # The deviation that is told is that of the errors.
    z = (found["force"] - force) / found["force_deviation"]
    assert 0.3 < np.sqrt(np.mean(z**2)) < 2


@pytest.mark.slow
def test_a_known_contact_point_makes_the_force_more_certain():
    arc, force = _press(MOUSE, 0.5, 0.08)
    points, place = _shape(MOUSE, arc, force)
    shapes = new_shapes(np.arange(4) / 500, points + np.random.default_rng(0).normal(size=(4, *points.shape)) * 2e-5)
    options = ContactOptions(noise=2e-5)
    free = find_contacts(shapes, MOUSE, options=options)
    held = find_contacts(shapes, MOUSE, contact_points=np.tile(place, (4, 1)), options=options)
    assert np.median(held["force_deviation"]) < 0.7 * np.median(free["force_deviation"])
    assert np.median(np.abs(held["force"] / force - 1)) < 0.05


@pytest.mark.slow
def test_neighbouring_frames_of_one_contact_make_a_small_force_more_certain():
    truths = [_press(MOUSE, 0.5, depth) for depth in 0.045 * np.linspace(0.9, 1.1, 7)]
    points = np.stack([_shape(MOUSE, *truth)[0] for truth in truths])
    shapes = new_shapes(np.arange(7) / 500, points + np.random.default_rng(4).normal(size=points.shape) * 2e-5)
    alone, together = (
        find_contacts(shapes, MOUSE, options=ContactOptions(noise=2e-5, frames=frames)) for frames in (1, 7)
    )
    ratio = together["force_deviation"] / alone["force_deviation"]
    # Seven frames tell the middle as the mean of seven readings does, and the ends of a line less well.
    assert float(ratio[3]) == pytest.approx(1 / np.sqrt(7), rel=0.3)
    assert (ratio[[0, 6]] > 1.2 * ratio[3]).all()
    errors = [np.abs(found["force"] / [force for _, force in truths] - 1) for found in (alone, together)]
    assert np.sqrt(np.mean(errors[1] ** 2)) < 0.7 * np.sqrt(np.mean(errors[0] ** 2))
    z = (together["force"] - [force for _, force in truths]) / together["force_deviation"]
    assert np.abs(z).max() < 4
    with pytest.raises(UsageError, match="odd"):
        ContactOptions(frames=4)


def test_frames_whose_contacts_change_by_no_line_stay_as_they_are():
    truths = [_press(MOUSE, arc, depth) for arc, depth in [(0.4, 0.1), (0.7, 0.06), (0.5, 0.12)]]
    points = np.stack([_shape(MOUSE, *truth)[0] for truth in truths])
    shapes = new_shapes(np.arange(3) / 500, points + np.random.default_rng(4).normal(size=points.shape) * 1e-5)
    alone, together = (
        find_contacts(shapes, MOUSE, options=ContactOptions(noise=1e-5, frames=frames)) for frames in (1, 3)
    )
    np.testing.assert_array_equal(together["force"], alone["force"])
    z = (together["force"] - [force for _, force in truths]) / together["force_deviation"]
    assert np.abs(z).max() < 4


@pytest.mark.slow
def test_a_free_whisker_shows_no_contact_also_in_neighbouring_frames():
    points = np.tile(MOUSE.centre_line(np.linspace(0, 0.95 * MOUSE.arc_length, 50)), (6, 1, 1))
    noisy = points + np.random.default_rng(1).normal(size=points.shape) * 20e-6
    options = ContactOptions(noise=20e-6, frames=5)
    found = find_contacts(new_shapes(np.arange(6) / 500, noisy), MOUSE, options=options)
    assert (found["status"] == "undefined").sum() >= 5
    assert "No sign of a contact" in str(found["reason"].values[0])


@pytest.mark.slow
@pytest.mark.parametrize("bend", [0.7, 1.0, 1.3])
def test_a_wrong_rest_curvature_is_told(caplog, bend):
    rat = WhiskerArray.rat()["C1"].whisker
    line = replace(rat, curvature=bend * rat.curvature).centre_line(np.linspace(0, 0.98 * rat.arc_length, 60))
    noisy = line + np.random.default_rng(5).normal(size=(5, *line.shape)) * 20e-6
    find_contacts(new_shapes(np.arange(5) / 500, noisy), rat)
    assert ("same side" in caplog.text) == (bend != 1)


@pytest.mark.slow
def test_another_whiskers_stiffness_or_taper_is_noticed_or_scales_the_force():
    arc, force = _press(MOUSE, 0.6, 0.2)
    points, _ = _shape(MOUSE, arc, force)
    noisy = points + np.random.default_rng(2).normal(size=(3, *points.shape)) * 20e-6
    shapes, options = new_shapes(np.arange(3) / 500, noisy), ContactOptions(noise=20e-6)
    right = find_contacts(shapes, MOUSE, options=options)
    soft = find_contacts(shapes, replace(MOUSE, young_modulus=MOUSE.young_modulus / 2), options=options)
    np.testing.assert_allclose(soft["force"], right["force"] / 2, rtol=1e-3)
    cylinder = find_contacts(shapes, replace(MOUSE, tip_radius=MOUSE.base_radius), options=options)
    assert (cylinder["status"] != "ok").all()
    assert "fits no whisker" in str(cylinder["reason"].values[0])


def test_the_shape_of_the_rod_engine_tells_its_own_force():
    whisker = replace(MOUSE, curvature=0.0)
    test = peg(whisker, 0.5 * whisker.arc_length, 0.15 * whisker.arc_length, fidelity="accurate")
    joints = test.trace.link_positions[-1:, :, :2]
    # Each joint lies on the curve; the polygon between them does not.
    assert build_chain(whisker, joints.shape[1] - 1).nodes[-1] == pytest.approx(whisker.arc_length)
    found = find_contacts(new_shapes(np.zeros(1), joints), whisker)
    assert abs(float(found["moment"][0])) == pytest.approx(abs(test.wrench[5]), rel=0.05)
    assert float(found["arc"][0]) == pytest.approx(test.contact_arc, rel=0.03)


@pytest.mark.slow
def test_shapes_in_a_tilted_plane_give_the_same_force():
    arc, force = _press(MOUSE, 0.6, 0.15)
    points, _ = _shape(MOUSE, arc, force)
    tilt = np.array([[1, 0, 0], [0, np.cos(0.5), -np.sin(0.5)], [0, np.sin(0.5), np.cos(0.5)]])
    space = np.pad(points, ((0, 0), (0, 1))) @ tilt.T
    flat, tilted = (find_contacts(new_shapes(np.zeros(1), one[None]), MOUSE) for one in (points, space))
    assert float(tilted["force"][0]) == pytest.approx(float(flat["force"][0]), rel=1e-2)
    x = points[:, 0]
    helix = np.stack([x, *(2e-3 * np.sin(300 * x + phase) for phase in (0, 1.5))], axis=1)
    with pytest.raises(DataError, match="no plane"):
        find_contacts(new_shapes(np.arange(3.0), np.tile(helix, (3, 1, 1))), MOUSE)


def test_few_points_are_refused_in_words():
    points = np.tile(MOUSE.centre_line(np.linspace(0, 0.01, 4)), (3, 1, 1))
    found = find_contacts(new_shapes(np.arange(3.0), points), MOUSE)
    assert (found["status"] == "undefined").all()
    assert "4 points" in str(found["reason"].values[0])


@pytest.mark.parametrize(
    ("end", "options"),
    [(0, ContactOptions(noise=2e-5)), pytest.param(-1, ContactOptions(2e-5, None, True), marks=pytest.mark.slow)],
)
def test_a_frame_without_its_first_or_last_point_takes_no_other_for_it(end, options):
    arc, force = _press(MOUSE, 0.5, 0.15)
    points, place = _shape(MOUSE, arc, force, points=12, traced=1.0)
    frames = np.tile(points, (2, 1, 1))
    frames[1, end] = np.nan
    shapes = new_shapes(np.arange(2.0), frames)
    found = find_contacts(shapes, MOUSE, options=options)
    assert list(found["status"].values) == ["ok", "undefined"]
    assert ("first" if end == 0 else "last") in str(found["reason"].values[1])
    # The contact point makes up for it.
    held = find_contacts(shapes, MOUSE, contact_points=np.tile(place, (2, 1)), options=options)
    np.testing.assert_allclose(held["force"], force, rtol=0.03)


@pytest.mark.parametrize("first_arc", [np.nan, -1e-3, 0.02])
def test_a_trace_begins_on_the_whisker(first_arc):
    shapes = new_shapes(np.arange(3.0), np.tile(MOUSE.centre_line(np.linspace(0, 0.01, 8)), (3, 1, 1)))
    with pytest.raises(UsageError, match="first_arc"):
        find_contacts(shapes, MOUSE, options=ContactOptions(first_arc=first_arc))


def _track(way, *, begin=0.0, frames=3):
    """Return noisy shapes of a pressed whisker whose points [n, k, 2] went through ``way``, and the force (N)."""
    arc, force = _press(RAT, 0.6, 0.15)
    points, _ = _shape(RAT, arc, force, points=40, traced=1.0)
    points = points[round(40 * begin) :]
    noisy = points + np.random.default_rng(6).normal(size=(frames, *points.shape)) * 20e-6
    return new_shapes(np.arange(frames) / 500, way(noisy)), force


@pytest.mark.parametrize(
    ("way", "words"),
    [(lambda points: points[:, ::-1], "from the tip to the base"), (lambda points: points * [1, -1], "mirrored")],
)
def test_reversed_and_mirrored_tracks_are_named_as_such(way, words):
    contacts = find_contacts(_track(way, frames=1)[0], RAT)
    assert (contacts["status"] == "unreliable").all()
    assert all(words in reason for reason in contacts["reason"].values)


@pytest.mark.slow
def test_a_trace_that_may_begin_off_the_base_needs_its_first_arc():
    shapes, force = _track(lambda points: points, begin=0.2)
    contacts = find_contacts(shapes, RAT)
    assert (contacts["status"] == "unreliable").all()
    assert all("first_arc" in reason for reason in contacts["reason"].values)
    stated = find_contacts(shapes, RAT, options=ContactOptions(first_arc=8 / 39 * RAT.arc_length))
    assert (stated["status"] == "ok").all()
    np.testing.assert_allclose(stated["force"], force, rtol=0.25)
    whole, _ = _track(lambda points: points)
    assert (find_contacts(whole, RAT)["status"] == "ok").all()
