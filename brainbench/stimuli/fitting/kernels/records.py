"""Steps as they are written down: state, length and pressing contacts of each. Letters: step of the segment."""

import warp as wp

from ..algebra import JointVector, vec3, vec6
from ..motion import Instant
from ..parameters import real


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


@wp.struct
class ContactRecord:
    """A contact that pressed in a step."""

    link: wp.int32
    shape: wp.int32
    share: real
    """Place along the link, 0 to 1; at 1 its end touches."""
    gap: real
    friction: real
    normal: vec3
    force: vec3
    curvature: vec6
    """Second derivatives of the distance from the object at the axis (xx yy zz xy xz yz; 1/mm)."""


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
    count: wp.array(dtype=wp.int32)
    """[job] steps of the segment."""
