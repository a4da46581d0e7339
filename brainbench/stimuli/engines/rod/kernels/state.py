"""State of the whisker solver: the arrays that kernels take, what a thread keeps of its whisker, and paused whiskers.

Letters of shapes: whisker, link, shape, scene, triangle, box; *job* is one whisker in one scene, the work of one
thread. Units: mg, mm, ms, mN, µN·m, rad. Records have the order in which neighbouring threads read them.

A thread's own memory is vectors and matrices, not arrays: arrays in a kernel carry addresses that the compiler loses.
They are handed on by reference, and an element of one is read with ``row``: Warp would copy the whole to index it.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import LISTED, SPARE, WIDE, contacts_for

from .algebra import JointInverse, JointVector, Spatial, SpatialInertia, mat33, mat34, reader, vec3, vec4
from .motion import BodyMotion, Instant, JobArrays, MotionArrays, ReadingArrays, instant, pose_at
from .parameters import capacity, flows, hinges, real, recorded, rolls, smooth, yields

if recorded:
    from .recorder.records import StepRecords

WAIT_DISTANCES, WAIT_SLICE, WAIT_FORCES, WAIT_REST, ENDED = range(1, 6)
"""Reasons to pause: distances of near links, its next slice, contact forces, distances at rest, its end."""

most_candidates = contacts_for(capacity) + SPARE
PerLink1: Any = wp.types.vector(capacity, real)
PerLinkJoint: Any = wp.types.matrix((capacity, hinges), real)
PerLinkInverse: Any = wp.types.matrix((capacity, hinges + 1), real)
PerLink3: Any = wp.types.matrix((capacity, 3), real)
PerLinkInt: Any = wp.types.vector(capacity, wp.int32)
PerNode3: Any = wp.types.matrix((capacity + 1, 3), real)
PerCandidate1: Any = wp.types.vector(most_candidates, real)
PerCandidate3: Any = wp.types.matrix((most_candidates, 3), real)
PerCandidateInt: Any = wp.types.vector(most_candidates, wp.int32)
PerListed1: Any = wp.types.vector(LISTED, real)
PerListedInt: Any = wp.types.vector(LISTED, wp.int32)
LeafCorners: Any = wp.types.matrix((9, WIDE), real)
NodeBoxes: Any = wp.types.matrix((6, WIDE), real)

row = reader(
    (PerLink1, real), (PerLinkJoint, JointVector), (PerLinkInverse, JointInverse), (PerLink3, vec3),
    (PerLinkInt, wp.int32), (PerNode3, vec3), (PerCandidate1, real), (PerCandidate3, vec3), (PerCandidateInt, wp.int32),
    (PerListed1, real), (PerListedInt, wp.int32),
)  # fmt: skip


@wp.struct
class LinkBuild:
    """Geometry and mass of a link."""

    length: real
    bend_cosine: real
    """Cosine and sine of the angle at rest to the link before; of half that angle at a joint that twists."""
    bend_sine: real
    mass: real
    if rolls:
        roll_cosine: real
        """Of the angle about the link before by which the plane of the bend is turned."""
        roll_sine: real


@wp.struct
class LinkInertia:
    """Inertia of a link about its centre, and stiffness of its joint."""

    centre: real
    """Distance of the centre of mass from the joint."""
    axial: real
    transverse: real
    stiffness: real
    if hinges == 3:
        torsion: real
        """Of joints 1, 3, 5 …"""


@wp.struct
class LinkTaper:
    """Surface of a link: radius at both ends, arc length at its joint and along it."""

    start_radius: real
    end_radius: real
    arc: real
    arc_length: real


@wp.struct
class BeamCompliance:
    """How the rod bends from the start of a link to a place on it (:func:`.packing.beam_compliance`).

    Of a moment that is linear between both: by that at the start, and by that at the place. Places 0, 1/3, 2/3 and 1.
    """

    near_turn: vec4
    """Turn, and deflection in lengths of the link (1/µN·m)."""
    there_turn: vec4
    near_deflection: vec4
    there_deflection: vec4


@wp.struct
class FollicleConstants:
    """Springs and dampers of a follicle along and about its own axes; axes without stiffness are rigid."""

    slide_stiffness: vec3
    slide_damping: vec3
    turn_stiffness: vec3
    turn_damping: vec3


@wp.struct
class ChainArrays:
    """Whiskers as chains of rigid links with elastic joints."""

    links: wp.array(dtype=wp.int32)
    """[whisker]"""
    beta: wp.array(dtype=real)
    """[whisker] damping over stiffness, numerical damping included."""
    friction: wp.array(dtype=real)
    """[whisker]"""
    length: wp.array(dtype=real)
    """[whisker] arc length."""
    build: wp.array2d(dtype=LinkBuild)
    """[link, whisker]"""
    inertia: wp.array2d(dtype=LinkInertia)
    """[link, whisker]"""
    taper: wp.array2d(dtype=LinkTaper)
    if smooth:
        beam: wp.array2d(dtype=BeamCompliance)
    """[link, whisker]"""
    if yields:
        follicle: wp.array(dtype=FollicleConstants)
        """[whisker]"""


@wp.struct
class ShapeArrays:
    """Objects that whiskers may touch: shapes of all scenes, and the triangles of the surfaces among them."""

    first: wp.array(dtype=wp.int32)
    """[scene + 1] first shape of each scene."""
    kind: wp.array(dtype=wp.int32)
    """[shape]"""
    size: wp.array(dtype=vec3)
    """[shape]"""
    place: wp.array(dtype=vec3)
    """[shape] origin of the shape in its body."""
    quaternion: wp.array(dtype=vec4)
    """[shape] quaternion, shape to body."""
    scale: wp.array(dtype=real)
    """[shape] length of one unit of the shape (mm)."""
    radius: wp.array(dtype=real)
    """[shape] farthest point of the shape from its origin (mm)."""
    speed: wp.array(dtype=real)
    """[shape] fastest that any of its points ever moves."""
    friction: wp.array(dtype=real)
    """[shape] negative for the whisker's own."""
    track: wp.array(dtype=wp.int32)
    """[shape] motion of its body."""
    face: wp.array(dtype=wp.int32)
    """[shape] first of its triangles below."""
    faces: wp.array(dtype=wp.int32)
    """[shape] number of its triangles."""
    box: wp.array(dtype=wp.int32)
    """[shape] first of its nodes below."""
    boxes: wp.array(dtype=NodeBoxes)
    """[node] boxes of its children, as in ``brainbench.stimuli.engines.rod.packing``."""
    corners: wp.array(dtype=LeafCorners)
    """[leaf] of its triangles; each surface begins with a leaf of its own."""
    outward: wp.array2d(dtype=vec3)
    """[triangle, 7] angle-weighted normals: face, three corners, edges opposite to them."""


@wp.struct
class StepOptions:
    """Options that all jobs of a launch share."""

    gravity: vec3
    axes: mat33
    """Rotation of the results."""
    travel: real
    """Longest way of any point of a whisker in one step while something is near; steps are split to keep it."""
    quasistatic: wp.int32
    """1: rates are forgotten after each step, and a reading takes the wrench of the step that ends at it."""
    shape: wp.int32
    """1: shapes and contact wrenches are recorded."""
    if flows:
        air_flow: vec3


@wp.struct
class SceneArrays:
    """All that a launch is given: whiskers, motions, shapes, what each job does with them, and when it is read."""

    chains: ChainArrays
    motions: MotionArrays
    shapes: ShapeArrays
    jobs: JobArrays
    readings: ReadingArrays
    options: StepOptions


@wp.func(inline=True)
def scene_of(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    readings: ReadingArrays,
    options: StepOptions,
) -> SceneArrays:
    """Return the scene of a kernel that takes its parts: given as one argument, every read of it costs two moves."""
    scene = SceneArrays()
    scene.chains = chains
    scene.motions = motions
    scene.shapes = shapes
    scene.jobs = jobs
    scene.readings = readings
    scene.options = options
    return scene


@wp.struct
class WhiskerJob:
    """Constants of a job."""

    index: wp.int32
    whisker: wp.int32
    base: wp.int32
    links: wp.int32
    beta: real
    longest_step: real
    first_limit: wp.int32
    limits: wp.int32
    first_shape: wp.int32
    end_shape: wp.int32
    object_speed: real
    """Fastest that any point of an object moves."""
    first_load: wp.int32
    end_load: wp.int32
    can_rest: wp.int32
    """1: nothing but contact can move it."""


@wp.struct
class Step:
    """A step of a whisker: when it begins, how long it takes, and how its base moves."""

    now: Instant
    length: real
    pose: BodyMotion
    """Of the base at the beginning."""
    base: Spatial
    """Acceleration of the base, less gravity."""
    margin: real
    """Gap up to which a contact takes part, once that is known."""
    if yields:
        axes: mat33
        """Rotation from the axes of the follicle, which its whisker does not move."""
        slide: Spatial
        """Turn and slide of the follicle at the beginning, along its axes."""
        rate: Spatial


@wp.func(inline=True)
def begin_step(scene: SceneArrays, job: WhiskerJob, now: Instant, h: real) -> Step:
    """Return a step of length h; the base moves as its track does within it, and gravity is an acceleration of it."""
    step = Step()
    step.now = now
    step.length = h
    step.pose = pose_at(scene.motions, job.base, now)
    later = pose_at(scene.motions, job.base, instant(now.tick, now.part + h))
    # Spatial acceleration is the rate of the twist at a fixed point: v̇ − ω × v (Featherstone 2008, chapter 2).
    step.base.w = (later.spin - step.pose.spin) / h
    step.base.v = (
        (later.velocity - step.pose.velocity) / h - wp.cross(step.pose.spin, step.pose.velocity) - scene.options.gravity
    )
    return step


@wp.struct
class WhiskerState:
    """Progress of a whisker, and totals of its steps."""

    reading: wp.int32
    """Reading that the whisker is on its way to."""
    pending_reading: wp.int32
    """Result that the next step writes: it takes the wrench of the step that begins at its time."""
    reading_time: Instant
    """Time of the last reading."""
    time_left: real
    """Time left to the next reading, when the whisker paused."""
    contacts: wp.int32
    """Contacts of the last step."""
    split_time: real
    """Time for which steps stay split, because an object was about to be touched."""
    near_speed: real
    """Speed of the fastest such object."""
    closes: wp.int32
    """1: a candidate of this step may close within it."""
    closing_speed: real
    """Speed of the fastest object among these."""
    top_speed: real
    """Speed of the fastest point."""
    if yields:
        slide: Spatial
        """Turn (a rotation vector) and slide of the follicle along its axes, and their rates."""
        rate: Spatial
    velocity_jump: real
    """By how much contact can change that in a step."""
    last_step: real
    """Length of the last step."""
    at_rest: wp.int32
    safe_until: real
    """Time until which nothing can come near the resting whisker."""
    waiting_for: wp.int32
    """One of the ``WAIT_`` constants; 0 before the whisker first pauses and once it has what it waited for."""
    first_query: wp.int32
    """First of its distance queries."""
    step_split_time: real
    """``split_time``, ``near_speed`` and ``top_speed`` of the step whose contact forces are awaited."""
    step_near_speed: real
    step_top_speed: real
    largest_change: real
    """Largest bend or rate in a step."""
    status: wp.int32
    """0, or why it ended early, at the time ``failed_at``."""
    failed_at: real
    depth: real
    """Deepest overlap."""
    steps: wp.int32
    """Steps computed; with contact; in which a contact found no place; with forces not solved to the tolerance."""
    touching: wp.int32
    crowded: wp.int32
    unsolved: wp.int32
    miss: real
    """Sums over the steps of the square of what the last iteration changed in the forces, and of the forces (mN²)."""
    load: real


@wp.struct
class ResultArrays:
    """Results of all jobs."""

    wrench: wp.array4d(dtype=real)
    """[row, reading, column, 6] action of the whisker on its base (N, N m)."""
    if yields:
        displacement: wp.array4d(dtype=real)
        """[row, reading, column, 6] slide (m) and rotation vector (rad) of the follicle along its own axes."""
    contact: wp.array3d(dtype=real)
    """[row, reading, column] arc of the contact (m), negative without."""
    points: wp.array3d(dtype=vec3)
    """[reading, node, job] when shapes are recorded."""
    contact_wrench: wp.array3d(dtype=vec3)
    """[reading, 2, job] force and moment about the base point of all contacts, when shapes are recorded."""
    state: wp.array(dtype=WhiskerState)
    """[job] at its end, with the totals of its steps."""


@wp.struct
class NearShapes:
    """The shapes nearest to a whisker, where a scene has more than are looked at in each step."""

    shape: PerListedInt
    """In the order of the scene."""
    distance: PerListed1
    """Bound of the distance from the whisker's axis when they were listed."""
    count: wp.int32
    """0: there is no list; all shapes are looked at."""
    room: real
    """Least distance of all others from the whisker's axis then."""
    moved: real
    """How much nearer any of them may have come since."""


@wp.struct
class ContactCandidates:
    """Places where contact is possible within one step."""

    link: PerCandidateInt
    arc: PerCandidate1
    predicted_gap: PerCandidate1
    """Gap at the end of the step."""
    gap: PerCandidate1
    friction: PerCandidate1
    point: PerCandidate3
    object_velocity: PerCandidate3
    normal: PerCandidate3
    free_velocity: PerCandidate3
    """Velocity against the object without contact forces."""
    if recorded:
        count: wp.int32
        shape: PerCandidateInt
        share: PerCandidate1  # place along the link, 0 to 1
        triangle: PerCandidateInt  # of a surface, that it touches
        lead: PerCandidate1  # how much nearer (mm) than the neighbouring link it is, if that touches the same
    if recorded and smooth:
        along: PerCandidate3  # rate of the centre line's place along the link, that of its tangent, and its tangent
        bending: PerCandidate3
        tangent: PerCandidate3
        start_slide: PerCandidate1  # how fast the rod slides along itself at both ends of the link
        end_slide: PerCandidate1


@wp.struct
class LinkDistance:
    """Distance of a link from a shape: between its ends, and at its far end."""

    between: wp.int32
    """1: something between the ends is near."""
    share: real
    """Place along the link, 0 to 1."""
    gap: real
    normal: vec3
    end: wp.int32
    """1: the far end is near."""
    end_gap: real
    end_normal: vec3
    start: wp.int32
    """1: the near end is known to be near."""
    start_gap: real
    start_normal: vec3
    crossing: wp.int32
    """1: some of the axis lies inside."""
    depth: real
    """Deepest overlap; 0 without."""
    clearance: real
    """Lower bound of the distance of the link's axis from the surface."""
    leaf: wp.int32
    """Leaf of the search tree (+ 1) where the nearest triangle is; 0 without."""
    if smooth:
        face: wp.int32
    if recorded:
        triangle: wp.int32  # of a surface, that it touches between its ends, and at its far end
        end_triangle: wp.int32


@wp.struct
class ContactProblem:
    """A step before contact: its size and length, and what the base and the tip do without contact forces."""

    links: wp.int32
    candidates: wp.int32
    contacts: wp.int32
    """Contacts of the last step."""
    step: real
    tip: vec3
    base: Spatial
    """Wrench on the base."""
    tip_acceleration: vec3
    if yields:
        axes: mat33
        inertia: SpatialInertia
        """Articulated inertia at the base."""
        compliance: SpatialInertia
        """Acceleration of the base for a force on it."""
        yielding: Spatial
        """Acceleration of the follicle along its axes."""


@wp.struct
class JointRecord:
    """A joint after the pass of the articulated inertia: motion S and gains UD⁻¹ of each hinge."""

    motion1: Spatial
    motion2: Spatial
    gain1: Spatial
    gain2: Spatial
    if hinges == 3:
        motion3: Spatial
        gain3: Spatial
    inverse_inertia: JointInverse


@wp.struct
class CandidateRecord:
    """A contact candidate, see :class:`ContactCandidates`."""

    gap: real
    arc: real
    friction: real
    link_arc: real
    """Arc length of its link."""
    point: vec3
    normal: vec3
    free_velocity: vec3
    along: vec3
    """Direction of the link."""


@wp.struct
class HeldContact:
    """A contact of the last step: arc and force."""

    arc: real
    force: vec3
    if recorded:
        slot: wp.int32  # its candidate
    if smooth:
        mean: vec3
        """Mean of the force over :data:`.limits.STEADY`, and that of the mean."""
        steady: vec3


@wp.struct
class ContactSolution:
    """Contact forces of a step, and what the base and the tip do with them."""

    contacts: wp.int32
    crowded: wp.int32
    """1: there was no room for a contact."""
    unsolved: wp.int32
    """1: sweeps, or iterations for a direction of slip, ended before they met the tolerance."""
    miss: real
    """Square of what the last iteration changed in the forces; of the forces."""
    load: real
    base: Spatial
    tip_acceleration: vec3
    if yields:
        yielding: Spatial
    normal_sum: real
    """Sum of the normal forces; of these times arc."""
    arc_sum: real
    contact: Spatial
    """Moment about the base point and force of all contacts."""
    if recorded:
        inexact: wp.int32  # 1: the forces were not solved to rounding


@wp.struct
class ContactProblems:
    """Problem ``given`` [job] of a step, its ``solution`` [job]; links and candidates of jobs follow one another."""

    given: wp.array(dtype=ContactProblem)
    joint: wp.array(dtype=JointRecord)
    """[job · link]"""
    candidate: wp.array(dtype=CandidateRecord)
    candidate_link: wp.array(dtype=wp.int32)
    """[job · candidate]"""
    predicted_gap: wp.array(dtype=real)
    """[job · candidate] gap at the end of the step."""
    held: wp.array2d(dtype=HeldContact)
    """[job, contact] of the last step; then of this one."""
    free_acceleration: wp.array2d(dtype=JointVector)
    """[job, link] acceleration of the joint without contact forces."""
    added_acceleration: wp.array2d(dtype=JointVector)
    """[job, link] acceleration that they add."""
    solution: wp.array(dtype=ContactSolution)
    tolerance: real
    sweeps: wp.int32
    tries: wp.int32
    """How forces are solved, see ``limits.FEW_ITERATIONS``."""


@wp.struct
class PausedLink:
    """State of a link, see :class:`ChainState` and :class:`ProximityState`."""

    angle: JointVector
    rate: JointVector
    clearance: real
    leaf: wp.int32
    if smooth:
        shorter: real


@wp.struct
class CentreLine:
    """Centre line of the rod beside a straight link, at the places 0, 1/3, 2/3 and 1 along it; a cubic between them."""

    offset: mat34
    """How far it lies from the link."""
    turn: mat34
    """By what its tangent, times the length of the link, differs from the link."""


@wp.struct
class DistanceQuery:
    """A link whose distance is asked for."""

    job: wp.int32
    link: wp.int32
    start: vec3
    stop: vec3
    bound: real
    """Lower bound of its distance, as far as that is known; 0 or less: it may be inside."""
    if smooth:
        line: CentreLine


@wp.struct
class Cone:
    """A link: its axis from a to b and the radii at both ends."""

    a: vec3
    b: vec3
    start_radius: real
    end_radius: real
    if smooth:
        line: CentreLine


@wp.func
def cone(a: vec3, b: vec3, taper: LinkTaper) -> Cone:
    """Return a link between two places."""
    link = Cone()
    link.a = a
    link.b = b
    link.start_radius = taper.start_radius
    link.end_radius = taper.end_radius
    return link


@wp.func
def cubic_weights(place: real) -> vec4:
    """Return the weights of values at 0, 1/3, 2/3 and 1 in the cubic through them."""
    x = real(3.0) * place
    rest = real(1.0) - place
    ends = (real(1.0) - x) * (real(2.0) - x) * real(0.5)
    middle = real(1.5) * x * rest
    return vec4(ends * rest, middle * (real(2.0) - x), middle * (x - real(1.0)), ends * place)


@wp.func
def line_place(link: Cone, share: real) -> vec3:
    """Return the point of a link's centre line at a place along it, 0 to 1."""
    place = link.a + (link.b - link.a) * share
    if wp.static(smooth):
        place = place + link.line.offset * cubic_weights(share)
    return place


@wp.func
def line_tangent(link: Cone, share: real) -> vec3:
    """Return the direction of a link's centre line at a place along it, as long as the link."""
    along = link.b - link.a
    if wp.static(smooth):
        along = along + link.line.turn * cubic_weights(share)
    return along


@wp.struct
class QueryFrame:
    """When distances are asked for, and the point from which the ends of the links count: the base."""

    time: Instant
    coarse: vec3
    place: vec3


@wp.struct
class PausedWhiskers:
    """Whiskers between two slices, the queues they stand in, and the distances they wait for."""

    queue: wp.array2d(dtype=wp.int32)
    """[3, job] whiskers to go on with: after distances, after contact forces, all others."""
    next_queue: wp.array2d(dtype=wp.int32)
    """[3, job] the same for the next slice."""
    problem_queue: wp.array2d(dtype=wp.int32)
    """[3, job] whiskers whose contact forces are to be found: of few, some and many candidates."""
    queue_size: wp.array(dtype=wp.int32)  # [3]
    problem_size: wp.array(dtype=wp.int32)  # [3]
    query_count: wp.array(dtype=wp.int32)  # [1]
    next_queue_size: wp.array(dtype=wp.int32)
    """[3] the same three for the next slice."""
    next_problem_size: wp.array(dtype=wp.int32)
    next_query_count: wp.array(dtype=wp.int32)
    state: wp.array(dtype=WhiskerState)
    """[job]"""
    link: wp.array2d(dtype=PausedLink)
    """[link, job]"""
    query_frame: wp.array(dtype=QueryFrame)
    """[job]"""
    query_margin: wp.array(dtype=real)
    """[job] gap up to which a contact takes part; at rest negative: how far to search."""
    query: wp.array(dtype=DistanceQuery)
    """[query]"""
    answer: wp.array(dtype=LinkDistance)
    """[query]"""
    if recorded:
        budget: wp.int32  # steps after which a whisker pauses
        ended: wp.array(dtype=wp.int32)  # [job] 1: it came to its end
        keep: wp.int32  # 1: the steps of this slice are written down
        records: StepRecords
