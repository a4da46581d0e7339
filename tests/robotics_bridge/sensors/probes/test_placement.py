"""Probes in grids, lists and on patches of meshes."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from robotics_bridge.sensors import Probes


def _ball() -> Mesh:
    made = trimesh.creation.icosphere(4, 0.02)
    return Mesh(made.vertices, made.faces)


def test_a_grid_is_regular_and_ordered_by_rows() -> None:
    grid = Probes.grid(3, 5, size=(0.02, 0.04), center=(0, 0, 0.1), normal=(0, 0, 2.0), along=(0, 1, 0.7), radius=0.003)
    place = grid.position.reshape(3, 5, 3)
    np.testing.assert_allclose(place[0, 1] - place[0, 0], [0, 0.01, 0], atol=1e-12)
    np.testing.assert_allclose(np.abs(place[1, 0] - place[0, 0]), [0.01, 0, 0], atol=1e-12)
    np.testing.assert_allclose(grid.position.mean(axis=0), [0, 0, 0.1], atol=1e-12)
    assert grid.shape == (3, 5)
    assert grid.pitch == pytest.approx((0.01, 0.01))


def test_a_patch_of_a_mesh_is_covered_evenly_with_its_normals() -> None:
    patch = Probes.on_mesh(_ball(), 60, facing=(0, 0, 1), within=60)
    np.testing.assert_allclose(np.linalg.norm(patch.position, axis=1), 0.02, rtol=4e-3)
    np.testing.assert_allclose(
        (patch.normal * patch.position).sum(1), np.linalg.norm(patch.position, axis=1), rtol=4e-3
    )
    assert (patch.normal[:, 2] > np.cos(np.radians(60)) - 1e-9).all()
    gaps = np.linalg.norm(patch.position[:, None] - patch.position[None], axis=2) + np.eye(60)
    # Even points on this cap would lie 4.9 mm apart.
    assert gaps.min() > 0.5 * 0.0049
    boxed = Probes.on_mesh(_ball(), 20, box=[[0, -1, -1], [1, 1, 1]])
    assert (boxed.position[:, 0] > -1e-3).all()


def test_fillers_keep_their_places_and_need_no_normal() -> None:
    probes = Probes([[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 3.0]], [0.0, 0.01])
    assert probes.active.tolist() == [False, True]
    np.testing.assert_allclose(probes.normal[1], [0, 0, 1])
    assert probes.with_radius(0.02).radius.tolist() == [0, 0.02]


def _rhombs() -> Probes:
    """Return a grid whose rows and columns are even, but whose rows lean by 30°."""
    row, column = np.divmod(np.arange(9), 3)
    places = np.stack([column + 0.5 * row, np.sqrt(0.75) * row, 0.0 * row], axis=1)
    return Probes(1e-3 * places, np.tile([0.0, 0, 1], (9, 1)), 1e-3, (3, 3), pitch=(1e-3, 1e-3))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Probes([], [], 0.1), "at least one probe"),
        (lambda: Probes([[0, 0, 0]], [[0, 0, 0]], 0.1), "needs a length"),
        (lambda: Probes([[0, 0, 0]], [[0, 0, 1]], -0.1), "or 0 for a filler"),
        (lambda: Probes([[0, 0, 0]] * 4, [[0, 0, 1]] * 4, 0.1, (3, 2)), r"shape \(3, 2\)"),
        (lambda: Probes([[0, 0, 0]] * 4, [[0, 0, 1]] * 4, 0.1, (-2, -2)), r"shape .*at least 1; received -2"),
        (lambda: Probes([[0, 0, 0]], [[0, 0, 1]], 0.1, (True, 1)), "shape .*received True"),
        (lambda: Probes([[0, 0, 0]], [[0, 0, 1]], 0.1, pitch=(0.1, True)), "pitch .*received True"),
        (lambda: Probes([[0, 0, 0]] * 4, [[0, 0, 1]] * 4, [0.1, 0.1]), "one radius or 4"),
        (lambda: Probes([[0, 0, np.nan]], [[0, 0, 1]], 0.1), "finite"),
        (lambda: Probes([[0, 0, 0], [9, 0, 0], [12, 0, 0]], [[0, 0, 1]] * 3, 4.0), "not mm"),
        (_rhombs, "do not form"),
        (lambda: Probes.grid(2, 2, size=(1, 1), along=(0, 0, 1)), "parallel to the normal"),
        (lambda: Probes.grid(0, 2, size=(1, 1)), "rows .*at least 1; received 0"),
        (lambda: Probes.grid(2, 1.5, size=(1, 1)), r"columns .*received 1\.5"),  # type: ignore[arg-type]
        (lambda: Probes.grid(2, 2, size=(1, 1), normal=(0, 0, 0)), "'normal' is a direction"),
        (lambda: Probes.on_mesh(_ball(), -1), "count must be a whole number"),
        (lambda: Probes.on_mesh(_ball(), 5, facing=(0, 0, 0)), "'facing' is a direction"),
        (lambda: Probes.on_mesh(_ball(), 5, box=(1, 2, 3)), "two corners"),  # type: ignore[arg-type]
        (lambda: Probes.on_mesh(_ball(), 5, box=[[1, 1, 1], [2, 2, 2]]), "No triangle"),
    ],
)
def test_mistakes_are_named(make: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()  # type: ignore[operator]
