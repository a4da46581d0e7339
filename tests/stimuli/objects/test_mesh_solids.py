import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from brainbench.core.errors import DataError, UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.geometry import DecompositionSettings, Mesh
from brainbench.stimuli.motion.trajectories import Translation
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.objects.mesh_solids import mesh_solid, shape_solid, touchable
from brainbench.stimuli.objects.placed_object import PlacedObject
from brainbench.stimuli.objects.primitives import rodgers_solid, sphere


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
