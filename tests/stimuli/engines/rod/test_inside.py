"""Whiskers inside objects are found at any depth: against the winding number of the surface, in sweeps and scenes."""

import itertools

import numpy as np
import pytest

from brainbench.core.rotations import base_rotation
from brainbench.geometry import Mesh, winding_number
from brainbench.geometry.mesh import point_triangle_distance
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere
from brainbench.stimuli.objects.procedural import make
from brainbench.stimuli.objects.solid import shape_solid
from brainbench.stimuli.sweeps.plan import simulate_sweeps
from brainbench.stimuli.sweeps.sweep_scenes import SweepGrid, SweepScenes
from tests.factories.engine_scenes import C2

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
        nodes = fidelity.chain(mount.whisker).points
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
    scenes = SweepScenes(grid, [shape_solid(make(family, detail=2000)) for family in ("ellipsoid", "brick")])
    return scenes, np.array([_depths(scene) for scene in scenes])


def test_every_whisker_that_starts_inside_an_object_of_a_data_set_is_flagged(released):
    """Before, those deeper than 3 mm counted as outside: no force, and nothing said."""
    scenes, depth = released
    # As data sets do: on straight links what is unstable on the bent rod.
    batch = simulate_sweeps(scenes, range(len(scenes)), fidelity=COARSE, retry=5)
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


BIG = 0.05


def _sphere(radius):
    import trimesh

    mesh = trimesh.creation.icosphere(4, radius)
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


@pytest.mark.parametrize(
    "obstacle",
    [
        Obstacle((Sphere((0.0, 0.0, 0.0), BIG),)),
        Obstacle((Box((0.0, 0.0, 0.0), (BIG, BIG, BIG)),)),
        Obstacle((Capsule((-BIG, 0.0, 0.0), (BIG, 0.0, 0.0), BIG),)),
        Obstacle((Cylinder((0.0, 0.0, -BIG), (0.0, 0.0, BIG), BIG),)),
        Obstacle((ConvexPart(_sphere(BIG).vertices),)),
        Obstacle((), surface=_sphere(BIG)),
    ],
    ids=["sphere", "box", "capsule", "cylinder", "hull", "mesh"],
)
@pytest.mark.parametrize("backend", ["rod", "mujoco"])
def test_a_whisker_all_in_a_large_object_is_told_its_whole_depth(obstacle, backend):
    """The nearest triangle is 35 mm away, further than the whisker is long."""
    if backend == "mujoco" and obstacle.surface is not None:
        pytest.skip("touches convex bodies only")
    trace = get_engine(backend).run([Job(C2, StillFollicle(), (obstacle,), TIMES)], COARSE)[0]
    assert trace.status == "unstable"
    assert f"starts {BIG * 1e3:.0f}" in trace.reason or f"starts {BIG * 1e3 - 0.1:.1f}" in trace.reason
    assert trace.penetration == pytest.approx(BIG, rel=5e-3)
    assert np.isnan(trace.wrench).all()


@pytest.mark.parametrize("backend", ["rod", "mujoco"])
def test_a_whisker_that_starts_in_touch_is_not_inside(backend):
    ball = Obstacle((Sphere((0.008, 0.005 + float(C2.radius(0.008)) - 1e-5, 0.0), 0.005),), friction=0.0)
    trace = get_engine(backend).run([Job(C2, StillFollicle(), (ball,), TIMES)], COARSE)[0]
    assert trace.status == "ok"
    # A ball that overlaps by 10 µm pushes the whisker away.
    assert trace.contact[0] or trace.penetration == pytest.approx(1e-5, rel=0.1)


def _moved(path, *parts, surface=None):
    def motion(times):
        return np.asarray(path(times), dtype=float), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return Obstacle(parts, motion, friction=0.0, surface=surface)


@pytest.mark.parametrize("kind", ["peg", "thin", "mesh"])
@pytest.mark.parametrize("backend", ["rod", "mujoco"])
def test_an_object_that_moves_through_the_base_point_is_flagged_with_the_time(kind, backend):
    half = {"peg": 2e-4, "thin": 2e-5, "mesh": 1e-4}[kind]
    body = Capsule((0.0, 0.0, -0.01), (0.0, 0.0, 0.01), half)
    import trimesh

    box = trimesh.creation.box(extents=(2 * half, 2 * half, 0.02))
    mesh = Mesh(np.asarray(box.vertices), np.asarray(box.faces))
    if kind == "mesh" and backend == "mujoco":
        pytest.skip("touches convex bodies only")
    # At .2 m/s it reaches the skin of the base, from y = -4 mm, after 20 ms but for its and the whisker's thickness.
    thing = _moved(lambda t: np.outer(t - 0.02, [0.0, 0.2, 0.0]), *(() if kind == "mesh" else (body,)),
                   surface=mesh if kind == "mesh" else None)  # fmt: skip
    times = np.arange(1, 41) * 1e-3
    trace = get_engine(backend).run([Job(C2, StillFollicle(), (thing,), times)], Fidelity(links=10, time_step=2e-4))[0]
    assert "base point" in trace.reason
    expected = 0.02 - (half + C2.base_radius) / 0.2
    assert float(trace.reason.split(" at ")[1].split(" s")[0]) == pytest.approx(expected, abs=4e-4)
    assert np.isfinite(trace.wrench[times < expected - 1e-3]).all()
    assert np.isnan(trace.wrench[times > expected + 1e-3]).all()


def test_an_object_that_passes_behind_the_base_is_not_in_its_way():
    thing = _moved(lambda t: np.add([-5e-4, 0.0, 0.0], np.outer(t - 0.02, [0.0, 0.2, 0.0])),
                   Capsule((0.0, 0.0, -0.01), (0.0, 0.0, 0.01), 2e-4))  # fmt: skip
    times = np.arange(1, 41) * 1e-3
    trace = RodEngine().run([Job(C2, StillFollicle(), (thing,), times)], Fidelity(links=10, time_step=2e-4))[0]
    assert trace.status == "ok"
    assert not trace.contact.any()


@pytest.mark.parametrize("jump", [3e-3, 1e-2, 2e-2])
def test_an_object_that_jumps_onto_the_whisker_is_never_missed(jump):
    """It takes a tenth of a millisecond, far less than a step; a jump in no time is refused (test_motion_pieces)."""

    def left(t):
        return jump * (1 - np.clip((t - 0.01) / 1e-4, 0, 1))

    ball = _moved(lambda t: np.add([0.008, 0.0015, 0.0], np.outer(left(t), [0.0, 1.0, 0.0])),
                  Sphere((0.0, 0.0, 0.0), 0.004))  # fmt: skip
    trace = RodEngine().run([Job(C2, StillFollicle(), (ball,), np.arange(1, 31) * 1e-3)], COARSE)[0]
    assert trace.status == "unstable"
    assert np.isfinite(trace.wrench[:8]).all()
    assert np.isnan(trace.wrench[12:]).all()


def test_a_push_that_no_force_can_resolve_is_not_called_solved():
    """A straight chain does not yield along itself. Forces beyond 1 kN were dropped, and the step called solved."""
    ball = _moved(lambda t: np.add([C2.arc_length + 0.0055, 0, 0], np.outer(np.minimum(t, 0.016), [-0.05, 0, 0])),
                  Sphere((0.0, 0.0, 0.0), 0.005))  # fmt: skip
    trace = RodEngine().run([Job(C2, StillFollicle(), (ball,), np.arange(1, 31) * 1e-3)], COARSE)[0]
    assert trace.penetration < 5e-4
    assert "contact forces missed" in trace.reason
