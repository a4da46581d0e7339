"""A hand ready for use: our own, or any URDF or MJCF file."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError, UsageError, shown, unknown_name
from brainbench.core.reading.regular import check_file, readable
from brainbench.core.reading.texts import read_text
from robotics_bridge.hands.layouts import Layout, check_names, pad_probes, palm_side, read_probes, select
from robotics_bridge.hands.spec import HandSpec, build

_AUTO_GRIDS = {
    "low": {"tips": (3, 3, 0.004), "fingers": (2, 3, 0.004), "palm": (4, 3, 0.004)},
    "med": {"tips": (4, 5, 0.004), "fingers": (3, 4, 0.004), "palm": (7, 5, 0.004)},
    "high": {"tips": (6, 8, 0.002), "fingers": (6, 7, 0.0016), "palm": (20, 11, 0.0016)},
}
"""Rows, columns and radius (m) on a link of a hand without a layout of its own."""
_NAMES = {"name", "class", "childclass", "joint", "body", "link", "geom", "site", "mesh", "material", "file"}
"""Attributes of URDF and MJCF that hold words."""
_LARGEST = 1e15
"""Magnitude of numbers in a hand's file that no hand has."""
_CROSSED = 0.012
"""Joints nearer to each other (m) act on a link together."""


@dataclass(frozen=True, eq=False)
class Hand:
    """A hand: its model, what its links are for, and where its probes sit."""

    name: str
    palm: str
    """Name of the link that carries the fingers."""
    fingers: Mapping[str, tuple[str, ...]]
    """Finger → its links from palm to tip."""
    spec: HandSpec | None = None
    """The data of one of our own hands."""
    path: Path | None = None
    """The file of any other."""
    probes: Mapping[str, Layout] = field(default_factory=dict)
    """Resolution → layout read from a probe file; ``custom`` of :meth:`with_probes`."""

    def mjspec(self) -> Any:
        """Return a new ``mujoco.MjSpec`` of the hand, for scenes to attach; the palm is fixed to the world.

        Raises:
            UsageError: the hand has neither data nor a file.
            DataError: its file is missing, or MuJoCo cannot read it.
        """
        if self.spec is not None:
            return build(self.spec)
        if self.path is None:
            raise UsageError(f"Hand {self.name!r} has neither data nor a file.")
        return read_mjspec(self.path)

    @cached_property
    def model(self) -> Any:
        """The compiled ``mujoco.MjModel`` of the hand alone."""
        return self.mjspec().compile()

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the hinges and slides, in the model's order."""
        model = self.model
        return tuple(model.joint(index).name for index in range(model.njnt) if model.jnt_type[index] in (2, 3))

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
        palmar side of the links, which is where they move when their joints flex; see :meth:`with_probes` for a
        layout of your own.

        Raises:
            UsageError: resolution or placement are unknown.
        """
        links = self.links(placement)
        if resolution in self.probes:
            return select(self.probes[resolution], links)
        check_names(resolution, placement)
        if self.spec is not None:
            return {
                link.name: pad_probes(link, link.grids[resolution])
                for link in self.spec.links
                if link.name in links and resolution in link.grids
            }
        return self._cast(resolution, links)

    def with_probes(self, source: str | os.PathLike[str] | Layout, resolution: str = "custom") -> Hand:
        """Return the hand with a layout from a probe file (:func:`read_probes`) or a mapping of link to probes.

        Raises:
            UsageError: it names a link that the hand does not have.
        """
        layout = source if isinstance(source, dict) else read_probes(source)
        known = [self.model.body(index).name for index in range(1, self.model.nbody)]
        for link in layout:
            if link not in known:
                raise unknown_name("link", link, known)
        return Hand(self.name, self.palm, self.fingers, self.spec, self.path, {**self.probes, resolution: layout})

    def _cast(self, resolution: str, links: tuple[str, ...]) -> Layout:
        from robotics_bridge.hands.surface import cast_grid, geoms_of

        found: Layout = {}
        facing = palmar_directions(self.model, self.palm, self.fingers)
        for link in links:
            place = "palm" if link == self.palm else "tips" if link in self.tips else "fingers"
            rows, columns, radius = _AUTO_GRIDS[resolution][place]
            if link not in facing or not geoms_of(self.model, self.model.body(link).id):
                continue
            for extent in (0.8, 0.4):
                with contextlib.suppress(UsageError):
                    found[link] = cast_grid(
                        self.model, link, rows, columns, facing=facing[link], radius=radius, extent=extent
                    )
                    break
        return found


def read_mjspec(path: Path) -> Any:
    """Read a URDF or MJCF file.

    Meshes for display only are dropped (their files are often absent), degenerate inertias are bounded, and mesh
    paths given from the file's own folder are found too.

    Raises:
        DataFileNotFoundError: the file is missing.
        DataError: MuJoCo cannot read it.
    """
    mujoco = mujoco_module()

    _check_xml(path)
    folder = path.parent
    with readable(path, "URDF or MJCF file"):
        spec = mujoco.MjSpec.from_file(str(path))
        files = [mesh.file for mesh in spec.meshes if mesh.file]
    if any(not (folder / spec.meshdir / name).exists() and (folder / name).exists() for name in files):
        spec.meshdir = ""
    for name in files:
        # To open a pipe or a device would wait for ever; what is not there is told in compiling.
        if os.path.lexists(place := folder / spec.meshdir / name):
            check_file(place, "mesh file")
    if path.suffix.lower() == ".urdf":
        spec.compiler.discardvisual = True
        # Fixed links join their parents, as their solids should; a sensor keeps the palm from joining the world.
        root = spec.worldbody.first_body()
        spec.add_sensor(
            name="palm_pose", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=root.name
        )
    spec.compiler.boundmass = max(spec.compiler.boundmass, 1e-6)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, 1e-9)
    return spec


def _check_xml(path: Path) -> None:
    """Refuse numbers that are not finite, which MuJoCo takes, and included files that are no files."""
    kind = "hand file (URDF or MJCF)"
    text = read_text(path, kind)
    with readable(path, kind):
        for element in ElementTree.fromstring(text).iter():
            if element.tag == "include":
                _check_xml(path.parent / element.get("file", ""))
            for key, value in element.items():
                for word in value.split() if key not in _NAMES else ():
                    if _is_absurd(word):
                        raise DataError(
                            f"{key!r} of <{shown(element.tag, quoted=False)}> in {shown(str(path))} is {shown(value)}; "
                            f"finite numbers of at most {_LARGEST:g} are needed."
                        )


def _is_absurd(word: str) -> bool:
    try:
        return not abs(float(word)) <= _LARGEST
    except ValueError:
        return False


def from_file(path: Path) -> Hand:
    """Return the hand of a file; palm and fingers follow from its tree.

    The palm is the body from which most branches of joints part; a finger is a branch, named by its tip.

    Raises:
        DataError: the file holds no hand.
    """
    with readable(path, "URDF or MJCF file"):
        model = read_mjspec(path).compile()
        for name in ("geom_friction", "dof_damping", "dof_armature"):
            if (getattr(model, name) < 0).any():
                raise DataError(f"{shown(str(path))} has a {name} below 0; give 0 or more.")
    children: dict[int, list[int]] = {body: [] for body in range(model.nbody)}
    for body in range(1, model.nbody):
        children[int(model.body_parentid[body])].append(body)
    jointed = {body: _joints_below(model, body, children) for body in range(model.nbody)}
    branches = {body: [child for child in children[body] if jointed[child]] for body in range(model.nbody)}
    # The palm is the body with most branches that have joints; of equals the one with the lowest number.
    palm = max(range(model.nbody), key=lambda body: (len(branches[body]), -body))
    if not branches[palm]:
        raise DataError(f"{str(path)!r} holds no hand: it has no joints.")
    fingers: dict[str, tuple[str, ...]] = {}
    for start in branches[palm]:
        chain, body = [start], start
        while following := [child for child in children[body] if jointed[child] or model.body_geomnum[child]]:
            body = max(following, key=lambda child: (jointed[child], model.body_geomnum[child]))
            chain.append(body)
        chain = [body for body in chain if model.body_geomnum[body]] or chain[-1:]
        names = tuple(model.body(body).name for body in chain)
        fingers[names[-1]] = names
    return Hand(path.stem, model.body(palm).name, fingers, path=path)


def _joints_below(model: Any, body: int, children: dict[int, list[int]]) -> int:
    own = sum(int(model.jnt_type[index]) in (2, 3) for index in range(model.njnt) if model.jnt_bodyid[index] == body)
    return own + sum(_joints_below(model, child, children) for child in children[body])


def palmar_directions(model: Any, palm: str, fingers: Mapping[str, tuple[str, ...]]) -> dict[str, np.ndarray]:
    """Return link → the direction [3] of its palmar side, in the link's frame.

    A link's palmar side is where it moves when its joint flexes (of two crossed joints, the one with more range
    counts). A joint that swings as far to both sides spreads or twists the finger and tells nothing: such links
    face as the next one towards the tip does. The palm faces where the finger tips go, along the nearest axis of
    its frame.
    """
    mujoco = mujoco_module()

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    towards: dict[str, np.ndarray] = {}
    tips = []
    for chain in fingers.values():
        known: np.ndarray | None = None
        for place in reversed(range(len(chain))):
            body = model.body(chain[place]).id
            following = data.xpos[model.body(chain[place + 1]).id] if place + 1 < len(chain) else None
            world = _flexed(model, data, body, following)
            if world is None and known is None and place + 1 == len(chain):
                world = _flexed(model, data, body, following, symmetric=True)
            known = known if world is None else world
            if known is not None:
                towards[chain[place]] = data.xmat[body].reshape(3, 3).T @ known
                tips += [known] if place + 1 == len(chain) else []
    if tips and np.linalg.norm(np.mean(tips, axis=0)) > 0.1:
        # Mean flexion of the finger tips in the palm's frame, snapped to the nearest of its axes.
        turned = data.xmat[model.body(palm).id].reshape(3, 3).T @ np.mean(tips, axis=0)
        face = np.argmax(np.abs(turned))
        towards[palm] = np.sign(turned[face]) * np.eye(3)[face]
    return towards


def _flexed(
    model: Any, data: Any, body: int, following: np.ndarray | None, *, symmetric: bool = False
) -> np.ndarray | None:
    """Return where a body goes [3] (world) when its joint flexes; None if that is not known."""
    from robotics_bridge.hands.surface import link_points

    own = link_points(model, body)
    joint = _flexion(model, body)
    if joint < 0 or not len(own):
        return None
    low, high = (float(value) for value in model.jnt_range[joint])
    if not symmetric and abs(high + low) < 0.2 * (high - low):
        return None
    end = following
    if end is None or np.linalg.norm(end - data.xpos[body]) < 1e-6:
        end = data.xpos[body] + data.xmat[body].reshape(3, 3) @ own.mean(axis=0)
    axis = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3) @ model.jnt_axis[joint]
    world = palm_side(axis, end - data.xpos[body], (low, high))
    return world if np.any(world) else None


def _flexion(model: Any, body: int) -> int:
    """Return the joint that flexes a body: of its own and those that cross them, the one with the largest range."""
    best, most = -1, 0.0
    while body > 0:
        for joint in range(int(model.body_jntadr[body]), int(model.body_jntadr[body]) + int(model.body_jntnum[body])):
            span = float(np.ptp(model.jnt_range[joint])) if model.jnt_limited[joint] else 2 * np.pi
            if int(model.jnt_type[joint]) == 3 and span > most:
                best, most = joint, span
        if best >= 0 and np.linalg.norm(model.body_pos[body]) > _CROSSED:
            break
        body = int(model.body_parentid[body])
    return best
