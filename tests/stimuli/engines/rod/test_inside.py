"""Whiskers inside objects are found at any depth: against the winding number of the surface, in sweeps and scenes."""

import itertools

import numpy as np
import pytest

from brainbench.geometry import Mesh, winding_number
from brainbench.geometry.distance import point_triangle_distance
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.protocol import base_rotation
from brainbench.stimuli.objects.mesh_solids import shape_solids
from brainbench.stimuli.sweeps.grid import SweepGrid
from brainbench.stimuli.sweeps.simulation import simulate_sweeps
from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes

pytest.importorskip("warp")

COARSE = Fidelity(links=10, time_step=1e-3)
TIMES = np.arange(1, 6) * 1e-3


def _depths(scene, fidelity=COARSE):
    """Deepest overlap [whisker] (m) of the unbent chains with the scene's one surface at t = 0, and axes inside."""
    (placed,) = scene.objects
    obstacle = placed.obstacle()
    surface, shift = obstacle.surface, np.zeros(3)
    if obstacle.motion is not None:
        shift = obstacle.motion(np.zeros(1))[0][0]
    corners = surface.vertices[surface.faces] + shift
    found = []
    for mount in scene.array:
        nodes = np.pad(fidelity.chain(mount.whisker).points, ((0, 0), (0, 1)))
        share = np.linspace(0, 1, 9)[:, None]
        points = np.concatenate([a + share * (b - a) for a, b in itertools.pairwise(nodes)])
        local = points @ base_rotation(mount.angles).T + mount.position
        world = local @ scene.head.matrix.T + scene.head.position
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        world = world[((low < world) & (world < high)).all(axis=1)]
        inside = winding_number(Mesh(surface.vertices + shift, surface.faces), world) > 0.5
        depth = [point_triangle_distance(np.tile(x, (len(corners), 1)), corners).min() for x in world[inside]]
        found.append(max(depth, default=0.0))
    return np.array(found)


@pytest.fixture(scope="module")
def released():
    """Large objects in the released placing, which start inside the array, and how deep each whisker then is."""
    grid = SweepGrid(start=0.016, placing="released", size=(0.05,), rotation=(0.0,), distance=(0.005,))
    scenes = SweepScenes(grid, shape_solids(["ellipsoid", "brick"], detail=2000))
    return scenes, np.array([_depths(scene) for scene in scenes])


def test_every_whisker_that_starts_inside_an_object_of_a_data_set_is_flagged(released):
    """Before, those deeper than 3 mm counted as outside: no force, and nothing said."""
    scenes, depth = released
    batch = simulate_sweeps(scenes, range(len(scenes)), fidelity=COARSE)
    assert (depth > 3e-3).sum() > 15
    assert (batch.unstable | (depth < 2e-5)).all()
    assert not (batch.unstable & (depth == 0)).any()
    assert all(
        ("deep in an object" in words) == (deep.max() > 2e-5) for words, deep in zip(batch.reasons, depth, strict=True)
    )


def test_the_depth_that_is_told_is_the_true_one(released):
    scenes, depth = released
    worst = int(depth.max(axis=1).argmax())
    from brainbench.stimuli import simulate

    dataset = simulate(scenes[worst], fidelity=COARSE, cache=False)
    told, status = dataset["penetration"].values[0], dataset["status"].values[0]
    assert (status[depth[worst] > 2e-5] == "unstable").all()
    # The kernel looks at eight places of each link; the thickness of the whisker (50 µm) counts for it.
    deep = depth[worst] > 5e-4
    np.testing.assert_allclose(told[deep], depth[worst][deep], atol=1.5e-4)
