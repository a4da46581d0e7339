import re

import numpy as np
import pytest
import trimesh

from brainbench.core.errors import DataError, MissingDependencyError
from brainbench.core.files import cache_dir
from brainbench.geometry import DecompositionSettings, Mesh, decompose
from brainbench.geometry.decomposition import cutting


def _angle_bracket(name="bracket"):
    """Two boxes joined to an L, of two convex pieces."""
    corners = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)
    flat = np.hstack([np.vstack([corners, corners]), np.repeat([[0.0], [1.0]], 6, axis=0)])
    caps = [[0, 1, 2], [0, 2, 3], [0, 3, 5], [3, 4, 5]]
    bottom = [[a, c, b] for a, b, c in caps]
    top = [[a + 6, b + 6, c + 6] for a, b, c in caps]
    sides = [f for i in range(6) for j in [(i + 1) % 6] for f in ([i, j, j + 6], [i, j + 6, i + 6])]
    return Mesh(flat, bottom + top + sides, name)


@pytest.fixture(scope="module")
def bracket(own_cache):
    return decompose(_angle_bracket())


def test_an_l_is_two_boxes(bracket):
    assert len(bracket.pieces) == 2
    assert sum(piece.volume for piece in bracket.pieces) == pytest.approx(3, rel=0.03)
    assert bracket.deviation.largest < 0.02 * _angle_bracket().diagonal
    assert "2 convex pieces (coacd)" in bracket.notes[0]


def test_pieces_are_closed_outward_and_where_the_mesh_is():
    mesh = _angle_bracket()
    moved = Mesh(mesh.vertices * 1e-3 + [5.0, 0.0, -1.0], mesh.faces)
    pieces = decompose(moved).pieces
    assert all(piece.diagnosis.watertight and piece.volume > 0 for piece in pieces)
    low, high = (np.stack([piece.bounds[i] for piece in pieces]) for i in (0, 1))
    np.testing.assert_allclose([low.min(axis=0), high.max(axis=0)], moved.bounds, atol=2e-5)


def test_one_decomposition_serves_every_size_and_is_found_in_the_cache(bracket, monkeypatch):
    monkeypatch.setattr(cutting, "_run", lambda *_: pytest.fail("computed again"))
    again = decompose(_angle_bracket().scaled(0.04))
    assert again.cached
    assert again.deviation.largest == pytest.approx(0.04 * bracket.deviation.largest)
    for small, large in zip(again.pieces, bracket.pieces, strict=True):
        np.testing.assert_allclose(small.vertices, 0.04 * large.vertices, atol=1e-9)


def test_other_settings_are_another_result_but_other_limits_are_not(bracket, monkeypatch):
    calls = []
    monkeypatch.setattr(cutting, "_run", lambda mesh, settings: calls.append(settings) or [mesh.vertices])
    assert decompose(_angle_bracket(), DecompositionSettings(seconds=60, memory=1e9)).cached
    assert not decompose(_angle_bracket(), DecompositionSettings(threshold=0.5)).cached
    assert len(calls) == 1


def test_a_damaged_cache_is_made_again(monkeypatch, caplog):
    mesh = Mesh(trimesh.creation.box().vertices, trimesh.creation.box().faces, "box")
    monkeypatch.setattr(cutting, "_run", lambda mesh, settings: [mesh.vertices])
    before = set(cache_dir("collision").glob("*.npz"))
    decompose(mesh)
    (path,) = set(cache_dir("collision").glob("*.npz")) - before
    path.write_bytes(b"rubbish")
    assert not decompose(mesh).cached
    assert "damaged" in caplog.text
    assert decompose(mesh).cached


def test_the_limit_of_time_is_kept_in_words():
    with pytest.raises(DataError, match=r"'slow' .*0.05 s .*raise"):
        decompose(_angle_bracket("slow"), DecompositionSettings(seconds=0.05, seed=7))


@pytest.mark.slow
def test_a_mesh_of_too_many_triangles_is_simplified_and_says_by_how_much(monkeypatch):
    ball = trimesh.creation.icosphere(subdivisions=4)
    seen = []
    monkeypatch.setattr(cutting, "_run", lambda mesh, settings: seen.append(mesh) or [mesh.vertices])
    result = decompose(Mesh(ball.vertices, ball.faces), DecompositionSettings(most_faces=2500))
    assert len(seen[0].faces) <= 500
    assert result.notes[0].startswith("5,120 triangles were simplified to 500")
    # 500 equal facets of a sphere have a sagitta of 0.3 % of its diagonal; decimated ones are not as equal.
    assert 0.1 < float(result.notes[0].split("at most ")[1].split("%")[0]) < 1.0


@pytest.mark.parametrize(("method", "package", "extra"), [("coacd", "coacd", "mesh"), ("vhacd", "pybullet", "bullet")])
def test_a_missing_package_names_its_extra(monkeypatch, method, package, extra):
    find = cutting.find_spec
    monkeypatch.setattr(cutting, "find_spec", lambda name: None if name == package else find(name))
    with pytest.raises(MissingDependencyError, match=rf"\[{extra}\]"):
        decompose(_angle_bracket(), DecompositionSettings(method=method, most_faces=4000))


@pytest.mark.slow
def test_a_torus_keeps_its_hole():
    torus = trimesh.creation.torus(1, 0.3, major_sections=48, minor_sections=24)
    result = decompose(Mesh(torus.vertices, torus.faces))
    assert result.deviation.largest < 0.03 * 2.6
    assert len(result.pieces) >= 6


@pytest.mark.slow
def test_a_million_triangles_are_within_the_limits():
    torus = trimesh.creation.torus(0.3, 0.12, major_sections=1000, minor_sections=500)
    result = decompose(Mesh(torus.vertices, torus.faces, "million"))
    assert re.search("1,000,000 .* 10,000", result.notes[0])
    assert result.deviation.largest < 0.03 * Mesh(torus.vertices, torus.faces).diagonal
