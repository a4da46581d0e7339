"""The broad phase, along a moving whisker beside spheres: bounds of distances hold, and nothing near is missed."""

import numpy as np
import pytest

from brainbench.core.devices import to_struct
from brainbench.stimuli.engines.rod.limits import SPHERE
from tests.factories.rod_chain import DenseChain, in_double

wp = pytest.importorskip("warp")

STEP, STEPS = 0.2, 150


def _run(chain, centres, radii, velocity):
    """Run the broad phase beside moving spheres.

    Returns joints [step, link + 1, 3], bounds [step, link], candidates (gap, link) of each step, margins and how many
    links were measured.
    """
    kernels = in_double("broad_phase")
    real, vec2, vec3 = wp.float64, kernels.vec3, kernels.vec3
    vec2 = in_double("algebra").vec2
    passes = in_double("articulated_body")
    SceneArrays, Step = kernels.SceneArrays, kernels.Step
    ContactProblems, PausedWhiskers, WhiskerJob = kernels.ContactProblems, kernels.PausedWhiskers, kernels.WhiskerJob
    ChainState, ProximityState, WhiskerState = kernels.ChainState, kernels.ProximityState, kernels.WhiskerState
    ContactCandidates, NearShapes, row = kernels.ContactCandidates, kernels.NearShapes, kernels.row
    instant, pose_at = kernels.instant, in_double("motion").pose_at
    search_range, count_near_links = kernels.search_range, kernels.count_near_links
    lower_clearance, find_candidates = kernels.lower_clearance, kernels.find_candidates
    forward_kinematics = passes.forward_kinematics
    most = kernels.most_candidates

    @wp.kernel(enable_backward=False, module="unique")
    def follow(
        scene: SceneArrays,
        problems: ContactProblems,
        paused: PausedWhiskers,
        angle: wp.array(dtype=vec2),
        rate: wp.array(dtype=vec2),
        speed: real,
        h: real,
        nodes: wp.array2d(dtype=vec3),
        bound: wp.array2d(dtype=real),
        gap: wp.array2d(dtype=real),
        link: wp.array2d(dtype=wp.int32),
        margin: wp.array(dtype=real),
        measured: wp.array(dtype=wp.int32),
    ):
        job = WhiskerJob()
        job.links = scene.chains.links[0]
        job.end_shape = scene.shapes.kind.shape[0]
        job.object_speed = speed
        chain = ChainState()
        proximity = ProximityState()
        near = NearShapes()
        candidates = ContactCandidates()
        state = WhiskerState()
        for i in range(job.links):
            chain.angle[i] = angle[i]
            chain.rate[i] = rate[i]
        for t in range(nodes.shape[0]):
            when = instant(0, real(t) * h)
            step = Step()
            step.now = when
            step.length = h
            step.pose = pose_at(scene.motions, 0, when)
            pose = step.pose
            forward_kinematics(scene.chains, job, pose, chain, proximity, state)
            reach = search_range(scene, job, state, h)
            measured[t] = count_near_links(scene, job, proximity, reach)
            lower_clearance(job, proximity, near, reach)
            state.last_step = h
            step.margin = reach.margin
            found = find_candidates(scene, problems, paused, job, chain, proximity, near, candidates, state, step)
            margin[t] = reach.margin
            for j in range(found):
                gap[t, j] = row(candidates.gap, j)
                link[t, j] = row(candidates.link, j)
            for i in range(job.links):
                bound[t, i] = row(proximity.clearance, i)
                nodes[t, i] = row(chain.node, i) + pose.place
                chain.angle[i] = row(chain.angle, i) + row(chain.rate, i) * h
            nodes[t, job.links] = row(chain.node, job.links) + pose.place

    count, n = len(radii), chain.links
    still = np.tile([1.0, 0, 0, 0], (count + 1, 1))
    motions = {
        "first": np.arange(count + 1, dtype=np.int32), "count": np.ones(count + 1, dtype=np.int32),
        "cell": np.zeros(1, dtype=np.int32), "coarse": np.zeros((count + 1, 3)),
        "place": np.vstack([np.zeros(3), centres]),
        "velocity": np.vstack([chain.base_twist[3:], velocity]), "quaternion": still,
        "spin": np.zeros((count + 1, 3)), "surge": np.zeros((count + 1, 3)),
    }  # fmt: skip
    motions["quaternion"][0] = chain.base_quaternion
    shapes = {
        "kind": np.full(count, SPHERE, dtype=np.int32), "size": np.stack([radii] * 3, axis=1),
        "place": np.zeros((count, 3)), "quaternion": still[1:], "scale": np.ones(count), "friction": np.zeros(count),
        "track": np.arange(1, count + 1, dtype=np.int32),
    }  # fmt: skip
    shapes |= dict.fromkeys(("face", "faces", "box"), np.zeros(count, dtype=np.int32))
    nodes, bound = wp.zeros((STEPS, n + 1), dtype=vec3), wp.zeros((STEPS, n), dtype=real)
    gap, link = wp.full((STEPS, most), np.inf, dtype=real), wp.full((STEPS, most), -1, dtype=wp.int32)
    margin, measured = wp.zeros(STEPS, dtype=real), wp.zeros(STEPS, dtype=wp.int32)
    speed = np.linalg.norm(velocity, axis=1).max()
    scene, structs = SceneArrays(), in_double("state")
    scene.chains = to_struct(structs.ChainArrays, chain.arrays(), "cpu")
    scene.motions = to_struct(structs.MotionArrays, motions, "cpu")
    scene.shapes = to_struct(structs.ShapeArrays, shapes, "cpu")
    inputs = [
        scene, ContactProblems(), PausedWhiskers(), wp.array(chain.angle, dtype=vec2),
        wp.array(chain.rate, dtype=vec2), float(speed), STEP, nodes, bound, gap, link, margin, measured,
    ]  # fmt: skip
    wp.launch(follow, 1, inputs, device="cpu")
    return tuple(x.numpy() for x in (nodes, bound, gap, link, margin, measured))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_bounds_hold_and_nothing_near_is_missed(seed):
    rng = np.random.default_rng(seed)
    chain = DenseChain.random(links=8, seed=seed)
    chain.rate *= 0.1
    # Spheres that begin a few millimetres beside the whisker and cross it.
    target = chain.nodes[[3, 6, 8]]
    side = rng.normal(size=(3, 3))
    side /= np.linalg.norm(side, axis=1)[:, None]
    centres, velocity = target + 4 * side, -side * 0.25 + chain.base_twist[3:]
    radii = np.array([0.3, 0.6, 1.0])
    nodes, bound, gap, link, margin, measured = _run(chain, centres, radii, velocity)
    moved = centres + STEP * np.arange(STEPS)[:, None, None] * velocity
    share = np.linspace(0, 1, 201)[:, None]
    ends = np.linspace(0.05, 0.01, chain.links + 1)
    true, gaps = np.empty(bound.shape), np.empty(bound.shape)
    for i in range(chain.links):
        axis = nodes[:, i, None] + share * (nodes[:, i + 1] - nodes[:, i])[:, None]
        away = np.linalg.norm(axis[:, :, None] - moved[:, None], axis=-1) - radii
        true[:, i] = away.min(axis=(1, 2))
        gaps[:, i] = (away.min(axis=2) - (ends[i] + share[:, 0] * (ends[i + 1] - ends[i]))).min(axis=1)
    assert (bound <= true + 1e-6).all()
    near = gaps.min(axis=1) < margin - 1e-3
    assert 5 < near.sum() < STEPS
    # Where anything is within the margin, the nearest of it is a candidate, on its link or where that meets the next;
    # of two places that count as one contact the one is kept that closes sooner.
    further = gap.min(axis=1)[near] - gaps.min(axis=1)[near]
    assert (further > -1e-3).all()
    assert (further < 0.05).all()
    assert np.mean(further < 2e-3) > 0.9
    on = np.take_along_axis(link, gap.argmin(axis=1)[:, None], axis=1)[:, 0]
    assert (np.abs(on - gaps.argmin(axis=1))[near] <= 1).all()
    assert np.isinf(gap[gaps.min(axis=1) > margin + 1e-3]).all()
    # Most links need not be measured.
    assert measured.sum() < 0.5 * STEPS * chain.links
