"""What a thread keeps of its whisker: vectors and matrices, because arrays in a kernel carry addresses that the
compiler loses, handed from function to function by reference.

An element of one that came by reference is read with ``row``: Warp would copy the whole to read it by its index.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.limits import SPARE, contacts_for


def reader(*kinds: tuple[Any, Any]) -> Any:
    """Return ``row(memory, index)`` for references to memory of each of these (type, type of its elements)."""
    import warp as wp

    for memory, element in kinds:

        @wp.func_native("return wp::extract(memory, index);")
        def row(memory: wp.ref[memory], index: int) -> element: ...

    return row


@cache
def memory(real: type, capacity: int) -> SimpleNamespace:
    """Return ``Links``, ``Watch``, ``Spots``, ``Lane``, ``State``, ``Twist`` and ``row`` for ``capacity`` links."""
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec3: Any = wp.types.vector(3, real)
    seen = contacts_for(capacity) + SPARE
    Links2: Any = wp.types.matrix((capacity, 2), real)
    Links3: Any = wp.types.matrix((capacity, 3), real)
    Nodes3: Any = wp.types.matrix((capacity + 1, 3), real)
    Links1: Any = wp.types.vector(capacity, real)
    LinksWhole: Any = wp.types.vector(capacity, wp.int32)
    Seen1: Any = wp.types.vector(seen, real)
    Seen3: Any = wp.types.matrix((seen, 3), real)
    SeenWhole: Any = wp.types.vector(seen, wp.int32)

    @wp.struct
    class Links:
        """State of the joints, and what one step keeps of each link between its passes."""

        q: Links2
        """Angles."""
        qd: Links2
        """Rates."""
        e2: Links3
        """Second axis of the joint."""
        node: Nodes3
        """Joints and tip, from the base point."""
        k1w: Links3
        """What the joint passes on of a force, for each axis: rotation and translation."""
        k1v: Links3
        k2w: Links3
        k2v: Links3
        push: Links2
        """Forces of the joint over its inertia, then its accelerations."""

    @wp.struct
    class Watch:
        """The same of what only contact needs: without objects a kernel writes it, if at all, and leaves it out."""

        inverse: Links3
        """Inverse inertia of the joint (11, 12, 22)."""
        clear: Links1
        """Lower bound of the distance from all objects; at rest, until when nothing can come near."""
        leaf: LinksWhole
        """Where the last search for what is near ended (+ 1)."""
        until: Links1
        swift: Links1
        """Speed of its faster end."""

    @wp.struct
    class Spots:
        """Where contact is possible within one step."""

        link: SeenWhole
        arc: Seen1
        ahead: Seen1
        """Gap at the end of the step."""
        gap: Seen1
        mu: Seen1
        at: Seen3
        move: Seen3
        """Velocity of the object."""
        normal: Seen3
        free: Seen3
        """Velocity against the object without contact forces."""

    @wp.struct
    class Lane:
        """What does not change of a whisker."""

        lane: wp.int32
        whisker: wp.int32
        base: wp.int32
        links: wp.int32
        beta: real
        longest: real
        """Longest time step."""
        shapes_from: wp.int32
        shapes_to: wp.int32
        speed: real
        """Fastest that any point of an object moves."""
        loads_from: wp.int32
        loads_to: wp.int32
        may_rest: wp.int32
        """Whether nothing but contact can move it."""

    @wp.struct
    class State:
        """How far a whisker has come."""

        reading: wp.int32
        """The reading that the whisker is on its way to."""
        pending: wp.int32
        """The reading that the next step writes: it takes the wrench of the step that begins at its time."""
        before: real
        """Time of the last reading."""
        left: real
        """What is left of the time to the next one, when the whisker paused."""
        held: wp.int32
        """Contacts of the last step."""
        near: wp.int32
        quickest: real
        """Speed of the fastest point."""
        jump: real
        """By how much contact can change that in a step."""
        h_last: real
        """The last step."""
        resting: wp.int32
        idle: real
        """Until when nothing can come near the resting whisker."""
        waiting: wp.int32
        """For what it paused: 1 looks, 3 contact forces, 4 looks at rest, 2 anything else."""
        look_first: wp.int32
        """The first of the looks that it asked for."""
        worst: real
        """Largest bend or rate in a step."""
        status: wp.int32
        failed: real
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

    kinds = (Links2, vec2), (Links3, vec3), (Nodes3, vec3), (Seen3, vec3), (Links1, real), (Seen1, real)
    row = reader(*dict.fromkeys((*kinds, (LinksWhole, wp.int32), (SeenWhole, wp.int32))))
    return SimpleNamespace(Links=Links, Watch=Watch, Spots=Spots, Lane=Lane, State=State, Twist=Twist, row=row)
