import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainbench.core.errors import UsageError
from brainbench.core.rotations import euler_matrix, to_matrices
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.motion.trajectories import Path, Spin, Translation
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.objects.mesh_solids import shape_solid
from brainbench.stimuli.objects.placed_object import PlacedObject
from brainbench.stimuli.objects.primitives import box, capsule, cylinder, rodgers_solid, sphere
from brainbench.stimuli.whiskers.whisker import Whisker

SOLIDS = [sphere(2e-3), box((1e-3, 2e-3, 3e-3)), cylinder(1e-3, 5e-3), capsule(1e-3, 4e-3), rodgers_solid(segments=4)]


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
