import json
import os

import numpy as np
import pytest
import trimesh

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.geometry import Mesh, load_mesh, save_mesh


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
