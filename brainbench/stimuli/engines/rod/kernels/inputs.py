"""Structures that the whisker kernels take: arrays in the order in which neighbouring threads read them. mm, ms, mg."""

from functools import cache
from types import SimpleNamespace
from typing import Any


@cache
def structs(real: type) -> SimpleNamespace:
    """Return ``Chains``, ``Bodies``, ``Lanes``, ``Options``, ``Results``, ``Paused`` and ``Grips`` of a precision."""
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec3: Any = wp.types.vector(3, real)
    vec4: Any = wp.types.vector(4, real)
    mat33: Any = wp.types.matrix((3, 3), real)

    @wp.struct
    class Chains:
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
    class Bodies:
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
    class Lanes:
        whisker: wp.array(dtype=wp.int32)
        """[lane]"""
        scene: wp.array(dtype=wp.int32)
        """[lane]"""
        base: wp.array(dtype=wp.int32)
        """[lane] motion of the base."""
        step: wp.array(dtype=real)
        """[lane] longest time step."""
        row: wp.array(dtype=wp.int32)
        """[lane] first index of its results."""
        column: wp.array(dtype=wp.int32)
        """[lane] third index of its results."""
        load_first: wp.array(dtype=wp.int32)
        """[lane + 1] first load of each lane."""
        load_link: wp.array(dtype=wp.int32)
        """[load]"""
        load_share: wp.array(dtype=real)
        """[load] where on its link."""
        load_force: wp.array(dtype=vec3)
        """[load]"""
        load_stop: wp.array(dtype=real)
        """[load]"""

    @wp.struct
    class Options:
        start: real
        gravity: vec3
        axes: mat33
        """Rotation of the results."""
        quasistatic: wp.int32
        """Whether rates are forgotten after each step, and a reading takes the wrench of the step that ends at it."""
        shape: wp.int32

    @wp.struct
    class Results:
        wrench: wp.array4d(dtype=real)
        """[row, reading, column, 6] action of the whisker on its base (N, N m)."""
        contact: wp.array3d(dtype=real)
        """[row, reading, column] arc of the contact (m), negative without."""
        points: wp.array3d(dtype=vec3)
        """[reading, node, lane] when shapes are recorded."""
        pressed: wp.array3d(dtype=vec3)
        """[reading, 2, lane] force and moment about the base point of all contacts, when shapes are recorded."""
        depth: wp.array(dtype=real)
        """[lane] deepest overlap."""
        status: wp.array(dtype=wp.int32)
        """[lane]"""
        failed: wp.array(dtype=real)
        """[lane] when it failed."""
        steps: wp.array(dtype=wp.int32)
        """[lane] steps computed."""
        touching: wp.array(dtype=wp.int32)
        """[lane] steps with contact."""
        crowded: wp.array(dtype=wp.int32)
        """[lane] steps in which a contact found no place."""
        unsolved: wp.array(dtype=wp.int32)
        """[lane] steps whose contact forces did not converge."""
        miss: wp.array(dtype=real)
        """[lane] sum over the steps of the square of what the last iteration changed in the forces (mN²)."""
        load: wp.array(dtype=real)
        """[lane] sum over the steps of the square of the contact forces (mN²)."""

    @wp.struct
    class Paused:
        """Whiskers between two slices, and the looks that they wait for."""

        budget: wp.int32
        """Steps of one slice."""
        queue: wp.array2d(dtype=wp.int32)
        """[3, lane] whiskers to go on with: after looks, after contact forces, all others."""
        after: wp.array2d(dtype=wp.int32)
        """[3, lane] the same for the next slice."""
        grips: wp.array2d(dtype=wp.int32)
        """[3, lane] whiskers whose contact forces are to be found: of few, some and many possible contacts."""
        size: wp.array(dtype=wp.int32)
        """[7] whiskers in the queues, in the queues of contact forces; looks."""
        tally: wp.array(dtype=wp.int32)
        """[7] the same for the next slice."""
        joints: wp.array2d(dtype=vec4)
        """[link, lane] angles and rates."""
        ways: wp.array2d(dtype=vec2)
        """[link, lane] lower bound of the distance, and at which leaf of the search tree the last look ended (+ 1)."""
        times: wp.array2d(dtype=real)
        """[9, lane] last reading, rest of the frame, end of rest, jump, quickest, moment and margin of the look (how
        far to look, negative, at rest), quickest in the step whose forces are awaited, and the last step."""
        counts: wp.array2d(dtype=wp.int32)
        """[8, lane] reading, reading to write, held contacts, near, resting, waiting, first look, and near in the step
        whose forces are awaited."""
        look_lane: wp.array(dtype=wp.int32)
        """[look]"""
        look_link: wp.array(dtype=wp.int32)
        """[look]"""
        look_ends: wp.array2d(dtype=vec3)
        """[look, 2]"""
        found: wp.array2d(dtype=vec4)
        """[look, 3] direction and gap between the ends; at the far end; share, bound, what there was, leaf."""

    @wp.struct
    class Grips:
        """The contact problem of each lane's step, and its answer. Its links and places lie one behind the other."""

        counts: wp.array2d(dtype=wp.int32)
        """[lane, 5] links, places of possible contact, contacts of the last step; answered with contacts, steps without
        room for one, and steps not converged."""
        plan: wp.array(dtype=vec4)
        """[lane] time step, tip."""
        chain: wp.array2d(dtype=vec3)
        """[link, 9] both axes of the joint, their moments about the base point, what a joint passes on of a force (both
        gains, rotation and translation), inverse inertia (11, 12, 22)."""
        spot_link: wp.array(dtype=wp.int32)
        """[place]"""
        spot_size: wp.array(dtype=vec4)
        """[place] gap, arc, friction, arc of the link."""
        spot: wp.array2d(dtype=vec3)
        """[place, 4] point, normal, velocity against the object without contact forces, direction of the link."""
        ahead: wp.array(dtype=real)
        """[place] gap at the end of the step."""
        held: wp.array2d(dtype=vec4)
        """[lane, contact] arc and force of the last step; answered with those of this step."""
        push: wp.array2d(dtype=vec2)
        """[lane, link] acceleration of the joint without contact forces."""
        mend: wp.array2d(dtype=vec2)
        """[lane, link] what they add to it."""
        answer: wp.array2d(dtype=vec3)
        """[lane, 7] reaction (moment, force) and acceleration of the tip, completed by the contacts; squares of what
        was missed and of the forces; sum of the normal forces and of these times arc; force and moment of all of
        them."""

    return SimpleNamespace(
        Chains=Chains, Bodies=Bodies, Lanes=Lanes, Options=Options, Results=Results, Paused=Paused, Grips=Grips
    )
