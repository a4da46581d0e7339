"""The three passes over a chain, against its dense mass matrix."""

import numpy as np
import pytest

from brainbench.core.devices import to_struct
from tests.factories.rod_chain import DenseChain, in_double

wp = pytest.importorskip("warp")

STEP = 0.5


def _passes(chain, accelerations, load=None):
    """Joint accelerations [n, hinge], wrenches on the base [n, 6] and accelerations of the tip [n, 3]."""
    kernels = in_double("articulated_body", hinges=chain.hinges)
    real, JointVector, vec3 = wp.float64, kernels.JointVector, kernels.vec3
    SceneArrays, Step = kernels.SceneArrays, kernels.Step
    WhiskerJob, WhiskerState, ChainState = kernels.WhiskerJob, kernels.WhiskerState, kernels.ChainState
    ProximityState, ContactCandidates, BodyMotion = (
        kernels.ProximityState,
        kernels.ContactCandidates,
        kernels.BodyMotion,
    )
    spatial = kernels.spatial
    forward_kinematics, articulated_inertia = kernels.forward_kinematics, kernels.articulated_inertia
    joint_accelerations, row = kernels.joint_accelerations, kernels.row

    @wp.kernel(enable_backward=False, module="unique")
    def passes(
        scene: SceneArrays,
        pose: BodyMotion,
        angle: wp.array(dtype=JointVector),
        rate: wp.array(dtype=JointVector),
        acceleration: wp.array2d(dtype=vec3),
        h: real,
        loads: int,
        joints: wp.array2d(dtype=JointVector),
        wrench: wp.array2d(dtype=vec3),
        tip: wp.array(dtype=vec3),
    ):
        k = wp.tid()
        job = WhiskerJob()
        job.links = scene.chains.links[0]
        job.beta = scene.chains.beta[0]
        job.end_load = loads
        chain = ChainState()
        proximity = ProximityState()
        candidates = ContactCandidates()
        state = WhiskerState()
        for i in range(job.links):
            chain.angle[i] = angle[i]
            chain.rate[i] = rate[i]
        step = Step()
        step.length = h
        step.pose = pose
        step.base = spatial(acceleration[k, 0], acceleration[k, 1])
        last = forward_kinematics(scene.chains, job, pose, chain, proximity, state)
        felt = articulated_inertia(scene, job, chain, proximity, step, last, 1)
        tip[k] = joint_accelerations(scene, job, chain, candidates, state, step, 1)
        wrench[k, 0] = felt.w
        wrench[k, 1] = felt.v
        for i in range(job.links):
            joints[k, i] = row(chain.acceleration, i)

    loads = {name: np.zeros(2, dtype=np.int32) for name in ("whisker", "scene", "base", "row", "column", "load_first")}
    link, share, force = load or (0, 0.0, np.zeros(3))
    loads |= {"step": np.zeros(1), "load_link": np.array([link], dtype=np.int32), "load_share": np.array([share])}
    loads |= {"load_force": np.array([force]), "load_stop": np.array([1e30])}
    pose = BodyMotion()
    pose.quaternion, pose.spin, pose.velocity = chain.base_quaternion, chain.base_twist[:3], chain.base_twist[3:]
    n = len(accelerations)
    joints, wrench = wp.zeros((n, chain.links), dtype=JointVector), wp.zeros((n, 2), dtype=vec3)
    tip = wp.zeros(n, dtype=vec3)
    scene, structs = SceneArrays(), in_double("state", hinges=chain.hinges)
    scene.chains = to_struct(structs.ChainArrays, chain.arrays(), "cpu")
    scene.jobs = to_struct(structs.JobArrays, loads, "cpu")
    inputs = [
        scene, pose,
        wp.array(chain.angle, dtype=JointVector), wp.array(chain.rate, dtype=JointVector),
        wp.array(np.reshape(accelerations, (n, 2, 3)), dtype=vec3), STEP, int(load is not None), joints, wrench, tip,
    ]  # fmt: skip
    wp.launch(passes, n, inputs, device="cpu")
    return joints.numpy()[:, chain.free], wrench.numpy().reshape(n, 6), tip.numpy()


@pytest.mark.parametrize("hinges", [2, 3])
def test_the_articulated_inertia_is_the_schur_complement_of_the_mass_matrix(hinges):
    chain = DenseChain.random(hinges=hinges)
    chain.rate[:], chain.base_twist[:] = 0, 0
    _, wrench, _ = _passes(chain, np.vstack([np.zeros(6), np.eye(6)]))
    found = (wrench[1:] - wrench[0]).T
    dense, (joints, _) = chain.mass_matrix(), chain.implicit(STEP)
    expected = dense[:6, :6] - dense[:6, 6:] @ np.linalg.solve(joints, dense[6:, :6])
    np.testing.assert_allclose(found, expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("beta", [0.1, 2.0])
@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize("hinges", [2, 3])
def test_joints_accelerate_as_the_dense_equation_of_motion_says(beta, loaded, hinges):
    chain = DenseChain.random(links=8, seed=1, hinges=hinges)
    chain.beta = beta
    rng = np.random.default_rng(2)
    given = rng.normal(size=(4, 6))
    load = (5, 0.3, rng.normal(size=3)) if loaded else None
    joints, wrench, tip = _passes(chain, given, load)
    dense, bias, (implicit, spring) = chain.mass_matrix(), chain.bias(), chain.implicit(STEP)
    nodes = chain.nodes
    pushed = np.zeros(6 + np.count_nonzero(chain.free))
    if load is not None:
        point = nodes[load[0]] + load[1] * (nodes[load[0] + 1] - nodes[load[0]])
        pushed = chain.point_jacobian(point, load[0])[3:].T @ load[2]
    spin, velocity = chain.base_twist[:3], chain.base_twist[3:]
    for k, base in enumerate(given):
        # The base's spatial acceleration leaves out how its point is carried along.
        base = base + np.concatenate([np.zeros(3), np.cross(spin, velocity)])
        force = spring + (pushed - bias)[6:] - dense[6:, :6] @ base
        expected = np.linalg.solve(implicit, force)
        np.testing.assert_allclose(joints[k], expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
        # Newton and Euler for all links together.
        total = dense[:6, :6] @ base + dense[:6, 6:] @ expected + (bias - pushed)[:6]
        np.testing.assert_allclose(wrench[k], total, rtol=1e-8, atol=1e-8 * np.abs(total).max())
    # Of two runs that differ in the acceleration of the base alone, the tips differ by what the Jacobian says.
    jacobian = chain.point_jacobian(nodes[-1], chain.links - 1)[3:]
    change = np.concatenate([given[1] - given[0], joints[1] - joints[0]])
    np.testing.assert_allclose(tip[1] - tip[0], jacobian @ change, atol=1e-8)
