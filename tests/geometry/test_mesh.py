from __future__ import annotations

import json
import math
import os
from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.geometry import Mesh, deviation, hausdorff, load_mesh, repair, save_mesh, winding_number
from brainbench.geometry.mesh import point_triangle_distance


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


def _cube_file(tmp_path, name="cube.obj"):
    path = tmp_path / name
    trimesh.creation.box(extents=(1.0, 2.0, 3.0)).export(path)
    return path


def test_a_mesh_comes_in_metres(tmp_path):
    mesh = load_mesh(_cube_file(tmp_path), unit="mm")
    np.testing.assert_allclose(mesh.bounds[1] - mesh.bounds[0], [1e-3, 2e-3, 3e-3])
    assert mesh.diagonal == pytest.approx(np.sqrt(14) * 1e-3)


@pytest.mark.parametrize("name", ["cube.stl", "cube.ply", "cube.off", "cube.glb"])
def test_formats_that_repeat_vertices_still_give_a_closed_solid(tmp_path, name):
    mesh = load_mesh(_cube_file(tmp_path, name), unit="m")
    assert len(mesh.vertices) == 8
    assert mesh.diagnosis.watertight
    assert str(mesh.diagnosis) == "watertight"


def test_a_hole_is_diagnosed():
    cube = trimesh.creation.box()
    mesh = Mesh(cube.vertices, cube.faces[:-1])
    assert not mesh.diagnosis.watertight
    assert "3 open edges (not watertight)" in str(mesh.diagnosis)


def test_triangles_without_area_are_counted():
    cube = trimesh.creation.box()
    mesh = Mesh(cube.vertices, np.vstack([cube.faces, [[0, 1, 1]]]))
    assert mesh.diagnosis.degenerate_faces == 1


def test_separate_pieces_are_counted():
    cube = trimesh.creation.box()
    vertices = np.vstack([cube.vertices, cube.vertices + 5])
    mesh = Mesh(vertices, np.vstack([cube.faces, cube.faces + 8]))
    assert mesh.diagnosis.bodies == 2


def test_pieces_come_apart_whole():
    cube = trimesh.creation.box()
    both = Mesh(np.vstack([cube.vertices, cube.vertices * 2 + 5]), np.vstack([cube.faces, cube.faces + 8]))
    small, large = both.pieces()
    assert small.to_trimesh().volume == pytest.approx(1)
    assert large.to_trimesh().volume == pytest.approx(8)
    assert large.diagnosis.bodies == 1


def test_bodies_that_meet_in_a_corner_are_two_and_the_one_inside_out_is_turned():
    cube = trimesh.creation.box()
    pair = trimesh.util.concatenate([cube, trimesh.Trimesh(cube.vertices + 1, cube.faces[:, ::-1])])
    pair.merge_vertices()
    mesh = Mesh(pair.vertices, pair.faces)
    assert (len(mesh.vertices), mesh.diagnosis.bodies, mesh.volume) == (15, 2, 0.0)
    assert [piece.volume for piece in repair(mesh).mesh.pieces()] == pytest.approx([1, 1])


def test_equal_meshes_have_equal_hashes_and_a_moved_vertex_changes_it():
    cube = trimesh.creation.box()
    mesh = Mesh(cube.vertices, cube.faces, "one")
    assert mesh.content_hash == Mesh(cube.vertices, cube.faces, "two").content_hash
    moved = np.array(cube.vertices)
    moved[0, 0] += 1e-9
    assert Mesh(moved, cube.faces).content_hash != mesh.content_hash


def test_scaling_to_a_diagonal_keeps_the_proportions():
    mesh = Mesh(trimesh.creation.box(extents=(1, 2, 3)).vertices, trimesh.creation.box().faces)
    small = mesh.scaled(0.055 / mesh.diagonal)
    assert small.diagonal == pytest.approx(0.055)
    np.testing.assert_allclose(small.vertices / mesh.vertices, 0.055 / np.sqrt(14))


def test_the_hull_of_a_dented_solid_is_larger():
    cube = trimesh.creation.box()
    inside = np.vstack([cube.vertices, [[0, 0, 0]]])
    hull = Mesh(inside, np.vstack([cube.faces, [[0, 1, 8]]])).hull()
    assert hull.to_trimesh().volume == pytest.approx(1.0)
    assert len(hull.vertices) == 8


def test_a_flat_mesh_has_no_hull():
    flat = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]], "sheet")
    with pytest.raises(DataError, match=r"'sheet' .*volume"):
        flat.hull()


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        ([[0, 0, 0]], [], "has no faces"),
        ([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], "not finite"),
        ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 3]], "missing vertices"),
    ],
)
def test_impossible_meshes_are_refused(vertices, faces, message):
    with pytest.raises(DataError, match=message):
        Mesh(vertices, faces)


def test_an_unknown_unit_names_the_nearest(tmp_path):
    with pytest.raises(UsageError, match="'mmm'; did you mean 'mm'"):
        load_mesh(_cube_file(tmp_path), unit="mmm")


def test_a_missing_mesh_file_is_named(tmp_path):
    with pytest.raises(DataFileNotFoundError, match=r"/nothing\.obj'"):
        load_mesh(tmp_path / "nothing.obj", unit="m")


@pytest.mark.parametrize(
    ("name", "content"), [("bad.stl", b"solid \x00"), ("bad.obj", b"nothing here"), ("bad.xyzzy", b"?")]
)
def test_a_file_without_triangles_is_refused(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(DataError, match=name.replace(".", r"\.")):
        load_mesh(path, unit="m")


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb", "off"])
def test_a_saved_mesh_comes_back(tmp_path, suffix):
    mesh = load_mesh(_cube_file(tmp_path), unit="mm")
    path = save_mesh(tmp_path / f"saved.{suffix}", mesh, unit="cm")
    back = load_mesh(path, unit="cm")
    np.testing.assert_allclose(back.bounds, mesh.bounds, rtol=1e-6)
    assert back.diagnosis.watertight
    assert back.volume == pytest.approx(mesh.volume, rel=1e-6)


def test_an_unknown_mesh_format_is_refused_before_anything_is_written(tmp_path):
    mesh = load_mesh(_cube_file(tmp_path), unit="mm")
    with pytest.raises(UsageError, match=r"'\.objj'; did you mean '\.obj'"):
        save_mesh(tmp_path / "out.objj", mesh, unit="m")
    assert not (tmp_path / "out.objj").exists()


def test_the_volume_of_a_closed_mesh_is_signed():
    box = trimesh.creation.box(extents=(1, 2, 3))
    assert Mesh(box.vertices + 10, box.faces).volume == pytest.approx(6)
    assert Mesh(box.vertices, box.faces[:, ::-1]).volume == pytest.approx(-6)


def test_a_turned_mesh_keeps_its_size_and_its_outside():
    solid = trimesh.creation.box(extents=(1, 2, 3))
    box = Mesh(solid.vertices, solid.faces)
    turned = box.transformed([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, 5))
    np.testing.assert_allclose(turned.bounds, [[-1, -0.5, 3.5], [1, 0.5, 6.5]])
    assert turned.volume == pytest.approx(6)
    for matrix in (np.diag([1, 1, -1]), 2 * np.eye(3), np.eye(2), np.full((3, 3), np.nan)):
        with pytest.raises(UsageError, match=r"rotation matrix .*; received \[\["):
            box.transformed(matrix)


def _blocks(path, *, relative=False, normals=False):
    """Three cubes that touch in an L, as objects of one file."""
    lines, seen = [], 0
    corners = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    quads = [(1, 4, 3, 2), (5, 6, 7, 8), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)]
    for at in ((0, 0), (1, 0), (0, 1)):
        lines += [f"o block-{at[0]}{at[1]}", *(f"v {x + at[0]} {y + at[1]} {z}" for x, y, z in corners)]
        lines += ["vn 0 0 1"] * normals
        start = seen - (seen + 8 + 1 if relative else 0)
        lines += ["f " + " ".join(f"{start + i}//1" if normals else str(start + i) for i in quad) for quad in quads]
        seen += 8
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("normals", [False, True])
def test_bodies_that_touch_stay_apart_where_they_shall(tmp_path, relative, normals):
    path = _blocks(tmp_path / "blocks.obj", relative=relative, normals=normals)
    apart = load_mesh(path, unit="m", apart=True)
    assert [piece.volume for piece in apart.pieces()] == pytest.approx([1, 1, 1])
    assert len(load_mesh(path, unit="m").pieces()) == 1


def test_indices_that_count_back_from_their_line_find_their_vertices(tmp_path):
    there = load_mesh(_blocks(tmp_path / "there.obj"), unit="m")
    back = load_mesh(_blocks(tmp_path / "back.obj", relative=True), unit="m")
    np.testing.assert_array_equal(back.vertices, there.vertices)
    np.testing.assert_array_equal(back.faces, there.faces)


@pytest.mark.parametrize("first", range(6))
def test_a_concave_polygon_that_was_cut_into_a_fan_is_diagnosed(tmp_path, first):
    corners = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2))]
    cap = [(first + i) % 6 + 1 for i in range(6)]
    walls = [(i + 1, (i + 1) % 6 + 1, (i + 1) % 6 + 7, i + 7) for i in range(6)]
    faces = [cap[::-1], [i + 6 for i in cap], *walls]
    path = tmp_path / "bracket.obj"
    lines = ["v {} {} {}".format(*corner) for corner in corners] + ["f " + " ".join(map(str, f)) for f in faces]
    path.write_text("\n".join(lines))
    mesh = load_mesh(path, unit="m")
    area = np.linalg.norm(np.cross(*np.diff(mesh.vertices[mesh.faces], axis=1).swapaxes(0, 1)), axis=1).sum() / 2
    # A fan that is right covers 14 m²; what lies outside the bracket is covered twice.
    assert (mesh.diagnosis.folded_edges > 0) == (area > 14.1)
    assert ("back to back" in str(mesh.diagnosis)) == (area > 14.1)


_CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
_FACES = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.mark.parametrize("name", ["pipe.mtl", "/dev/zero", "../outside.mtl", "gone.mtl"])
def test_materials_that_cannot_be_read_are_left_out(tmp_path, name):
    os.mkfifo(tmp_path / "pipe.mtl")
    (tmp_path / "a.obj").write_text(f"mtllib {name}\n{_CORNERS}usemtl x\n{_FACES}")
    assert load_mesh(tmp_path / "a.obj", unit="mm").volume == pytest.approx(1e-9 / 6)


@pytest.mark.parametrize("name", ["pipe.bin", "/dev/zero", "../outside.bin", "gone.bin"])
def test_buffers_of_a_mesh_are_regular_files_of_its_folder(tmp_path, name):
    folder = tmp_path / "in"
    folder.mkdir()
    os.mkfifo(folder / "pipe.bin")
    buffers = np.arange(12, dtype="<f4").tobytes() + np.arange(12, dtype="<u2").tobytes()
    (tmp_path / "outside.bin").write_bytes(buffers)
    (folder / "good.bin").write_bytes(np.eye(4, 3, dtype="<f4").tobytes() + np.arange(12, dtype="<u2").tobytes())
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": 72, "uri": name}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
                      {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"}],
    }  # fmt: skip
    (folder / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(DataError):
        load_mesh(folder / "a.gltf", unit="mm")


def _mesh(solid):
    return Mesh(solid.vertices, solid.faces)


def _box(*size, at=(0.0, 0.0, 0.0)):
    box = trimesh.creation.box(extents=size)
    return Mesh(box.vertices + np.asarray(at), box.faces)


def test_the_winding_number_is_one_inside_and_zero_outside():
    torus = _mesh(trimesh.creation.torus(1.0, 0.3))
    np.testing.assert_allclose(
        winding_number(torus, [[1, 0, 0], [0, 0, 0], [0, 1.1, 0.1], [2, 2, 2]]), [1, 0, 1, 0], atol=1e-9
    )


def test_a_hemisphere_wraps_half_way_round_its_centre():
    ball = trimesh.creation.icosphere(subdivisions=4)
    upper = ball.faces[ball.triangles_center[:, 2] > 0]
    assert winding_number(Mesh(ball.vertices, upper), [[0, 0, 0]])[0] == pytest.approx(0.5, abs=0.01)


SLIVER = [[-0.25, 0.0, 0.0], [0.0, 3.6e-7, 0.0], [-0.75, 0.0, 0.0], [0.0, 0.0, 0.0]]


@settings(max_examples=60)
@example(np.array(SLIVER))
@example(np.array([[0.2, 0.3, 0.4], [0.0, 0.0, 0.0], [1e-20, 0.0, 0.0], [0.0, 1.0, 0.0]]))
@example(np.array([[1.0, 0.0, 0.0], [1e-38, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1e-38, 0.0]]))
@given(arrays(float, (4, 3), elements=st.floats(-1, 1, width=32)))
def test_the_distance_from_a_triangle_is_that_of_its_nearest_point(corners):
    point, triangle = corners[0], corners[1:]
    share = np.linspace(0, 1, 60)
    u, v = np.meshgrid(share, share)
    inside = u + v <= 1
    spread = triangle[0] + u[inside, None] * (triangle[1] - triangle[0]) + v[inside, None] * (triangle[2] - triangle[0])
    sampled = np.linalg.norm(spread - point, axis=1).min()
    exact = point_triangle_distance(point[None], triangle[None])[0]
    size = np.ptp(triangle, axis=0).max()
    assert exact <= sampled + 1e-9
    assert exact >= sampled - size / 20 - 1e-12


def _exact_distance(point, triangle):
    """Distance in rational arithmetic: the nearest of the feet on corners, edges and plane that lie in the triangle."""
    p = [Fraction(x) for x in point]
    corners = [[Fraction(x) for x in corner] for corner in triangle]

    def dot(u, v):
        return sum(x * y for x, y in zip(u, v, strict=True))

    def less(u, v):
        return [x - y for x, y in zip(u, v, strict=True)]

    squares = []
    for count in (1, 2, 3):
        for first, *others in combinations(corners, count):
            span, there = [less(other, first) for other in others], less(p, first)
            gram = [[dot(u, v) for v in span] for u in span]
            right = [dot(u, there) for u in span]
            # Cramer's rule for the foot's coordinates in the span of the edges.
            if count == 1:
                shares = []
            elif count == 2:
                if gram[0][0] == 0:
                    continue
                shares = [right[0] / gram[0][0]]
            else:
                whole = gram[0][0] * gram[1][1] - gram[0][1] ** 2
                if whole == 0:
                    continue
                shares = [
                    (right[0] * gram[1][1] - right[1] * gram[0][1]) / whole,
                    (right[1] * gram[0][0] - right[0] * gram[0][1]) / whole,
                ]
            if min([*shares, 1 - sum(shares)]) >= 0:
                for share, edge in zip(shares, span, strict=True):
                    there = less(there, [share * x for x in edge])
                squares.append(dot(there, there))
    return math.sqrt(min(squares))


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-5, 1e-8])
def test_triangles_of_any_size_are_as_far_as_exact_arithmetic_says(size):
    rng = np.random.default_rng(3)
    triangles = rng.normal(size=(400, 3, 3))
    # Slivers, and triangles that lie somewhere else than at the origin.
    triangles[:100, 2] = triangles[:100, 0] + rng.normal(size=(100, 1)) * (triangles[:100, 1] - triangles[:100, 0])
    triangles[:100, 2] += 10.0 ** rng.uniform(-12, -2, (100, 1)) * rng.normal(size=(100, 3))
    triangles = size * triangles + rng.choice([0.0, 0.1], (400, 1, 1))
    points = triangles.mean(axis=1) + size * 10 ** rng.uniform(-3, 1, (400, 1)) * rng.normal(size=(400, 3))
    exact = [_exact_distance(point, triangle) for point, triangle in zip(points, triangles, strict=True)]
    # Coordinates of a decimetre are rounded to 1e-17 m.
    np.testing.assert_allclose(point_triangle_distance(points, triangles), exact, rtol=1e-6, atol=1e-15 + 1e-11 * size)


def test_of_a_triangle_without_an_area_the_nearest_corner_counts():
    corners = np.array([[5.67037439e-08, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert point_triangle_distance(np.zeros((1, 3)), corners[None])[0] == 0.0


def test_equal_surfaces_are_no_distance_apart_and_a_shift_is_its_length():
    box = _box(1, 2, 3)
    assert hausdorff(box, box) == pytest.approx(0, abs=1e-12)
    assert hausdorff(box, _box(1, 2, 3.2)) == pytest.approx(0.1, rel=0.02)


def test_concentric_balls_differ_by_their_radii():
    small, large = (_mesh(trimesh.creation.icosphere(4, radius)) for radius in (1.0, 1.2))
    assert hausdorff(small, large) == pytest.approx(0.2, rel=0.01)


def test_exact_pieces_do_not_deviate_even_when_they_overlap_or_touch():
    whole = _box(2, 1, 1)
    halves = [_box(1, 1, 1, at=(-0.5, 0, 0)), _box(1, 1, 1, at=(0.5, 0, 0))]
    overlapping = [_box(1.5, 1, 1, at=(-0.25, 0, 0)), _box(1.5, 1, 1, at=(0.25, 0, 0))]
    for pieces in (halves, overlapping, [whole]):
        found = deviation(whole, pieces)
        assert found.largest == pytest.approx(0, abs=1e-9)


def test_a_deviation_needs_pieces():
    with pytest.raises(UsageError, match=r"pieces .*at least 1; received 0"):
        deviation(_box(2, 1, 1), [])


def test_what_is_added_and_what_is_missing_are_told_apart():
    whole = _box(2, 1, 1)
    assert deviation(whole, [_box(2.2, 1, 1)]).outward == pytest.approx(0.1, rel=0.02)
    assert deviation(whole, [_box(2.2, 1, 1)]).inward == 0
    short = deviation(whole, [_box(1.6, 1, 1)])
    assert short.inward == pytest.approx(0.2, rel=0.02)
    assert short.outward == pytest.approx(0, abs=1e-12)


def test_filling_the_hole_of_a_ring_counts_by_its_depth():
    torus = _mesh(trimesh.creation.torus(1.0, 0.2, major_sections=64, minor_sections=32))
    found = deviation(torus, [torus.hull()])
    # The middle of the lid over the hole lies √(1² + .2²) − .2 from the tube, the centre of the hole 0.8.
    assert 0.78 < found.outward <= np.hypot(1, 0.2) - 0.2 + 0.01
    assert found.inward == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("samples", [0, -5, 1.5])
def test_no_distance_is_told_without_a_sample(samples):
    box = _box(1, 1, 1)
    with pytest.raises(UsageError, match=f"samples .*at least 1; received {samples}"):
        deviation(box, [box], samples=samples)
