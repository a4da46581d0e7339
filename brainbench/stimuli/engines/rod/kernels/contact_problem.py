"""CONTACT PROBLEM
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import GROUPS

from .algebra import first_axis, vec3, vec4
from .parameters import capacity, cuda, real
from .state import ChainArrays, ChainState, ContactCandidates, ContactProblems, PausedWhiskers, ProximityState, Twist, WhiskerJob, WhiskerState, most_candidates, row


@wp.func(inline=True)
def any_gap_closes(candidates: wp.ref[ContactCandidates], seen: int, h: real) -> int:
    """Whether the whisker would close a gap if it moved freely."""
    any_one = int(0)
    for j in range(seen):
        ahead = row(candidates.gap, j) + h * wp.dot(row(candidates.normal, j), row(candidates.free_velocity, j))
        candidates.predicted_gap[j] = ahead
        if ahead < real(0.0):
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
    felt: Twist,
    tip_acceleration: vec3,
    h: real,
    seen: int,
):
    index = job.index
    tip = row(chain.node, job.links)
    problems.counts[index, 0] = job.links
    problems.counts[index, 1] = seen
    problems.counts[index, 2] = state.contacts
    problems.plan[index] = vec4(h, tip[0], tip[1], tip[2])
    problems.answer[index, 0] = felt.w
    problems.answer[index, 1] = felt.v
    problems.answer[index, 2] = tip_acceleration
    for i in range(job.links):
        at = row(chain.node, i)
        s2 = row(chain.axis2, i)
        s1 = first_axis(s2, row(chain.node, i + 1) - at, row(chain.angle, i)[1])
        link_row = index * wp.static(capacity) + i
        problems.joint[link_row, 0] = s1
        problems.joint[link_row, 1] = s2
        problems.joint[link_row, 2] = wp.cross(at, s1)
        problems.joint[link_row, 3] = wp.cross(at, s2)
        problems.joint[link_row, 4] = row(chain.gain1_w, i)
        problems.joint[link_row, 5] = row(chain.gain1_v, i)
        problems.joint[link_row, 6] = row(chain.gain2_w, i)
        problems.joint[link_row, 7] = row(chain.gain2_v, i)
        problems.joint[link_row, 8] = row(proximity.inverse_inertia, i)
        problems.free_acceleration[index, i] = row(chain.acceleration, i)
    for j in range(seen):
        i = row(candidates.link, j)
        spot = index * wp.static(most_candidates) + j
        problems.candidate_link[spot] = i
        taper = chains.taper[i, job.whisker]
        problems.spot_size[spot] = vec4(row(candidates.gap, j), row(candidates.arc, j), row(candidates.friction, j), taper[3])
        problems.spot[spot, 0] = row(candidates.point, j)
        problems.spot[spot, 1] = row(candidates.normal, j)
        problems.spot[spot, 2] = row(candidates.free_velocity, j)
        problems.spot[spot, 3] = row(chain.node, i + 1) - row(chain.node, i)
        problems.predicted_gap[spot] = row(candidates.predicted_gap, j)


@wp.func(inline=True)
def queue_problem(paused: PausedWhiskers, index: int, seen: int):
    """Queue it with those of like size."""
    sort = int(0)
    if wp.static(cuda):
        if seen > wp.static(GROUPS[1][0]):
            sort = int(2)
        elif seen > wp.static(GROUPS[0][0]):
            sort = int(1)
    paused.problems[sort, wp.atomic_add(paused.tally, 3 + sort, 1)] = index


@wp.func(inline=True)
def read_solution(problems: ContactProblems, job: WhiskerJob, chain: wp.ref[ChainState], state: wp.ref[WhiskerState]):
    """What the contact forces do to the joints, and how well they were found."""
    index = job.index
    state.contacts = problems.counts[index, 2]
    state.crowded = state.crowded + problems.counts[index, 3]
    state.unsolved = state.unsolved + problems.counts[index, 4]
    missed = problems.answer[index, 3]
    state.miss = state.miss + missed[0]
    state.load = state.load + missed[1]
    for i in range(job.links):
        chain.acceleration[i] = problems.free_acceleration[index, i] + problems.added_acceleration[index, i]
