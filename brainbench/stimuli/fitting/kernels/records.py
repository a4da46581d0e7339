"""Steps as they are written down: state, length and pressing contacts of each. Letters: step of the segment."""

import warp as wp

from ..algebra import JointVector, vec3, vec6
from ..motion import Instant
from ..parameters import real, smooth


@wp.struct
class StepRecord:
    """A step that was taken, see ``recording``."""

    time: Instant
    """When it began."""
    length: real
    reading: wp.int32
    """Result that it wrote; negative for none."""
    contacts: wp.int32
    """Contacts that press."""
    inexact: wp.int32
    """1: its contact forces were not solved to rounding."""
    open_gap: real
    """Least gap at the end of the step of what could touch and does not press."""
    lead: real
    """Least distance by which a link that presses was chosen before the next one, which touches the same."""
    if smooth:
        held: wp.int32
        """Contacts of the last step."""
        taken: wp.int32
        """Contacts of this step: those that press, then those that do not."""


@wp.struct
class ContactRecord:
    """A contact that pressed in a step."""

    link: wp.int32
    shape: wp.int32
    triangle: wp.int32
    """Of a surface, that it touches."""
    share: real
    """Place along the link, 0 to 1; at 1 its end touches."""
    gap: real
    friction: real
    point: vec3
    """Place on the skin, from the base point."""
    normal: vec3
    force: vec3
    curvature: vec6
    """Second derivatives of the distance from the object at the axis (xx yy zz xy xz yz; 1/mm)."""
    if smooth:
        rank: wp.int32
        """Place among the contacts of the step."""
        arc: real
        along: vec3
        """As in ``state.ContactCandidates``."""
        bending: vec3
        tangent: vec3
        start_slide: real
        end_slide: real


@wp.struct
class SteadyRecord:
    """A contact of the last step: arc, and mean of its force."""

    arc: real
    push: vec3


@wp.struct
class StepRecords:
    """Steps of a segment, in order. Letters: step of the segment."""

    step: wp.array2d(dtype=StepRecord)
    """[step, job]"""
    angle: wp.array3d(dtype=JointVector)
    """[step, link, job] at the beginning of the step."""
    rate: wp.array3d(dtype=JointVector)
    """[step, link, job] at the beginning of the step."""
    acceleration: wp.array3d(dtype=JointVector)
    """[step, link, job] that the step found."""
    contact: wp.array3d(dtype=ContactRecord)
    """[step, contact, job]"""
    if smooth:
        steady: wp.array3d(dtype=SteadyRecord)
        """[step, contact, job] of the step before, in the order in which the solver has them."""
    count: wp.array(dtype=wp.int32)
    """[job] steps of the segment."""
