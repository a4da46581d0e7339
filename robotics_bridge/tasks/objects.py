"""Objects that hands hold: shapes made of primitives, so that environments can differ in numbers alone.

Metres, kilograms. A shape is a few solids on one body; shapes of one task share the same list of solids, where a shape
that lacks one has it as a grain of a tenth of a millimetre inside another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, check_name, check_number
from brainbench.core.limits import Limit, Positive, limited
from robotics_bridge.physics import Geometry
from robotics_bridge.tasks.settings import unit_vector

GRAIN = 1e-4  # half size of the stand-in for a solid that a shape lacks [m]
LARGEST = 3.0  # half size above which numbers of a hand's object look like millimetres [m]
_SIZES = {"box": 3, "cylinder": 2, "capsule": 2, "sphere": 1}


@limited(of="{} of an object")
class ObjectShape:
    """One object: its solids and its outer measures."""

    name: str
    solids: Annotated[tuple[Geometry, ...], Limit(shortest=1)]
    """Boxes, cylinders, capsules and spheres in the body's frame."""
    extent: tuple[Positive, Positive, Positive]
    """Edges of the box around it, along the body's axes [m]."""
    bottom: float
    """Depth below the body's origin to which it reaches when upright [m]."""
    round_about: tuple[float, float, float] | None = None
    """Axis of the body about which the shape looks the same from everywhere, made unit length; None without one."""

    def __post_init__(self) -> None:
        for solid in self.solids:
            check_name(f"kind of a solid of {self.name!r}", solid.kind, _SIZES)
            check_number(f"size of the {solid.kind} of {self.name!r} in metres", max(solid.size), most=LARGEST)
        if self.round_about is not None:
            axis = unit_vector(f"round_about of the object {self.name!r}", self.round_about, 3)
            object.__setattr__(self, "round_about", axis)

    def scaled(self, factor: float) -> ObjectShape:
        """Return the shape with all lengths multiplied."""

        def _longer(lengths: tuple[float, ...]) -> Any:
            return tuple(factor * one for one in lengths)

        # Lengths grow by the factor, the density stays: mass grows with its cube.
        solids = tuple(replace(one, size=_longer(one.size), position=_longer(one.position)) for one in self.solids)
        name = f"{self.name}×{factor:.3g}"
        return replace(self, name=name, solids=solids, extent=_longer(self.extent), bottom=factor * self.bottom)


def box(x: float, y: float, z: float) -> ObjectShape:
    """Return a block with these edges [m]."""
    return ObjectShape(f"box {x:g} {y:g} {z:g}", (Geometry(kind="box", size=(x / 2, y / 2, z / 2)),), (x, y, z), z / 2)


def cylinder(radius: float, height: float) -> ObjectShape:
    """Return an upright cylinder [m]."""
    solid = Geometry(kind="cylinder", size=(radius, height / 2))
    extent = (2 * radius, 2 * radius, height)
    return ObjectShape(f"cylinder {radius:g} {height:g}", (solid,), extent, height / 2, round_about=(0.0, 0.0, 1.0))


def ball(radius: float) -> ObjectShape:
    """Return a ball [m]."""
    return ObjectShape(
        f"ball {radius:g}", (Geometry(kind="sphere", size=(radius,)),), (2 * radius, 2 * radius, 2 * radius), radius
    )


_UPRIGHT_Y = (math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0)  # turns the z axis of a primitive onto the body's y axis


def screwdriver(length: float, handle_length: float, handle_radius: float, shaft_radius: float) -> ObjectShape:
    """Return a screwdriver along the body's y axis, tip at the origin, handle above [m].

    The handle is a cylinder, the shaft a capsule that ends in the tip.
    """
    if not 0 < handle_length < length:
        raise UsageError(f"The handle is shorter than the tool; received {handle_length} m of {length} m.")
    handle = Geometry(
        kind="cylinder", size=(handle_radius, handle_length / 2), position=(0.0, length - handle_length / 2, 0.0),
        quaternion=_UPRIGHT_Y,
    )  # fmt: skip
    # A capsule's half length leaves out its round ends, so that the lower one ends at the tip and the upper in the
    # handle.
    free = length - handle_length
    shaft = Geometry(
        kind="capsule", size=(shaft_radius, (free - shaft_radius) / 2), position=(0.0, (free + shaft_radius) / 2, 0.0),
        quaternion=_UPRIGHT_Y,
    )  # fmt: skip
    wide = 2 * max(handle_radius, shaft_radius)
    return ObjectShape(f"screwdriver {handle_radius:g}", (handle, shaft), (wide, length, wide), 0.0)


def with_sizes(shapes: Sequence[ObjectShape], span: tuple[float, float]) -> tuple[ObjectShape, ...]:
    """Return every shape at eight sizes, evenly from the smallest to the largest factor of a span.

    Neighbours differ in both, so that a few environments, which take them in turn, have all sizes and shapes.
    """
    if span == (1.0, 1.0):
        return tuple(shapes)
    factors = [span[0] + (span[1] - span[0]) * index / 7 for index in range(8)]
    count, round_ = len(shapes), math.lcm(len(shapes), 8)
    # Every pair once: after as many as repeat the first pair, sizes go one further.
    order = [(index % count, (index + index // round_) % 8) for index in range(8 * count)]
    return tuple(shapes[shape].scaled(factors[size]) for shape, size in order)


def slots(shapes: Sequence[ObjectShape]) -> tuple[str, ...]:
    """Return the kinds of solids that hold every shape: as many of each kind as any shape has."""
    kinds = sorted({solid.kind for shape in shapes for solid in shape.solids})
    most = {kind: max(sum(s.kind == kind for s in shape.solids) for shape in shapes) for kind in kinds}
    return tuple(kind for kind in kinds for _ in range(most[kind]))


def add_object(
    spec: Any, name: str, shape: ObjectShape, kinds: Sequence[str], *, density: float, **contact: Any
) -> None:
    """Add a free body with the solids of a shape, ``<name>_<number>``, to a ``mujoco.MjSpec``.

    The kinds are those of :func:`slots` for all shapes of the task; the density is in kg/m³, ``contact`` holds settings
    of the geometries, e.g. ``friction``.
    """
    mujoco = mujoco_module()
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    waiting = list(shape.solids)
    middle = shape.solids[0]
    for index, kind in enumerate(kinds):
        solid = next((s for s in waiting if s.kind == kind), None)
        if solid is not None:
            waiting.remove(solid)
        used = solid or Geometry(kind=kind, size=(GRAIN,) * _SIZES[kind], position=middle.position)
        # What the shape takes part in decides: friction of the object alone, whatever the hand is made of.
        body.add_geom(
            name=f"{name}_{index}", type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"),
            size=[*used.size, 0.0, 0.0][:3], pos=used.position,
            quat=used.quaternion, density=density if solid is not None else 0.0, priority=1, **contact,
        )  # fmt: skip


CUBES = tuple(
    box(*(edge / 1000 for edge in edges))
    for edges in (
        (36, 40, 42), (42, 42, 42), (35, 35, 35), (40, 40, 40), (45, 45, 45), (42, 42, 42), (34, 35, 40),
        (31, 38, 42), (38, 45, 41), (39, 33, 44), (41, 37, 30), (42, 34, 43), (43, 39, 35), (40, 41, 36), (44, 39, 35),
    )
)  # fmt: skip
"""The published blocks of the two reorientation tasks (released settings of the thesis)."""
PRIMITIVES = (*CUBES, cylinder(0.020, 0.042), cylinder(0.017, 0.038))  # blocks and cylinders
SCREWDRIVERS = (
    screwdriver(0.2032, 0.0960, 0.0218, 0.0035), screwdriver(0.2032, 0.0960, 0.0223, 0.0040),
    screwdriver(0.2032, 0.1090, 0.0195, 0.0030), screwdriver(0.2032, 0.1000, 0.0210, 0.0028),
)  # fmt: skip
"""Four tools of 8 inches; handle lengths and radii measured on the released meshes."""
