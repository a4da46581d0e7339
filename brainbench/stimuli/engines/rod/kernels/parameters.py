"""Types and sizes that the other modules are written for; :func:`~brainbench.stimuli.engines.rod.kernels.specialize`
sets them before it loads a module."""

import warp as wp

from brainbench.stimuli.engines.rod.limits import MESHES, contacts_for

real = wp.float32
"""Type of all numbers: ``warp.float32`` or ``warp.float64``."""
capacity = 12
"""Links that fit."""
hinges = 2
"""Hinges of a joint: two for bending; with three, the last lets the whisker twist."""
yields = False
"""True: follicles give way, see ``FollicleConstants``."""
rolls = False
"""True: rest shapes leave their plane."""
smooth = False
"""True: contacts touch the centre line of the bent rod (``centre_line``); False: the straight links."""
flows = False
"""True: air flows, whose drag whiskers feel."""
against = MESHES
"""Kinds of shapes that there are to touch, see ``limits``."""
sliced = False
"""True: whiskers pause for distances and contact forces."""
recorded = False
"""True: whiskers pause after some steps, whose states and contacts the recorder writes down (``specialize``)."""
cuda = False
"""True: the code is for a GPU."""
bounds: tuple[int, int] | None = None
"""CUDA launch bounds of the kernel that takes steps."""
max_contacts = contacts_for(capacity)
"""Contacts that fit: they are solved together."""
stage = 0
"""Part of a step that a kernel takes of whiskers that pause: 1 up to the distances that it asks for, 2 from these to
the contact forces; 0 the whole."""
group_size = 1
"""Threads that work together on one whisker's contacts, or on one link's distance."""
queue = 0
"""Queue of contact problems that a kernel takes."""


def module_options() -> dict[str, object]:
    """Return Warp's options of the modules: on a GPU divisions and roots are approximate in single precision.

    Warp's own flags for a processor inline without bound, which is no faster here and takes longer to compile.
    """
    return {"fast_math": cuda and real is wp.float32, "cpu_compiler_flags": "-march=native"}
