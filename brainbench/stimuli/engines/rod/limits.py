"""Limits of the ``rod`` solver: what it looks at, how long it tries, and when it gives up. mm, ms, rad."""

from brainbench.stimuli.engines.trust import (  # noqa: F401 — kernels take every limit from here
    AT_BASE,
    BENT,
    GAVE_WAY,
    GOT_INSIDE,
    LARGEST_BEND,
    LARGEST_OVERLAP,
    LARGEST_SLIDE,
    LARGEST_START_OVERLAP,
    LOST,
    STARTED_INSIDE,
)

CONTACTS = 8, 14
"""Contacts of one whisker that are solved together, of up to 12 links and of more; the tightest are kept when there are
more. A finely divided whisker that lies on a round face touches it with link after link."""
SPARE = 4
"""Places of possible contact that are watched within a step beyond those; the nearest are kept when there are more."""
CONTACT_ROUNDS = 4
"""Times that contacts are added to a step because the others press the whisker onto them."""
STEADY = 1.0
"""Time (ms) of both means of the forces by which contacts bend the centre line between the joints. Those of one step
would answer to the very bends that they make, and swing."""
LARGE_BEND = 0.4
"""Bend (rad) of a joint at which it is followed by half."""
PRESSED = 1e-5, 1e-9
"""Overlap (mm) at the end of a step, in single and in double precision, from which a place that other contacts press
upon becomes a contact of the same step. What is left is undone in the next step, by a blow that grows as the step
shrinks: between opposed objects two contacts would take turns, each thrown off by the other."""
CLOSED = 1e-3
"""Gap (mm) up to which a place is a candidate, and overlap from which one without room among the contacts is missed."""
LARGEST_FORCE = 1e6
"""Force (mN) of a contact from which it counts as one that no force can resolve."""
FEW_ITERATIONS = 1e-4, 8, 8
"""How contact forces are solved where the fidelity states no tolerance: change of the forces in a sweep (as a share of
them; or error of the gaps, mm) at which sweeps end, most Gauss-Seidel sweeps of one step, and most iterations for the
direction in which one contact slips. The last are too few for some contacts (benchmarks/RESULTS.md, "Contact forces
solved to a tolerance")."""
MOST_ITERATIONS = 400
"""Most sweeps, and most iterations within one, where it states a tolerance."""
TO_ROUNDING = 1e-12, 16, 8
"""How recorded runs solve them, whose sweeps alternate with Newton's steps: derivatives are those of the solution."""
FOLD = 1.2
"""Bend (rad) beyond which a joint stiffens. The last links of a fine tip are so soft that the slightest force folds
them double; what reaches the base through them is nothing."""
STOP = 1e3
"""Stiffness beyond :data:`FOLD` over that of the joint."""
LIGHT = 5e-3
"""Share of a whisker's mass that a quasi-static step keeps. It bounds the way of one step where there is no balance,
as when a whisker slips off; what one step of 1 ms leaves of a slow mode is this share over (omega h)², below .5 %."""
REST = 1e-6
"""Bend (rad) and rate (rad/ms) of every joint below which a whisker without contact is at rest."""
FAR = 3.0
"""Farthest distance (mm) that a query finds; a link further away is asked for again when it may have come nearer."""
ANYWHERE = 1e6
"""The same (mm) for a link that may have got inside unseen: the nearest triangle tells inside from outside."""
PARTS = 8
"""Parts of a link at whose ends its overlap with a surface is measured."""
DEPTH_HALVINGS = 12
"""Halvings by which the deepest place between two of these is found."""
TRIANGLES_TRIED = 9
"""Times that a triangle is sought that is nearer to the centre line of a link, where the last is nearest or beside."""
ASIDE = 1 / 32
"""How far beside, as a share of the link: at an edge of the face with which a line is flush no triangle is nearer."""
BITS = 3
WIDE = 1 << BITS
"""Children of a node of a search tree, and triangles of a leaf."""
LEVELS = 7
"""Levels of boxes that a search keeps track of: enough for 16 million triangles."""
LONGEST_SPAN = 32.0
"""Longest time (ms) between two places where time is kept exactly."""
FINEST = 16
"""Most parts into which a step is split while something is near (``Fidelity.contact_travel``)."""
AFTERMATH = 10.0
"""Longest steps after a contact for which steps stay split so."""
LISTED = 32
"""Shapes nearest to a whisker that it looks at in each step where there are more; the others wait until it has moved
far enough."""
STALE = 0.5
"""Way (mm) after which they are listed again, once one of them may be within reach of a contact."""
WIDEST = 0.8
"""Widest search for contacts (mm)."""
CREVICE = 0.02, 0.06
"""Overlap (mm) that one step may undo, of straight links and of the bent rod, whose soft tip moves beside its links;
deeper ones are undone over several steps, without a blow."""
UNDONE = 0.3
"""Speed (mm/ms) at which an overlap of the bent rod is undone at most. Where the line between the joints jumps, what a
step undoes at once would be a blow that grows as the step shrinks."""


def contacts_for(capacity: int) -> int:
    """Return the contacts that a kernel for chains of at most ``capacity`` links solves together."""
    return CONTACTS[capacity > 12]


WARP = 32
"""Threads of a GPU that run in step."""

GROUPS = (2, 2), (4, 4)
"""Possible contacts of a whisker up to which a group of threads finds their forces on a GPU, and its threads; whiskers
of more have groups of eight, or sixteen."""
DISTANCE_GROUP = 8
"""Threads of a GPU that find the distance of one link together: 1, 2, 4 or 8."""
DISTANCE_BOUNDS = 128, 4
"""CUDA launch bounds of that kernel."""
CONTACT_BOUNDS = 128, 4
"""CUDA launch bounds of these kernels."""
AFTER_DISTANCES, AFTER_CONTACTS, AFTER_OTHERS = 0, 1, 2
"""Queues of paused whiskers: those whose distances were found, those whose contact forces were found, all others."""

NOTHING, PRIMITIVES, MESHES = 0, 1, 2
"""What whiskers may touch: a kernel holds only the code that its scenes need."""

SPHERE, CAPSULE, CYLINDER, BOX, MESH = range(5)
"""Kinds of shapes: sizes are (radius, –, –), (radius, half length, –) twice, half edge lengths, and nothing."""


def contact_iterations(tolerance: float | None) -> tuple[float, int, int]:
    """Return how contact forces are solved to the tolerance of a fidelity, as :data:`FEW_ITERATIONS`."""
    return FEW_ITERATIONS if tolerance is None else (tolerance, MOST_ITERATIONS, MOST_ITERATIONS)
