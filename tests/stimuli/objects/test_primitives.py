import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from brainbench.core.errors import UsageError
from brainbench.geometry import load_mesh
from brainbench.stimuli.objects.primitives import RODGERS_CONTROL, rodgers_solid


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
