import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.errors import DataError
from brainbench.geometry import Mesh, repair


def _ball(radius=1.0, centre=(0.0, 0.0, 0.0)):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return Mesh(ball.vertices + np.asarray(centre), ball.faces, "ball")


def _flipped(mesh):
    return Mesh(mesh.vertices, mesh.faces[:, ::-1], mesh.name)


def _joined(*meshes):
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.vstack([mesh.vertices for mesh in meshes]), np.vstack(faces), "joined")


def test_a_sound_mesh_is_left_alone():
    mesh = _ball()
    result = repair(mesh)
    assert result.mesh is mesh
    assert (result.done, result.remaining) == ((), ())


def test_points_that_no_triangle_names_are_removed_so_that_no_hull_reaches_them():
    mesh = _ball()
    strayed = Mesh(np.vstack([[5.0, 0.0, 0.0], mesh.vertices]), mesh.faces + 1, mesh.name)
    result = repair(strayed)
    np.testing.assert_array_equal(result.mesh.hull().bounds, mesh.bounds)
    assert result.done == ("points without a triangle removed: 1",)
    # Nor those of triangles without an area, which go first.
    slim = Mesh(strayed.vertices, np.vstack([strayed.faces, [[0, 0, 1]]]), mesh.name)
    np.testing.assert_array_equal(repair(slim).mesh.hull().bounds, mesh.bounds)


def test_an_inside_out_mesh_is_diagnosed_and_turned():
    inward = _flipped(_ball())
    assert "inside out" in str(inward.diagnosis)
    result = repair(inward)
    assert result.mesh.volume == pytest.approx(_ball().volume)
    assert result.done == ("the surface was inside out and was turned",)


@settings(max_examples=20)
@given(st.data())
def test_triangles_turned_at_random_are_made_to_agree(data):
    mesh = _ball()
    turned = data.draw(st.lists(st.integers(0, len(mesh.faces) - 1), min_size=1, max_size=60, unique=True))
    faces = np.array(mesh.faces)
    faces[turned] = faces[turned][:, ::-1]
    result = repair(Mesh(mesh.vertices, faces))
    assert not result.mesh.diagnosis.inconsistent
    assert result.mesh.volume == pytest.approx(mesh.volume)
    assert any("agree with the neighbours" in note for note in result.done)


def test_duplicates_and_triangles_that_name_a_vertex_twice_are_removed():
    mesh = _ball()
    faces = np.vstack([mesh.faces, mesh.faces[:3], mesh.faces[5:6, ::-1], [[0, 1, 1]]])
    broken = Mesh(mesh.vertices, faces)
    assert broken.diagnosis.duplicate_faces == 4
    result = repair(broken)
    np.testing.assert_array_equal(result.mesh.faces, mesh.faces)
    assert result.done == ("1 triangle without area removed", "4 duplicate triangles removed")
    assert result.remaining == ()


def test_vertices_apart_by_rounding_are_merged():
    mesh = _ball()
    # Every triangle with its own corners, as in an STL file, moved by less than a single-precision digit.
    corners = mesh.vertices[mesh.faces].reshape(-1, 3)
    noise = np.random.default_rng(0).uniform(-1e-7, 1e-7, corners.shape)
    loose = Mesh(corners + noise, np.arange(len(corners)).reshape(-1, 3))
    result = repair(loose)
    assert result.mesh.diagnosis.watertight
    assert len(result.mesh.vertices) == len(mesh.vertices)
    assert "960 open edges became 0" in result.done[0]


def test_a_missing_sliver_is_closed_but_the_missing_lid_of_a_box_is_not():
    fine = trimesh.creation.icosphere(subdivisions=4)
    torn = repair(Mesh(fine.vertices, fine.faces[1:]))
    assert torn.mesh.diagnosis.watertight
    assert torn.done == ("small cracks closed with 1 triangle",)
    box = trimesh.creation.box()
    open_box = repair(Mesh(box.vertices, box.faces[2:], "box"))
    assert open_box.done == ()
    assert open_box.remaining == ("the mesh is not a closed solid: 4 open edges (not watertight)",)


def test_only_the_bodies_that_are_inside_out_are_turned():
    result = repair(_joined(_ball(), _flipped(_ball(0.5, (3, 0, 0)))))
    assert result.mesh.volume == pytest.approx(_ball().volume + _ball(0.5).volume)
    assert result.done == ("1 of 2 bodies were inside out and were turned",)
    assert "2 separate bodies" in result.remaining[0]


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_body_that_overlaps_another_is_no_cavity_of_it(side, axis):
    moved = _ball(0.8, side * 0.9 * np.eye(3)[axis])
    result = repair(_joined(_ball(), _flipped(moved)))
    assert [piece.volume for piece in result.mesh.pieces()] == pytest.approx([_ball().volume, moved.volume])
    assert result.done == ("1 of 2 bodies were inside out and were turned",)


def test_the_wall_of_a_cavity_keeps_pointing_inward():
    shell = _joined(_ball(), _flipped(_ball(0.5)))
    result = repair(shell)
    assert result.done == ()
    assert result.mesh.volume == pytest.approx(_ball().volume - _ball(0.5).volume)
    inverted = repair(_flipped(shell))
    assert inverted.mesh.volume == pytest.approx(result.mesh.volume)
    assert inverted.done == ("2 of 2 bodies were inside out and were turned",)


def test_a_mesh_of_nothing_but_degenerate_triangles_is_refused():
    with pytest.raises(DataError, match=r"'line' .*triangle"):
        repair(Mesh([[0, 0, 0], [1, 0, 0]], [[0, 1, 1]], "line"))
