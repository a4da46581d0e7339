"""Contact problem of a step: stated for the solver, queued on a GPU, and its solution read back."""

import warp as wp

from brainbench.stimuli.engines.rod.limits import GROUPS

from .algebra import Wrench, first_axis, vec3
from .articulated_body import ChainState, ProximityState, hinge_direction
from .parameters import capacity, cuda, hinges, real
from .state import (
    ChainArrays,
    ContactCandidates,
    ContactProblems,
    PausedWhiskers,
    WhiskerJob,
    WhiskerState,
    most_candidates,
    row,
)


@wp.func(inline=True)
def any_gap_closes(candidates: wp.ref[ContactCandidates], count: int, h: real) -> int:
    """Predict the gap of each candidate without contact forces, g + h vₙ; return 1 if any is negative."""
    any_one = int(0)
    for j in range(count):
        predicted = row(candidates.gap, j) + h * wp.dot(row(candidates.normal, j), row(candidates.free_velocity, j))
        candidates.predicted_gap[j] = predicted
        if predicted < real(0.0):
            any_one = 1
    return any_one


@wp.func(inline=True)
def write_problem(
    problems: ContactProblems,
    chains: ChainArrays,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    candidates: wp.ref[ContactCandidates],
    state: wp.ref[WhiskerState],
    base_wrench: Wrench,
    tip_acceleration: vec3,
    h: real,
    count: int,
):
    """Write the factorised chain and its candidates where the solver reads them."""
    index = job.index
    problems.given[index].links = job.links
    problems.given[index].candidates = count
    problems.given[index].contacts = state.contacts
    problems.given[index].step = h
    problems.given[index].tip = row(chain.node, job.links)
    problems.given[index].base_moment = base_wrench.moment
    problems.given[index].base_force = base_wrench.force
    problems.given[index].tip_acceleration = tip_acceleration
    for i in range(job.links):
        at = row(chain.node, i)
        s2 = row(chain.axis2, i)
        s1 = first_axis(s2, hinge_direction(chain, i), row(chain.angle, i)[1])
        joint = index * wp.static(capacity) + i
        problems.joint[joint].axis1 = s1
        problems.joint[joint].axis2 = s2
        problems.joint[joint].moment1 = wp.cross(at, s1)
        problems.joint[joint].moment2 = wp.cross(at, s2)
        problems.joint[joint].gain1_w = row(chain.gain1_w, i)
        problems.joint[joint].gain1_v = row(chain.gain1_v, i)
        problems.joint[joint].gain2_w = row(chain.gain2_w, i)
        problems.joint[joint].gain2_v = row(chain.gain2_v, i)
        if wp.static(hinges == 3):
            if i % 2 == 1:
                s3 = row(chain.axis3, i)
                problems.joint[joint].axis3 = s3
                problems.joint[joint].moment3 = wp.cross(at, s3)
                problems.joint[joint].gain3_w = row(chain.gain3_w, i)
                problems.joint[joint].gain3_v = row(chain.gain3_v, i)
        problems.joint[joint].inverse_inertia = row(proximity.inverse_inertia, i)
        problems.free_acceleration[index, i] = row(chain.acceleration, i)
    for j in range(count):
        i = row(candidates.link, j)
        place = index * wp.static(most_candidates) + j
        problems.candidate_link[place] = i
        problems.candidate[place].gap = row(candidates.gap, j)
        problems.candidate[place].arc = row(candidates.arc, j)
        problems.candidate[place].friction = row(candidates.friction, j)
        problems.candidate[place].link_arc = chains.taper[i, job.whisker].arc_length
        problems.candidate[place].point = row(candidates.point, j)
        problems.candidate[place].normal = row(candidates.normal, j)
        problems.candidate[place].free_velocity = row(candidates.free_velocity, j)
        problems.candidate[place].along = row(chain.node, i + 1) - row(chain.node, i)
        problems.predicted_gap[place] = row(candidates.predicted_gap, j)


@wp.func(inline=True)
def queue_problem(paused: PausedWhiskers, index: int, count: int):
    """Queue a problem with those of like size."""
    queue = int(0)
    if wp.static(cuda):
        # A small group would not hold many contacts, and a large one would idle on few.
        if count > wp.static(GROUPS[1][0]):
            queue = int(2)
        elif count > wp.static(GROUPS[0][0]):
            queue = int(1)
    paused.problem_queue[queue, wp.atomic_add(paused.next_problem_size, queue, 1)] = index


@wp.func(inline=True)
def read_solution(problems: ContactProblems, job: WhiskerJob, chain: wp.ref[ChainState], state: wp.ref[WhiskerState]):
    """Add the contacts' part to the accelerations of the joints, and to the totals how well it was found."""
    index = job.index
    state.contacts = problems.solution[index].contacts
    state.crowded = state.crowded + problems.solution[index].crowded
    state.unsolved = state.unsolved + problems.solution[index].unsolved
    state.miss = state.miss + problems.solution[index].miss
    state.load = state.load + problems.solution[index].load
    for i in range(job.links):
        chain.acceleration[i] = problems.free_acceleration[index, i] + problems.added_acceleration[index, i]
