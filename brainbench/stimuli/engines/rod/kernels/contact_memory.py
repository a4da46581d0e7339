"""What a thread keeps of the contacts that it solves for, and the size of it all."""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.state import reader
from brainbench.stimuli.engines.rod.limits import SPARE, contacts_for


@cache
def grasps(real: type, capacity: int, held: int, lanes: int) -> SimpleNamespace:
    """Return ``Own``, ``Grasp``, ``Table``, ``Square`` and ``row``, and numbers of places.

    Args:
        real: ``warp.float32`` or ``warp.float64``.
        capacity: links that fit.
        held: contacts that fit.
        lanes: threads of a group. A thread of many holds one contact (``own``), the only one all of them; the contact
            of place c then lies at ``tall`` times c.
    """
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec3: Any = wp.types.vector(3, real)
    vec6: Any = wp.types.vector(6, real)
    own = held if lanes == 1 else 1
    rows = 3 * held
    OwnWhole: Any = wp.types.vector(own, wp.int32)
    Own1: Any = wp.types.vector(own, real)
    Own3: Any = wp.types.matrix((own, 3), real)
    Own6: Any = wp.types.matrix((own, 6), real)
    Links2: Any = wp.types.matrix((capacity, 2), real)
    Rows1: Any = wp.types.vector(3 * own, real)
    Rows3: Any = wp.types.matrix((3 * own, 3), real)
    # Apart from the others, because they are indexed by what the compiler does not know.
    Table: Any = wp.types.vector(3 * own * rows, real)
    Square: Any = wp.types.vector(own * held, real)

    @wp.struct
    class Own:
        """Contacts of a thread; each has three rows, its normal and two tangents."""

        link: OwnWhole
        arc: Own1
        gap: Own1
        """Rate of closing that just closes the gap (negative gap over the step)."""
        mu: Own1
        at: Own3
        axis: Rows3
        free: Rows1
        """Rate without contact forces."""
        force: Rows1
        rate: Rows1
        """Rate with them, less what just closes the gap."""
        block: Own6
        """Compliance to the contact's own forces."""

    @wp.struct
    class Grasp:
        """The problem of a whisker and how far its solution is."""

        lane: wp.int32
        part: wp.int32
        """Place of the thread in its group."""
        live: wp.int32
        """Whether the group has a whisker or only keeps others company."""
        each: wp.int32
        """Contacts of a thread."""
        loose: wp.int32
        """Zero, which the compiler does not know: it keeps it from writing loops out."""
        links: wp.int32
        seen: wp.int32
        """Places of possible contact."""
        before: wp.int32
        """Contacts of the last step."""
        h: real
        contacts: wp.int32
        taken: wp.int32
        """Bits of the places taken as contacts."""
        span: wp.int32
        """Most contacts of a whisker of the warp."""
        top: wp.int32
        """Last link with a contact, of all whiskers of the warp."""
        settled: wp.int32
        change: real
        """How far (mm) the last sweep's forces missed."""
        moved: real
        """What it changed in the forces, and their sum."""
        whole: real

    kinds = (
        (Links2, vec2),
        (Own1, real),
        (Own3, vec3),
        (Own6, vec6),
        (Rows1, real),
        (Rows3, vec3),
        (Table, real),
        (Square, real),
    )
    return SimpleNamespace(
        Own=Own,
        Grasp=Grasp,
        Table=Table,
        Square=Square,
        Rows1=Rows1,
        Rows3=Rows3,
        Own1=Own1,
        Links2=Links2,
        row=reader(*dict.fromkeys((*kinds, (OwnWhole, wp.int32)))),
        own=own,
        rows=rows,
        tall=1 if lanes == 1 else 0,
        seen_most=contacts_for(capacity) + SPARE,
    )
