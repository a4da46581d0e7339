"""A hand ready for use: our own, or any URDF or MJCF file."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError, UsageError, brief, check_each, check_kind, check_name, listing
from brainbench.core.files import content_hash
from brainbench.core.reading.regular import readable
from robotics_bridge.hands.files import read_mjspec, stated_speeds
from robotics_bridge.hands.layouts import Layout, Pad, check_names, is_probe_file, pad_probes, read_probes, select
from robotics_bridge.hands.tree import Tree, cast_grid, doubts_of, geoms_of, overlaps, palmar_directions
from robotics_bridge.sensors.probes.placement import Probes

_log = logging.getLogger(__name__)

_AUTO_GRIDS = {
    "low": {"tips": (3, 3, 0.004), "fingers": (2, 3, 0.004), "palm": (4, 3, 0.004)},
    "med": {"tips": (4, 5, 0.004), "fingers": (3, 4, 0.004), "palm": (7, 5, 0.004)},
    "high": {"tips": (6, 8, 0.002), "fingers": (6, 7, 0.0016), "palm": (20, 11, 0.0016)},
}
"""Rows, columns and radius (m) on a link of a hand without a layout of its own."""
UNKNOWN_SPEED = 5.0  # speed (rad/s) that counts as the largest of a hinge whose data states none
LEVER = 0.05
"""Length of a finger (m) whose tip moves as a slide, where a number is stated for hinges alone: 1 rad is .05 m."""
_PHYSICS = (
    "body_mass", "body_inertia", "body_pos", "body_ipos", "jnt_axis", "jnt_pos", "jnt_range", "jnt_stiffness",
    "dof_armature", "dof_damping", "dof_frictionloss", "geom_friction", "geom_pos", "geom_size",
    "actuator_gainprm", "actuator_biasprm", "actuator_forcerange",
)  # fmt: skip
"""Numbers of a compiled hand by which it moves and feels."""


@dataclass(frozen=True, eq=False)
class Hand:
    """A hand: its model, what its links are for, and where its probes sit."""

    name: str
    palm: str
    """Name of the link that carries the fingers."""
    fingers: Mapping[str, tuple[str, ...]]
    """Finger → its links from palm to tip."""
    path: Path
    """Its URDF or MJCF file."""
    pads: Mapping[str, Pad] = field(default_factory=dict)
    """Link → sensing surface of one of our own hands; empty for any other."""
    speeds: Mapping[str, float] = field(default_factory=dict)
    """Joint → its rated speed [rad/s], where the file cannot state it."""
    custom: Layout | None = None
    """Probes of :meth:`with_probes`, the resolution ``custom``."""
    couplers: frozenset[str] = frozenset()
    """Links of fingers that only move others, such as the rods of a linkage; they get no taxels."""
    nested: frozenset[tuple[str, str]] = frozenset()
    """Pairs of links held by the world, and links that they carry, which lie in one another at rest: as all other
    neighbours along a joint, they do not collide."""

    def mjspec(self) -> Any:
        """Return a new ``mujoco.MjSpec`` of the hand, for scenes to attach; the palm is fixed to the world."""
        spec = read_mjspec(self.path)
        for below, above in sorted(self.nested):
            spec.add_exclude(bodyname1=below, bodyname2=above)
        return spec

    @property
    def source(self) -> str:
        """What :func:`robotics_bridge.hands.load` takes to make it again: a name of ours, or a path."""
        return self.name if self.pads else str(self.path)

    @cached_property
    def model(self) -> Any:
        """The compiled ``mujoco.MjModel`` of the hand alone."""
        return self.mjspec().compile()

    @cached_property
    def physics(self) -> str | None:
        """Hash of the masses, drives, frictions and places of a hand of a file; None for our own hands."""
        if self.pads:
            return None
        # Six digits: what compilers of other machines make of the rest is no other hand.
        return content_hash(*([f"{x:.6g}" for x in getattr(self.model, name).ravel()] for name in _PHYSICS))

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the hinges and slides, in the model's order."""
        return tuple(self.model.joint(int(number)).name for number in self.joint_numbers)

    @property
    def joint_numbers(self) -> NDArray[np.intp]:
        """Numbers [J] of the hinges and slides among the model's joints."""
        return np.flatnonzero(np.isin(self.model.jnt_type, (2, 3)))

    def lever(self, joints: Iterable[str]) -> NDArray[np.float64]:
        """Return the factors [J] on what is stated in rad: 1 of hinges, :data:`LEVER` (m per rad) of slides."""
        slide = mujoco_module().mjtJoint.mjJNT_SLIDE
        return np.array([LEVER if self.model.joint(name).type[0] == slide else 1.0 for name in joints])

    def rated_speeds(self, joints: Iterable[str]) -> NDArray[np.float64]:
        """Return the largest speeds [J] (rad/s or m/s) of joints.

        Where none is stated (as in any MJCF file), it is taken to be :data:`UNKNOWN_SPEED`, with a warning; of slides
        :data:`LEVER` times that.
        """
        names = list(joints)
        speeds = stated_speeds(self.path) | dict(self.speeds)
        if assumed := [name for name in names if name not in speeds]:
            slow = f"slides: {UNKNOWN_SPEED * LEVER:g} m/s"
            assumption = f"{UNKNOWN_SPEED:g} rad/s ({slow}) counts as the largest of {listing(assumed)}"
            _log.warning("Hand %s states no speed for %d joints: %s.", brief(self.name), len(assumed), assumption)
            speeds |= dict(zip(assumed, UNKNOWN_SPEED * self.lever(assumed), strict=True))
        return np.array([speeds[name] for name in names])

    @property
    def tips(self) -> tuple[str, ...]:
        """The last link of every finger."""
        return tuple(chain[-1] for chain in self.fingers.values())

    def links(self, placement: str = "hand") -> tuple[str, ...]:
        """Return the links of a placement: ``hand``, ``fingers`` (tips included), ``tips`` or ``palm``."""
        check_names("low", placement)
        finger = tuple(name for chain in self.fingers.values() for name in chain)
        chosen = {"tips": self.tips, "fingers": finger, "palm": (self.palm,), "hand": (self.palm, *finger)}
        return chosen[placement]

    def layout(self, resolution: str = "low", placement: str = "hand") -> Layout:
        """Return the probes of each link.

        Our hands have exactly the counts of the thesis (table 4.11). On any other hand, grids are cast onto the
        palmar side of the links, which is where they move when their joints flex or jaws close; see
        :meth:`with_probes` for a layout of your own, which may also be named as a probe file in place of a resolution.
        """
        links = self.links(placement)
        if is_probe_file(resolution):
            return self.with_probes(resolution).layout("custom", placement)
        if resolution == "custom" and self.custom is not None:
            return select(self.custom, links)
        check_names(resolution, placement)
        if self.pads:
            spec = self.mjspec()
            solids = {link: spec.body(link).first_geom() for link in self.pads if link in links}
            return {link: pad_probes(solid, self.pads[link], resolution) for link, solid in solids.items()}
        return self._cast(resolution, links)

    def with_probes(self, source: str | os.PathLike[str] | Layout) -> Hand:
        """Return the hand with a layout from a probe file (:func:`read_probes`) or a mapping of link to probes."""
        layout = dict(source) if isinstance(source, Mapping) else read_probes(source)
        if not layout:
            raise UsageError(f"A layout of hand {self.name!r} needs at least one link with probes; received none.")
        links = [self.model.body(index).name for index in range(1, self.model.nbody)]
        check_each("link", layout, links)
        for link, probes in layout.items():
            check_kind(f"layout of link {link!r}", probes, Probes, "Probes(...)")
        return replace(self, custom=layout)

    def _cast(self, resolution: str, links: tuple[str, ...]) -> Layout:
        """Cast a grid on the inner side of each link; links that get none are named in a warning."""
        layout: Layout = {}
        reasons: list[str] = []
        facing = palmar_directions(self.model, self.palm, self.fingers)
        for link in (link for link in links if link not in self.couplers):
            place = "palm" if link == self.palm else "tips" if link in self.tips else "fingers"
            rows, columns, radius = _AUTO_GRIDS[resolution][place]
            if not geoms_of(self.model, self.model.body(link).id):
                reasons.append(f"{link!r} has no geometry")
            elif link not in facing:
                reasons.append(f"no joint tells which side of {link!r} touches")
            else:
                settings = {"facing": facing[link], "radius": radius}
                for extent in (0.8, 0.4):
                    try:
                        layout[link] = cast_grid(self.model, link, rows, columns, **settings, extent=extent)
                        break
                    except UsageError as error:
                        reason = f"{link!r}: {str(error).rstrip('.')}"
                else:
                    reasons.append(reason)
        if not layout:
            raise UsageError(
                f"Hand {self.name!r} gets no taxels on {', '.join(links)}: {'; '.join(reasons)}. Place them with "
                "Hand.with_probes (a probe file, or link → Probes)."
            )
        if reasons:
            _log.warning("Hand %s gets no taxels on some links: %s.", brief(self.name), "; ".join(reasons))
        return layout


def all_from_file(path: Path) -> tuple[Hand, ...]:
    """Return the hands of a file, that with most fingers first; palms and fingers follow from its tree.

    The palm is the body from which most branches of joints part; a finger is a branch, or what a closed loop makes of
    several, named by its tip.
    """
    with readable(path, "URDF or MJCF file"):
        model = read_mjspec(path).compile()
        for name in ("geom_friction", "dof_damping", "dof_armature"):
            if (getattr(model, name) < 0).any():
                raise DataError(f"{brief(str(path))} has a {name} below 0; give 0 or more.")
    branches = Tree(model).hands()
    if not branches:
        raise DataError(f"{str(path)!r} holds no hand: it has no joints.")

    def _names(bodies: Iterable[int]) -> tuple[str, ...]:
        return tuple(model.body(body).name for body in bodies)

    (nested, jammed), hands = overlaps(model), []
    for hand in branches:
        fingers = {model.body(tip).name: _names(chain) for tip, chain in hand.fingers.items()}
        couplers = frozenset(_names(hand.couplers))
        name = path.stem if len(branches) == 1 else f"{path.stem}-{model.body(hand.palm).name}"
        hands.append(Hand(name, model.body(hand.palm).name, fingers, path, couplers=couplers, nested=nested))
        for doubt in doubts_of(model, hands[-1].links(), jammed):
            _log.warning("Hand %s: %s.", brief(name), doubt)
    return tuple(hands)


def from_file(path: Path, palm: str | None = None) -> Hand:
    """Return the hand of a file, or of several the one with that palm; what gets no taxels is named."""
    hands = all_from_file(path)
    first = hands[0]
    if palm is not None:
        check_name("palm", palm, [hand.palm for hand in hands])
        return next(hand for hand in hands if hand.palm == palm)
    if len(hands) > 1:
        others = listing([hand.palm for hand in hands[1:]])
        _log.warning(
            "%s holds %d hands: that of palm %s is taken, and links of %s get no taxels. hands.load_all reads all, "
            "hands.load(path, palm=...) another.", brief(path.name), len(hands), brief(first.palm), others,
        )  # fmt: skip
    if first.couplers:
        _log.warning("Hand %s: %s only move other links and get no taxels.", brief(path.stem),
                     listing(sorted(first.couplers)))  # fmt: skip
    # The name of a file's hand is that of the file, whatever else the file holds.
    return replace(first, name=path.stem)
