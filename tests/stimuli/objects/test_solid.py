from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from brainbench.core.errors import DataError, UsageError
from brainbench.core.rotations import euler_matrix, to_matrices
from brainbench.geometry import DecompositionSettings, Mesh, load_mesh
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.motion.trajectories import Path, Spin, Translation
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.objects.solid import (
    RODGERS_CONTROL,
    PlacedObject,
    box,
    capsule,
    cylinder,
    mesh_solid,
    rodgers_solid,
    shape_solid,
    sphere,
    touchable,
)
from brainbench.stimuli.whiskers.whisker import Whisker

SOLIDS = [sphere(2e-3), box((1e-3, 2e-3, 3e-3)), cylinder(1e-3, 5e-3), capsule(1e-3, 4e-3), rodgers_solid(segments=4)]


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.name)
def test_scaling_to_a_diagonal_scales_everything(solid):
    scaled = solid.to_diagonal(0.04)
    assert scaled.diagonal == pytest.approx(0.04)
    np.testing.assert_allclose(scaled.bounds, solid.bounds * 0.04 / solid.diagonal)


def test_a_surface_changes_the_configuration_only_where_the_parts_do_not_tell_it():
    plain = rodgers_solid()
    # So stimuli of the recipe keep the configuration hash that they had before solids had surfaces.
    assert plain.config() == replace(plain, surface=None).config()
    other = replace(plain, surface=Mesh(plain.surface.vertices * 1.001, plain.surface.faces))
    assert other.config()["hash"] != plain.config()["hash"]


def test_the_configuration_of_a_solid_changes_with_its_geometry_only():
    assert rodgers_solid().config() == rodgers_solid().config()
    assert rodgers_solid().config() != rodgers_solid(0.05).config()
    assert sphere(1e-3).config() != sphere(2e-3).config()


def _distances(mesh, points):
    """Distance of points to a surface, in millimetres (trimesh's tolerances are absolute)."""
    surface = mesh.scaled(1e3).to_trimesh()
    return trimesh.proximity.closest_point_naive(surface, points * 1e3)[1]


def _samples(mesh, count=400):
    surface = mesh.scaled(1e3).to_trimesh()
    return np.vstack([trimesh.sample.sample_surface(surface, count, seed=0)[0] / 1e3, mesh.vertices])


@pytest.mark.shared
def test_the_rodgers_solid_is_the_published_mesh_within_a_thousandth_of_its_diagonal(reference):
    published = load_mesh(reference / "stimuli" / "convex-shape.obj", unit="m")
    published = published.scaled(0.055 / published.diagonal)
    ours = rodgers_solid().mesh
    there, back = _distances(ours, _samples(published)), _distances(published, _samples(ours))
    hausdorff = max(there.max(), back.max())
    assert hausdorff < 1e-3 * 55
    assert ours.to_trimesh().volume == pytest.approx(abs(published.to_trimesh().volume), rel=1e-4)


@pytest.mark.shared
def test_the_rodgers_curve_passes_through_the_published_vertices(reference):
    published = load_mesh(reference / "stimuli" / "convex-shape.obj", unit="m")
    t = np.linspace(0, 1, 101)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    curve = weights @ np.array(RODGERS_CONTROL)
    gaps = np.linalg.norm(published.vertices[:, None, :2] - curve, axis=-1).min(axis=0)
    assert gaps.max() < 3e-6


def test_the_rodgers_solid_is_closed_and_outward():
    mesh = rodgers_solid().mesh
    assert mesh.diagnosis.watertight
    assert not mesh.diagnosis.inconsistent
    assert mesh.to_trimesh().volume > 0
    assert mesh.diagonal == pytest.approx(0.055)


def test_the_parts_of_the_rodgers_solid_fill_exactly_its_volume_and_keep_it_concave():
    solid = rodgers_solid()
    volume = sum(ConvexHull(part.vertices).volume for part in solid.parts)
    assert volume == pytest.approx(solid.mesh.to_trimesh().volume, rel=1e-9)
    assert volume < 0.5 * solid.mesh.hull().to_trimesh().volume


def test_twenty_four_segments_leave_a_sagitta_below_two_hundredths_of_a_millimetre():
    assert _distances(rodgers_solid().mesh, rodgers_solid(segments=200).mesh.vertices).max() < 0.02


def test_the_rodgers_solid_refuses_a_single_segment():
    with pytest.raises(UsageError, match=r"segments .*at least 2; received 1"):
        rodgers_solid(segments=1)


def _volume(surface):
    return Mesh(surface.vertices, surface.faces).volume


def test_a_mesh_is_touched_at_its_hull_and_says_when_that_fills_a_concavity(tmp_path):
    path = tmp_path / "crescent.stl"
    rodgers_solid().mesh.to_trimesh().export(path)
    solid = mesh_solid(path, unit="m", diagonal=0.03)
    assert solid.diagonal == pytest.approx(0.03)
    assert any("concavities" in note for note in solid.notes)
    cube = tmp_path / "cube.stl"
    trimesh.creation.box().export(cube)
    assert mesh_solid(cube, unit="mm").notes == ()


@pytest.mark.parametrize(("size", "unit", "told"), [(20, "mm", False), (0.02, "mm", True), (20, "m", True)])
def test_a_mesh_in_another_unit_than_said_is_told(tmp_path, caplog, size, unit, told):
    trimesh.creation.box((size, size, size)).export(tmp_path / "cube.stl")
    mesh_solid(tmp_path / "cube.stl", unit=unit)
    assert ("mm across" in caplog.text) == told
    caplog.clear()
    mesh_solid(tmp_path / "cube.stl", unit=unit, diagonal=0.02)
    assert "mm across" not in caplog.text


def test_a_file_that_brings_its_convex_pieces_keeps_its_concavity(tmp_path):
    path = tmp_path / "pieces.obj"
    parts = [trimesh.convex.convex_hull(part.vertices * 1e3) for part in rodgers_solid(segments=6).parts]
    trimesh.util.concatenate(parts).export(path)
    solid = mesh_solid(path, unit="mm", collision="pieces")
    assert solid.notes == ()
    assert len(solid.parts) == 6
    volume = sum(ConvexHull(part.vertices).volume for part in solid.parts)
    assert volume == pytest.approx(rodgers_solid(segments=6).mesh.to_trimesh().volume, rel=1e-4)
    with pytest.raises(UsageError, match="'piece'; did you mean 'pieces'"):
        mesh_solid(path, unit="mm", collision="piece")


def test_bars_that_cross_are_concave_although_their_volumes_add_up_to_that_of_their_hull(tmp_path):
    path = tmp_path / "cross.stl"
    trimesh.util.concatenate([trimesh.creation.box(np.roll((30, 30, 10), k)) for k in range(3)]).export(path)
    assert any("concavities are filled" in note for note in mesh_solid(path, unit="mm").notes)
    assert mesh_solid(path, unit="mm", collision="exact").parts == ()


def test_bars_with_one_common_corner_are_concave_too(tmp_path):
    bars = [trimesh.creation.box(bounds=[[0, 0, 0], end]) for end in ((2, 1, 1), (1, 2, 1.2))]
    path = tmp_path / "bars.stl"
    trimesh.util.concatenate(bars).export(path)
    assert any("concavities are filled" in note for note in mesh_solid(path, unit="cm").notes)
    pieces = mesh_solid(path, unit="cm", collision="pieces")
    assert [np.ptp(part.bounds(), axis=0).max() for part in pieces.parts] == pytest.approx([0.02, 0.02])


def test_an_open_mesh_says_so(tmp_path):
    path = tmp_path / "open.obj"
    cube = trimesh.creation.box()
    trimesh.Trimesh(cube.vertices, cube.faces[:-2]).export(path)
    assert any("not watertight" in note for note in mesh_solid(path, unit="mm").notes)


def test_a_surface_without_an_inside_is_not_touched_as_it_is():
    # A bottle of Klein: every edge joins two triangles, and none of its sides is out.
    u, v = np.divmod(np.arange(64), 8)
    right, up = (u + 1) % 8, (v + 1) % 8
    here, beside = np.where(u < 7, v, -v % 8), np.where(u < 7, up, -up % 8)
    quads = np.stack([8 * u + v, 8 * right + here, 8 * right + beside, 8 * u + up], axis=1)
    angle, swing = 2 * np.pi * u / 8, 2 * np.pi * v / 8
    away = 3 + np.cos(angle / 2) * np.sin(swing) - np.sin(angle / 2) * np.sin(2 * swing)
    height = np.sin(angle / 2) * np.sin(swing) + np.cos(angle / 2) * np.sin(2 * swing)
    vertices = np.column_stack([away * np.cos(angle), away * np.sin(angle), height])
    mesh = Mesh(vertices, np.vstack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))
    assert mesh.diagnosis.watertight
    assert mesh.diagnosis.inconsistent
    with pytest.raises(UsageError, match="disagree on inside and outside"):
        touchable(mesh, "exact", None)


def test_repairs_of_a_file_are_noted_and_reach_the_configuration(tmp_path):
    path = tmp_path / "flipped.obj"
    cube = trimesh.creation.box()
    trimesh.Trimesh(cube.vertices, cube.faces[:, ::-1], process=False).export(path)
    solid = mesh_solid(path, unit="mm")
    assert solid.mesh.volume == pytest.approx(1e-9)
    assert solid.config()["notes"] == ["the surface was inside out and was turned"]


def test_an_exact_mesh_is_its_surface_and_has_a_convex_part_only_when_it_is_convex(tmp_path):
    cube, crescent, sheet = tmp_path / "cube.stl", tmp_path / "crescent.stl", tmp_path / "open.obj"
    trimesh.creation.box().export(cube)
    rodgers_solid().mesh.to_trimesh().export(crescent)
    whole = trimesh.creation.box()
    trimesh.Trimesh(whole.vertices, whole.faces[:-2]).export(sheet)
    convex = mesh_solid(cube, unit="mm", collision="exact")
    assert ConvexHull(convex.parts[0].vertices).volume == pytest.approx(1e-9)
    assert _volume(convex.surface) == pytest.approx(1e-9)
    concave = mesh_solid(crescent, unit="m", diagonal=0.03, collision="exact")
    assert concave.parts == ()
    assert _volume(concave.surface) == pytest.approx(concave.mesh.volume)
    assert concave.diagonal == pytest.approx(0.03)
    assert "that takes the backend 'rod'" in concave.notes[0]
    assert concave.config()["hash"] != concave.to_diagonal(0.04).config()["hash"]
    with pytest.raises(UsageError, match=r"'open'.*collision = 'hull'"):
        mesh_solid(sheet, unit="mm", collision="exact")


@pytest.mark.parametrize(
    ("solid", "volume"),
    [
        (rodgers_solid(), rodgers_solid().mesh.volume),
        (shape_solid(procedural.make("torus", 0, detail=2000)), None),
        (shape_solid(procedural.make("bumpy", 0, detail=2000), collision="exact"), None),
        (shape_solid(procedural.make("torus", 0, detail=2000), collision="hull"), "hull"),
    ],
)
def test_solids_from_meshes_have_the_surface_that_whiskers_touch_and_placing_it_only_moves_it(solid, volume):
    expected = {None: solid.mesh.volume, "hull": solid.mesh.hull().volume}.get(volume, volume)
    assert _volume(solid.surface) == pytest.approx(expected)
    placed = PlacedObject(solid.to_diagonal(0.05), (0.01, 0.02, 0.03), (0.3, -0.5, 1.2), Translation((0.1, 0.0, 0.0)))
    surface = placed.obstacle().surface
    vertices = solid.surface.vertices * 0.05 / solid.diagonal @ euler_matrix((0.3, -0.5, 1.2)).T + [0.01, 0.02, 0.03]
    np.testing.assert_allclose(surface.vertices, vertices, atol=1e-12)
    assert _volume(surface) == pytest.approx(expected * (0.05 / solid.diagonal) ** 3)
    np.testing.assert_allclose([surface.boxes[:, 0].min(0), surface.boxes[:, 1].max(0)], surface.bounds)


def test_pieces_that_stand_for_a_solid_and_primitives_have_no_surface(tmp_path):
    path = tmp_path / "crescent.stl"
    rodgers_solid(segments=4).mesh.to_trimesh().export(path)
    settings = DecompositionSettings(threshold=0.2)
    assert mesh_solid(path, unit="m", collision="decomposition", decomposition=settings).surface is None
    assert mesh_solid(path, unit="m", collision="pieces").surface is None
    assert sphere(1e-3).surface is None


def test_a_decomposition_keeps_the_concave_face_and_states_its_deviation(tmp_path):
    path = tmp_path / "crescent.stl"
    rodgers_solid(segments=6).mesh.to_trimesh().export(path)
    settings = DecompositionSettings(threshold=0.05)
    solid = mesh_solid(path, unit="m", diagonal=0.03, collision="decomposition", decomposition=settings)
    assert solid.diagonal == pytest.approx(0.03)
    volume = sum(ConvexHull(part.vertices).volume for part in solid.parts)
    whole = solid.mesh.volume
    assert volume == pytest.approx(whole, rel=0.2)
    assert solid.mesh.hull().volume > 2 * whole
    assert "% of its diagonal (sampled)" in solid.notes[0]
    again = mesh_solid(path, unit="m", diagonal=0.03, collision="decomposition", decomposition=settings)
    assert again.config() == solid.config()
    assert again.to_diagonal(0.04).config()["hash"] != solid.config()["hash"]


def test_a_procedural_torus_keeps_its_hole_and_a_hull_fills_it():
    shape = procedural.make("torus", 0, detail=2000)
    solid, hull = shape_solid(shape), shape_solid(shape, collision="hull")
    assert solid.name == "torus-0"
    assert solid.diagonal == pytest.approx(0.04)
    centre = np.zeros(3)
    assert not any((ConvexHull(part.vertices).equations @ [*centre, 1] < 0).all() for part in solid.parts)
    assert (ConvexHull(hull.parts[0].vertices).equations @ [*centre, 1] < 0).all()
    assert "convex parts" in solid.notes[0]
    assert "concavities are filled" in hull.notes[0]


def test_a_shape_without_known_parts_is_touched_at_its_hull_unless_its_surface_is_asked_for():
    shape = procedural.make("bumpy", 0)
    assert len(shape_solid(shape).parts) == 1
    assert shape_solid(shape, collision="exact").parts == ()


def test_a_flat_mesh_cannot_be_touched(tmp_path):
    path = tmp_path / "sheet.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    with pytest.raises(DataError, match=r"'sheet' .*volume"):
        mesh_solid(path, unit="m")


@settings(max_examples=25)
@given(
    st.sampled_from(SOLIDS),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
)
def test_expressing_an_object_in_another_frame_and_back_is_expressing_it_in_the_world(solid, turn, place, axes, origin):
    placed = PlacedObject(solid, position=place, rotation=turn)
    frame = euler_matrix(axes)
    world = placed.obstacle().parts
    seen = placed.obstacle((frame, origin)).parts
    for there, here in zip(world, seen, strict=True):
        np.testing.assert_allclose(here.moved(frame, np.array(origin)).bounds(), there.bounds(), atol=1e-12)


def test_euler_angles_turn_about_fixed_x_then_y_then_z():
    angles = (0.3, -0.7, 1.1)
    np.testing.assert_allclose(euler_matrix(angles), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-15)


def test_a_turned_box_has_the_corners_of_the_turned_corners():
    placed = PlacedObject(box((2e-3, 4e-3, 6e-3)), rotation=(0.0, 0.0, 0.4))
    part = placed.obstacle().parts[0]
    np.testing.assert_allclose(to_matrices(part.quaternion), euler_matrix((0, 0, 0.4)), atol=1e-12)


def test_a_moving_object_is_carried_in_the_frame_it_is_seen_from():
    frame = euler_matrix((0, 0, np.pi / 2))
    placed = PlacedObject(sphere(1e-3), motion=Translation((0.03, 0.0, 0.0), onset=0.0))
    position, quaternion = placed.obstacle((frame, (0, 0, 0))).motion(np.array([0.0, 0.5]))
    np.testing.assert_allclose(position, [[0, 0, 0], [0, -0.015, 0]], atol=1e-15)
    np.testing.assert_allclose(quaternion, [[1, 0, 0, 0]] * 2)


MOTIONS = [
    Translation((0.03, -0.02, 0.01), 0.05),
    Spin((1.0, -2.0, 3.0), 0.05),
    Path((0.0, 0.1, 0.3), ((0, 0, 0), (1e-3, 2e-3, 0), (4e-3, 0, 1e-3)), ((0, 0, 0), (0.2, -0.1, 0.4), (0.5, 0.3, 1))),
]


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
@settings(max_examples=10)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
)
def test_each_point_of_a_moving_object_goes_where_rigid_kinematics_sends_it(motion, turn, place, axes, origin):
    placed = PlacedObject(rodgers_solid(segments=2), place, turn, motion)
    times = np.array([0.0, 0.02, 0.15, 0.3])
    frame, place, origin = euler_matrix(axes), np.array(place), np.array(origin)
    obstacle = placed.obstacle((frame, origin))
    position, quaternion = obstacle.motion(times)
    seen = np.einsum("tij,vj->tvi", to_matrices(quaternion), obstacle.parts[1].vertices) + position[:, None]
    turned = motion.turn(times) if hasattr(motion, "turn") else np.tile(np.eye(3), (4, 1, 1))
    own = placed.solid.parts[1].vertices @ euler_matrix(turn).T
    world = np.einsum("tij,vj->tvi", turned, own) + place + motion.displacement(times)[:, None]
    np.testing.assert_allclose(seen @ frame.T + origin, world, atol=1e-12)


@pytest.mark.parametrize("backend", ["mujoco", "bullet"])
def test_engines_of_convex_bodies_refuse_a_concave_surface_and_name_what_works(backend):
    item = PlacedObject(shape_solid(procedural.make("bumpy", 0, detail=2000), collision="exact"), (1.0, 0.0, 0.0))
    whisker = Whisker(0.02, 60e-6, 6e-6, young_modulus=5e9, density=1260.0, damping_ratio=0.3)
    job = Job(whisker, StillFollicle(), (item.obstacle(),), np.array([1e-3]))
    with pytest.raises(UsageError, match=rf"'{backend}'.*'decomposition'.*'rod'"):
        get_engine(backend).run([job], Fidelity(links=4, time_step=2e-4))


def test_a_whisker_through_the_hole_of_a_torus_feels_it_only_when_the_hole_is_filled():
    shape = procedural.make("torus", 1, detail=2000)
    whisker = Whisker(0.02, 60e-6, 6e-6, young_modulus=5e9, density=1260.0, damping_ratio=0.3)
    touched = {}
    for collision in ("exact", "hull"):
        # The axis of the torus lies along the whisker, which points along x.
        placed = PlacedObject(shape_solid(shape, collision=collision), (0.01, 0.0, 0.0), (0.0, np.pi / 2, 0.0))
        job = Job(whisker, StillFollicle(), (placed.obstacle(),), np.array([1e-3, 2e-3]))
        (trace,) = get_engine("mujoco").run([job], Fidelity(links=4, time_step=2e-4))
        touched[collision] = bool(trace.contact.any()) or trace.status != "ok"
    assert touched == {"exact": False, "hull": True}
