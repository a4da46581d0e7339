"""STATE
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import SPARE, contacts_for

from .algebra import mat33, vec2, vec3, vec4
from .parameters import capacity, real

most_candidates = contacts_for(capacity) + SPARE
PerLink1: Any = wp.types.vector(capacity, real)
PerLink2: Any = wp.types.matrix((capacity, 2), real)
PerLink3: Any = wp.types.matrix((capacity, 3), real)
PerLinkInt: Any = wp.types.vector(capacity, wp.int32)
PerNode3: Any = wp.types.matrix((capacity + 1, 3), real)
PerCandidate1: Any = wp.types.vector(most_candidates, real)
PerCandidate3: Any = wp.types.matrix((most_candidates, 3), real)
PerCandidateInt: Any = wp.types.vector(most_candidates, wp.int32)


def reader(*kinds: tuple[Any, Any]) -> Any:
    """Return ``row(memory, index)`` for references to memory of each of these (type, type of its elements)."""
    for memory, element in kinds:

        @wp.func_native("return wp::extract(memory, index);")
        def row(memory: wp.ref[memory], index: int) -> element: ...

    return row


@wp.struct
class ChainArrays:
    links: wp.array(dtype=wp.int32)
    """[whisker]"""
    beta: wp.array(dtype=real)
    """[whisker] damping over stiffness, numerical damping included."""
    friction: wp.array(dtype=real)
    """[whisker]"""
    length: wp.array(dtype=real)
    """[whisker] arc length."""
    build: wp.array2d(dtype=vec4)
    """[link, whisker] length, cosine and sine of the rest bend, mass."""
    inertia: wp.array2d(dtype=vec4)
    """[link, whisker] centre of mass, axial and transverse inertia, hinge stiffness."""
    taper: wp.array2d(dtype=vec4)
    """[link, whisker] radius at both ends, arc at the joint, arc of the link."""


@wp.struct
class MotionArrays:
    first: wp.array(dtype=wp.int32)
    """[track] index of the first knot."""
    count: wp.array(dtype=wp.int32)
    """[track] number of knots."""
    start: wp.array(dtype=real)
    """[track] time of the first knot."""
    spacing: wp.array(dtype=real)
    """[track] time between knots."""
    place: wp.array(dtype=vec3)
    """[knot] position."""
    velocity: wp.array(dtype=vec3)
    """[knot]"""
    turn: wp.array(dtype=vec4)
    """[knot] unit quaternion (w, x, y, z), without jumps of sign."""
    spin: wp.array(dtype=vec3)
    """[knot] angular velocity, world axes."""
    surge: wp.array(dtype=vec3)
    """[knot] angular acceleration, world axes."""


@wp.struct
class ShapeArrays:
    first: wp.array(dtype=wp.int32)
    """[scene + 1] first shape of each scene."""
    kind: wp.array(dtype=wp.int32)
    """[shape]"""
    size: wp.array(dtype=vec3)
    """[shape]"""
    place: wp.array(dtype=vec3)
    """[shape] origin of the shape in its body."""
    turn: wp.array(dtype=vec4)
    """[shape] quaternion, shape to body."""
    scale: wp.array(dtype=real)
    """[shape] length of one unit of the shape (mm)."""
    radius: wp.array(dtype=real)
    """[shape] farthest point of the shape from the body's origin (mm)."""
    speed: wp.array(dtype=real)
    """[shape] fastest that any of its points ever moves."""
    friction: wp.array(dtype=real)
    """[shape] negative for the whisker's own."""
    track: wp.array(dtype=wp.int32)
    """[shape] motion of its body."""
    face: wp.array(dtype=wp.int32)
    """[shape] first of its triangles below."""
    faces: wp.array(dtype=wp.int32)
    """[shape] how many it has."""
    box: wp.array(dtype=wp.int32)
    """[shape] first of its boxes below."""
    low: wp.array(dtype=vec3)
    """[box] lowest corner; boxes as in :mod:`._tree`."""
    high: wp.array(dtype=vec3)
    """[box] highest corner."""
    corner: wp.array2d(dtype=vec3)
    """[triangle, 3]"""
    outward: wp.array2d(dtype=vec3)
    """[triangle, 7] angle-weighted normals: face, three corners, edges opposite to them."""


@wp.struct
class JobArrays:
    whisker: wp.array(dtype=wp.int32)
    """[index]"""
    scene: wp.array(dtype=wp.int32)
    """[index]"""
    base: wp.array(dtype=wp.int32)
    """[index] motion of the base."""
    step: wp.array(dtype=real)
    """[index] longest time step."""
    row: wp.array(dtype=wp.int32)
    """[index] first index of its results."""
    column: wp.array(dtype=wp.int32)
    """[index] third index of its results."""
    load_first: wp.array(dtype=wp.int32)
    """[index + 1] first load of each index."""
    load_link: wp.array(dtype=wp.int32)
    """[load]"""
    load_share: wp.array(dtype=real)
    """[load] where on its link."""
    load_force: wp.array(dtype=vec3)
    """[load]"""
    load_stop: wp.array(dtype=real)
    """[load]"""


@wp.struct
class StepOptions:
    start: real
    gravity: vec3
    axes: mat33
    """Rotation of the results."""
    quasistatic: wp.int32
    """Whether rates are forgotten after each step, and a reading takes the wrench of the step that ends at it."""
    shape: wp.int32


@wp.struct
class ResultArrays:
    wrench: wp.array4d(dtype=real)
    """[row, reading, column, 6] action of the whisker on its base (N, N m)."""
    contact: wp.array3d(dtype=real)
    """[row, reading, column] arc of the contact (m), negative without."""
    points: wp.array3d(dtype=vec3)
    """[reading, node, index] when shapes are recorded."""
    pressed: wp.array3d(dtype=vec3)
    """[reading, 2, index] force and moment about the base point of all contacts, when shapes are recorded."""
    depth: wp.array(dtype=real)
    """[index] deepest overlap."""
    status: wp.array(dtype=wp.int32)
    """[index]"""
    failed: wp.array(dtype=real)
    """[index] when it failed."""
    steps: wp.array(dtype=wp.int32)
    """[index] steps computed."""
    touching: wp.array(dtype=wp.int32)
    """[index] steps with contact."""
    crowded: wp.array(dtype=wp.int32)
    """[index] steps in which a contact found no place."""
    unsolved: wp.array(dtype=wp.int32)
    """[index] steps whose contact forces did not converge."""
    miss: wp.array(dtype=real)
    """[index] sum over the steps of the square of what the last iteration changed in the forces (mN²)."""
    load: wp.array(dtype=real)
    """[index] sum over the steps of the square of the contact forces (mN²)."""


@wp.struct
class PausedWhiskers:
    """Whiskers between two slices, and the looks that they wait for."""

    budget: wp.int32
    """Steps of one slice."""
    queue: wp.array2d(dtype=wp.int32)
    """[3, index] whiskers to go on with: after looks, after contact forces, all others."""
    after: wp.array2d(dtype=wp.int32)
    """[3, index] the same for the next slice."""
    problems: wp.array2d(dtype=wp.int32)
    """[3, index] whiskers whose contact forces are to be found: of few, some and many possible contacts."""
    size: wp.array(dtype=wp.int32)
    """[7] whiskers in the queues, in the queues of contact forces; looks."""
    tally: wp.array(dtype=wp.int32)
    """[7] the same for the next slice."""
    joints: wp.array2d(dtype=vec4)
    """[link, index] angles and rates."""
    ways: wp.array2d(dtype=vec2)
    """[link, index] minimum bound of the distance, and at which leaf of the search tree the last look ended (+ 1)."""
    times: wp.array2d(dtype=real)
    """[9, index] last reading, rest of the frame, end of rest, jump, quickest, moment and margin of the look (how
    far to look, negative, at rest), quickest in the step whose forces are awaited, and the last step."""
    counts: wp.array2d(dtype=wp.int32)
    """[8, index] reading, reading to write, held contacts, near, resting, waiting, first look, and near in the step
    whose forces are awaited."""
    query_job: wp.array(dtype=wp.int32)
    """[look]"""
    query_link: wp.array(dtype=wp.int32)
    """[look]"""
    query_ends: wp.array2d(dtype=vec3)
    """[look, 2]"""
    found: wp.array2d(dtype=vec4)
    """[look, 3] direction and gap between the ends; at the far end; share, bound, what there was, leaf."""


@wp.struct
class ContactProblems:
    """The contact problem of each index's step, and its answer. Its links and places lie one behind the other."""

    counts: wp.array2d(dtype=wp.int32)
    """[index, 5] links, places of possible contact, contacts of the last step; answered with contacts, steps without
    room for one, and steps not converged."""
    plan: wp.array(dtype=vec4)
    """[index] time step, tip."""
    joint: wp.array2d(dtype=vec3)
    """[link, 9] both axes of the joint, their moments about the base point, what a joint passes on of a force (both
    gains, rotation and translation), inverse inertia (11, 12, 22)."""
    candidate_link: wp.array(dtype=wp.int32)
    """[place]"""
    spot_size: wp.array(dtype=vec4)
    """[place] gap, arc, friction, arc of the link."""
    spot: wp.array2d(dtype=vec3)
    """[place, 4] point, normal, velocity against the object without contact forces, direction of the link."""
    predicted_gap: wp.array(dtype=real)
    """[place] gap at the end of the step."""
    held: wp.array2d(dtype=vec4)
    """[index, contact] arc and force of the last step; answered with those of this step."""
    free_acceleration: wp.array2d(dtype=vec2)
    """[index, link] acceleration of the joint without contact forces."""
    added_acceleration: wp.array2d(dtype=vec2)
    """[index, link] what they add to it."""
    answer: wp.array2d(dtype=vec3)
    """[index, 7] reaction (moment, force) and acceleration of the tip, completed by the contacts; squares of what
    was missed and of the forces; sum of the normal forces and of these times arc; force and moment of all of
    them."""


@wp.struct
class ChainState:
    """WhiskerState of the joints, and what one step keeps of each link between its passes."""

    angle: PerLink2
    """Angles."""
    rate: PerLink2
    """Rates."""
    axis2: PerLink3
    """Second axis of the joint."""
    node: PerNode3
    """Joints and tip, from the base point."""
    gain1_w: PerLink3
    """What the joint passes on of a force, for each axis: rotation and translation."""
    gain1_v: PerLink3
    gain2_w: PerLink3
    gain2_v: PerLink3
    acceleration: PerLink2
    """Forces of the joint over its inertia, then its accelerations."""


@wp.struct
class ProximityState:
    """The same of what only contact needs: without objects a kernel writes it, if at all, and leaves it out."""

    inverse_inertia: PerLink3
    """Inverse inertia of the joint (11, 12, 22)."""
    clearance: PerLink1
    """Lower bound of the distance from all objects; at rest, until when nothing can come near."""
    leaf: PerLinkInt
    """Where the last search for what is near ended (+ 1)."""
    safe_until: PerLink1
    end_speed: PerLink1
    """Speed of its faster end."""


@wp.struct
class ContactCandidates:
    """Where contact is possible within one step."""

    link: PerCandidateInt
    arc: PerCandidate1
    predicted_gap: PerCandidate1
    """Gap at the end of the step."""
    gap: PerCandidate1
    friction: PerCandidate1
    point: PerCandidate3
    object_velocity: PerCandidate3
    """Velocity of the object."""
    normal: PerCandidate3
    free_velocity: PerCandidate3
    """Velocity against the object without contact forces."""


@wp.struct
class WhiskerJob:
    """What does not change of a whisker."""

    index: wp.int32
    whisker: wp.int32
    base: wp.int32
    links: wp.int32
    beta: real
    longest_step: real
    """Longest time step."""
    first_shape: wp.int32
    end_shape: wp.int32
    object_speed: real
    """Fastest that any point of an object moves."""
    first_load: wp.int32
    end_load: wp.int32
    can_rest: wp.int32
    """Whether nothing but contact can move it."""


@wp.struct
class WhiskerState:
    """How far a whisker has come."""

    reading: wp.int32
    """The reading that the whisker is on its way to."""
    pending_reading: wp.int32
    """The reading that the next step writes: it takes the wrench of the step that begins at its time."""
    reading_time: real
    """Time of the last reading."""
    time_left: real
    """What is left of the time to the next one, when the whisker paused."""
    contacts: wp.int32
    """Contacts of the last step."""
    is_near: wp.int32
    top_speed: real
    """Speed of the fastest point."""
    velocity_jump: real
    """By how much contact can change that in a step."""
    last_step: real
    """The last step."""
    at_rest: wp.int32
    safe_until: real
    """Until when nothing can come near the resting whisker."""
    waiting_for: wp.int32
    """For what it paused: 1 looks, 3 contact forces, 4 looks at rest, 2 anything else."""
    first_query: wp.int32
    """The first of the looks that it asked for."""
    largest_change: real
    """Largest bend or rate in a step."""
    status: wp.int32
    failed_at: real
    depth: real
    steps: wp.int32
    touching: wp.int32
    crowded: wp.int32
    unsolved: wp.int32
    miss: real
    load: real


@wp.struct
class Twist:
    """Rate of rotation and of the point of the link at the base point, or accelerations, or moment and force."""

    w: vec3
    v: vec3

kinds = (PerLink2, vec2), (PerLink3, vec3), (PerNode3, vec3), (PerCandidate3, vec3), (PerLink1, real), (PerCandidate1, real)
row = reader(*dict.fromkeys((*kinds, (PerLinkInt, wp.int32), (PerCandidateInt, wp.int32))))
