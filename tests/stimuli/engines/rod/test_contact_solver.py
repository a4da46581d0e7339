"""Contact forces of one step: Signorini's and Coulomb's conditions, against brute force over the dense chain."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from brainbench.core.devices import to_struct
from brainbench.stimuli.engines.rod.limits import contact_iterations
from brainbench.stimuli.engines.rod.slices import make_problems
from tests.factories.rod_chain import CAPACITY, DenseChain, in_double
from tests.factories.rod_threads import Memory, thread_warp, values_of

wp = pytest.importorskip("warp")

STEP = 0.5
ARRAYS = (
    "given", "solution", "joint", "held", "candidate", "candidate_link", "predicted_gap", "free_acceleration",
    "added_acceleration",
)  # fmt: skip
LIMITS = ("tolerance", "sweeps", "tries")


def _problem(count, friction, seed, links=8, hinges=2):
    """A chain that something presses from a few sides, and where it would be without contact."""
    rng = np.random.default_rng(seed)
    chain = DenseChain.random(links, seed, hinges)
    nodes = chain.nodes
    link = np.sort(rng.choice(np.arange(1, links), count, replace=False)).astype(np.int32)
    share = rng.uniform(0.1, 0.9, count)
    point = nodes[link] + share[:, None] * (nodes[link + 1] - nodes[link])
    normal = rng.normal(size=(count, 3))
    along = nodes[link + 1] - nodes[link]
    normal -= 0.9 * along * (np.sum(normal * along, axis=1) / np.sum(along**2, axis=1))[:, None]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    # Coming nearer, or a little away, so that some candidates end without force.
    velocity = -normal * rng.uniform(-0.1, 0.3, count)[:, None] + 0.1 * rng.normal(size=(count, 3))
    jacobian = np.array([chain.point_jacobian(p, i)[3:, 6:] for p, i in zip(point, link, strict=True)])
    return SimpleNamespace(
        chain=chain, link=link, point=point, normal=normal, free=velocity, jacobian=jacobian,
        gap=rng.uniform(0, 0.01, count), friction=np.full(count, friction),
        arc=np.cumsum(chain.length)[link] + share, along=along,
    )  # fmt: skip


def _factorised(problem, tolerance=None):
    """What ``write_problem`` leaves of these candidates: fields of ``ContactProblems`` for one job."""
    hinges = problem.chain.hinges
    kernels, passes = (in_double(name, hinges=hinges) for name in ("contact_solver", "articulated_body"))
    real, JointVector, vec3 = wp.float64, passes.JointVector, passes.vec3
    SceneArrays, Step, ContactProblems = passes.SceneArrays, passes.Step, kernels.ContactProblems
    ChainState, ProximityState, ContactCandidates = passes.ChainState, passes.ProximityState, passes.ContactCandidates
    WhiskerJob, WhiskerState, BodyMotion = passes.WhiskerJob, passes.WhiskerState, passes.BodyMotion
    forward_kinematics, articulated_inertia = passes.forward_kinematics, passes.articulated_inertia
    write_problem = kernels.write_problem
    any_gap_closes = kernels.any_gap_closes

    @wp.kernel(enable_backward=False, module="unique")
    def write(
        scene: SceneArrays,
        pose: BodyMotion,
        angle: wp.array(dtype=JointVector),
        link: wp.array(dtype=wp.int32),
        point: wp.array(dtype=vec3),
        normal: wp.array(dtype=vec3),
        free: wp.array(dtype=vec3),
        gap: wp.array(dtype=real),
        friction: wp.array(dtype=real),
        arc: wp.array(dtype=real),
        h: real,
        problems: ContactProblems,
    ):
        job = WhiskerJob()
        job.links = scene.chains.links[0]
        job.beta = scene.chains.beta[0]
        chain = ChainState()
        proximity = ProximityState()
        candidates = ContactCandidates()
        state = WhiskerState()
        for i in range(job.links):
            chain.angle[i] = angle[i]
        for j in range(link.shape[0]):
            candidates.link[j] = link[j]
            candidates.point[j] = point[j]
            candidates.normal[j] = normal[j]
            candidates.free_velocity[j] = free[j]
            candidates.gap[j] = gap[j]
            candidates.friction[j] = friction[j]
            candidates.arc[j] = arc[j]
        last = forward_kinematics(scene.chains, job, pose, chain, proximity, state)
        step = Step()
        step.length = h
        step.pose = pose
        problems.given[0].base = articulated_inertia(scene, job, chain, proximity, step, last, 1)
        any_gap_closes(candidates, link.shape[0], h)
        write_problem(scene, problems, job, chain, proximity, candidates, 0, h, link.shape[0])

    problems = make_problems(SimpleNamespace(structs=kernels), CAPACITY, 1, "cpu", contact_iterations(tolerance))
    pose = BodyMotion()
    pose.quaternion = problem.chain.base_quaternion
    vectors = (wp.array(values, dtype=vec3) for values in (problem.point, problem.normal, problem.free))
    numbers = (wp.array(values, dtype=real) for values in (problem.gap, problem.friction, problem.arc))
    scene = SceneArrays()
    scene.chains = to_struct(in_double("state", hinges=hinges).ChainArrays, problem.chain.arrays(), "cpu")
    inputs = [
        scene, pose,
        wp.array(problem.chain.angle, dtype=JointVector), wp.array(problem.link), *vectors, *numbers, STEP, problems,
    ]  # fmt: skip
    wp.launch(write, 1, inputs, device="cpu")
    return problems


def _solve(problem, tolerance=None):
    """Forces [candidate, 3] in world axes, added accelerations [link, hinge] and the solution."""
    kernels = in_double("contact_solver", hinges=problem.chain.hinges)
    solve_contacts, ContactProblems = kernels.solve_contacts, kernels.ContactProblems

    @wp.kernel(enable_backward=False, module="unique")
    def solve(problems: ContactProblems):
        solve_contacts(problems, 0, 0, 1)

    problems = _factorised(problem, tolerance)
    wp.launch(solve, 1, [problems], device="cpu")
    solution = problems.solution.numpy()[0]
    return _by_candidate(problem, problems.held.numpy()[0], solution), problems.added_acceleration.numpy()[0], solution


def _by_candidate(problem, held, solution):
    forces = np.zeros((len(problem.link), 3))
    for one in held[: solution["contacts"]]:
        forces[np.argmin(np.abs(problem.arc - one["arc"]))] = one["force"]
    return forces


def _compliance(problem):
    """Dense Delassus matrix [candidate, 3, candidate, 3] and inverse joint inertia times Jacobians, transposed."""
    implicit, _ = problem.chain.implicit(STEP)
    flat = problem.jacobian.reshape(-1, implicit.shape[0])
    moved = np.linalg.solve(implicit, flat.T)
    count = len(problem.link)
    return (STEP * flat @ moved).reshape(count, 3, count, 3), moved


@pytest.mark.parametrize("hinges", [2, 3])
@pytest.mark.parametrize("seed", range(6))
def test_without_friction_the_forces_are_those_of_the_only_consistent_set_of_contacts(seed, hinges):
    problem = _problem(4, 0.0, seed, hinges=hinges)
    forces, added, solution = _solve(problem)
    compliance, moved = _compliance(problem)
    n = problem.normal
    normal = np.einsum("ia,iajb,jb->ij", n, compliance, n)
    target = -problem.gap / STEP - np.sum(n * problem.free, axis=1)
    found = []
    for pressing in product([False, True], repeat=4):
        on = np.array(pressing)
        f = np.zeros(4)
        f[on] = np.linalg.solve(normal[np.ix_(on, on)], target[on])
        if (f >= 0).all() and (normal @ f - target >= -1e-9)[~on].all():
            found.append(f)
    assert len(found) == 1
    assert solution["unsolved"] == 0
    scale = max(np.abs(found[0]).max(), 1e-9)
    # Sweeps stop at 1e-4 of the forces, or when gaps are met to 1e-4 mm.
    np.testing.assert_allclose(np.sum(forces * n, axis=1), found[0], atol=2e-3 * scale)
    np.testing.assert_allclose(forces, n * np.sum(forces * n, axis=1)[:, None], atol=1e-9 * scale)
    # What is applied to the joints is what these forces do.
    np.testing.assert_allclose(
        added[: problem.chain.links][problem.chain.free],
        moved @ forces.ravel(),
        atol=1e-9 * max(np.abs(added).max(), 1e-9),
    )


def _coulomb(problem, forces):
    """Return forces [contact] along the normals, rates there, friction and slip [contact, 3]."""
    compliance, _ = _compliance(problem)
    velocity = problem.free + np.einsum("iajb,jb->ia", compliance, forces)
    n = problem.normal
    normal, rate = np.sum(forces * n, axis=1), np.sum(velocity * n, axis=1)
    return normal, rate, forces - normal[:, None] * n, velocity - rate[:, None] * n


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.2, 0.6])
@pytest.mark.parametrize(("hinges", "seed"), [*product([2], range(6)), *product([3], range(4))])
@pytest.mark.parametrize("tolerance", [None, 1e-6, 1e-9])
def test_contacts_keep_signorini_and_coulomb(seed, friction, hinges, tolerance):
    problem = _problem(3, friction, seed, hinges=hinges)
    forces, _, solution = _solve(problem, tolerance)
    assert tolerance is None or solution["unsolved"] == 0
    off = 1e-3 if tolerance is None else 10 * tolerance
    normal, rate, sliding, slip = _coulomb(problem, forces)
    gap = problem.gap + STEP * rate
    size, speed = np.linalg.norm(sliding, axis=1), np.linalg.norm(slip, axis=1)
    scale = np.abs(forces).max()
    assert (normal >= 0).all()
    assert (gap >= -off).all()
    assert (np.abs(gap[normal > 1e-3 * scale]) < off).all()
    assert (size <= friction * normal * (1 + off)).all()
    held = (normal > 1e-3 * scale) & (size < 0.99 * friction * normal)
    assert (speed[held] * STEP < 2 * off).all()
    moving = (normal > 1e-3 * scale) & (speed * STEP > 1e-2)
    opposed = -np.sum(sliding * slip, axis=1)[moving] / (size * speed)[moving]
    assert (1 - opposed < 20 * off).all()


class Records(Memory):
    """An array of Warp's, given as numpy's; elements of a structured one have fields that can be read and set."""

    def __getitem__(self, key: object) -> object:
        return _Record(self.values, key) if self.values.dtype.names else super().__getitem__(key)


class _Record:
    def __init__(self, values: np.ndarray, key: object) -> None:
        object.__setattr__(self, "_at", (values, key))

    def __getattr__(self, name: str) -> object:
        values, key = self._at
        found = values[name][key]
        if found.dtype.names:
            return SimpleNamespace(**{part: found[part].copy() for part in found.dtype.names})
        return found.copy() if isinstance(found, np.ndarray) else found

    def __setattr__(self, name: str, value: object) -> None:
        values, key = self._at
        if values[name].dtype.names:
            value = tuple(tuple(values_of(getattr(value, part))) for part in values[name].dtype.names)
        values[name][key] = value


def pass_joint(joints, joint, twists, step, _each, unit):
    j, w, v = joints[joint], unit.w.values, unit.v.values

    def rates(which):
        motion = getattr(j, f"motion{which}")
        return motion.w @ w + motion.v @ v

    def pass_on(which, rate):
        gain = getattr(j, f"gain{which}")
        w[:] -= np.outer(gain.w, rate)
        v[:] -= np.outer(gain.v, rate)

    inverse = j.inverse_inertia
    if twists:
        unit.joint_rate.values[2] = rates(3)
        unit.impulse.values[2] = step * inverse[3] * unit.joint_rate.values[2]
        pass_on(3, unit.joint_rate.values[2])
    u = unit.joint_rate.values[:2]
    u[:] = rates(1), rates(2)
    unit.impulse.values[:2] = step * np.array([inverse[:2], inverse[1:3]]) @ u
    pass_on(1, u[0])
    pass_on(2, u[1])


def joint_rate(unit, hinge, row):
    return unit.joint_rate.values[hinge, row]


def _columns(matrix, rows, contact):
    return matrix.values.reshape(-1, rows)[3 * contact : 3 * contact + 3]


def add_joint(unit, contact, rate1, rate2, rate3, twists, _first, _each, matrix):
    impulse = unit.impulse.values
    columns = _columns(matrix, impulse.shape[1], contact)
    columns += np.outer(rate1, impulse[0]) + np.outer(rate2, impulse[1])
    if twists:
        columns += np.outer(rate3, impulse[2])


def clear(matrix, _count, _each):
    matrix.values[:] = 0


def add_rates(own, matrix, contact, force, _each):
    own.rate.values += force @ _columns(matrix, len(own.rate.values), contact)


# Few iterations do not find a direction of slip in the second problem.
@pytest.mark.slow
@pytest.mark.parametrize(("seed", "tolerance", "unsolved"), [(1, None, 0), (2, None, 1), (2, 1e-8, 0)])
def test_a_group_of_threads_finds_what_one_finds(seed, tolerance, unsolved):
    problem = _problem(4, 0.4, seed)
    alone, added, told = _solve(problem, tolerance)
    problems = _factorised(problem, tolerance)
    size = 4
    with thread_warp(pass_joint, joint_rate, add_joint, clear, add_rates) as (threads, load):
        solver = load("contact_solver", group_size=size, max_contacts=size, capacity=CAPACITY)
        given = SimpleNamespace(**{name: Records(getattr(problems, name).numpy()) for name in ARRAYS})
        vars(given).update({name: getattr(problems, name) for name in LIMITS})
        # The other groups of the warp have nothing to solve and keep the first company.
        threads.run(lambda thread: solver.solve_contacts(given, 0, thread % size, int(thread < size)))
        held, solution = given.held.values[0], given.solution.values[0]
    assert solution["contacts"] == told["contacts"] >= 2
    assert solution["unsolved"] == told["unsolved"] == unsolved
    scale = np.abs(alone).max()
    np.testing.assert_allclose(_by_candidate(problem, held, solution), alone, atol=1e-6 * scale)
    np.testing.assert_allclose(given.added_acceleration.values[0], added, atol=1e-6 * np.abs(added).max())
