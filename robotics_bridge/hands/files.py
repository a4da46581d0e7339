"""Files of hands: what MuJoCo reads of a URDF or MJCF file, mended where authors leave something open."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError, brief, listing
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_text
from robotics_bridge.hands.references import KIND, checked_xml

_log = logging.getLogger(__name__)

_DEFAULTED = ("geom", "joint", "site", "actuator", "tendon", "equality", "pair")
"""Elements that a scene may add to a hand."""
_IDENTITY = {"classname", "compiler", "default", "frame", "id", "info", "name", "parent", "path", "plugin", "signature"}
"""Attributes of an element that say which one it is, not what it is like."""


def read_mjspec(path: Path) -> Any:
    """Read a URDF or MJCF file.

    Meshes for display only are dropped (their files are often absent), degenerate and unbalanced inertias are
    corrected, mesh paths given from the file's own folder are found too, bodies and joints without a name are numbered,
    a hand that floats is fixed, and the file's defaults hold for its own elements alone.

    Raises:
        DataFileNotFoundError: the file is missing.
    """
    mujoco = mujoco_module()
    folder, root = path.parent, checked_xml(path)
    with readable(path, "URDF or MJCF file"):
        if path.suffix.lower() == ".mjcf":
            # MuJoCo chooses how to read a file by its ending, and has no reader for this one.
            spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
            spec.modelfiledir = str(folder)
        else:
            spec = mujoco.MjSpec.from_file(str(path))
        files = [mesh.file for mesh in spec.meshes if mesh.file]
    if any(not (folder / spec.meshdir / name).exists() and (folder / name).exists() for name in files):
        spec.meshdir = ""
    if path.suffix.lower() == ".urdf":
        spec.compiler.discardvisual = True
        # Fixed links join their parents, as their solids should; a sensor keeps the palm from joining the world.
        base = spec.worldbody.first_body()
        kinds = {"type": mujoco.mjtSensor.mjSENS_FRAMEPOS, "objtype": mujoco.mjtObj.mjOBJ_BODY}
        spec.add_sensor(name="palm_pose", objname=base.name, **kinds)
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        # A hand that floats in its file is held by what it is put on; its keyframes would have other sizes.
        if len(joint.parent.find_all(mujoco.mjtObj.mjOBJ_JOINT)) > 1:
            for element in (joint, *spec.keys):
                spec.delete(element)
    for kind, elements in (("link", spec.bodies), ("joint", spec.joints)):
        for number, element in enumerate(elements):
            element.name = element.name or f"{kind}{number}"
    spec.compiler.boundmass = max(spec.compiler.boundmass, 1e-6)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, 1e-9)
    _balance_inertias(spec, path)
    clear_defaults(spec)
    return spec


def clear_defaults(spec: Any) -> None:
    """Reset the main ``<default>`` of a ``mujoco.MjSpec``, so that what is added later is as it is written.

    Elements took their defaults when they were read; without this, a default of a hand's file (such as ``contype=0`` or
    ``gear=3``) would also change the drives and objects that a scene adds to it.
    """
    plain = mujoco_module().MjSpec()
    for kind in _DEFAULTED:
        target, source = getattr(spec.default, kind), getattr(plain.default, kind)
        for name in (name for name in dir(source) if not name.startswith("_") and name not in _IDENTITY):
            value = getattr(source, name)
            if not callable(value):
                setattr(target, name, value)


def _balance_inertias(spec: Any, path: Path) -> None:
    """Let the compiler balance inertias that no body can have, and name their links."""
    unbalanced = []
    for body in (body for body in spec.bodies if body.explicitinertial):
        xx, yy, zz, xy, xz, yz = body.fullinertia
        full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = np.sort(body.inertia if np.isnan(full).any() else np.linalg.eigvalsh(full))
        if moments[0] < -1e-9 * abs(moments[2]):
            raise DataError(
                f"The inertia of link {brief(body.name)} in {brief(str(path))} has the principal moments "
                f"{', '.join(f'{moment:.3g}' for moment in moments)} kg·m²; none may be below 0."
            )
        # Of any distribution of mass, two principal moments together reach the third.
        if moments[0] + moments[1] < moments[2] * (1 - 1e-9):
            unbalanced.append(body.name)
    if unbalanced:
        spec.compiler.balanceinertia = True
        _log.warning(
            "Hand %s has inertias that no body can have (two principal moments together are less than the third) on %s;"
            " each is replaced by its mean.", brief(path.stem), listing(unbalanced),
        )  # fmt: skip


def stated_speeds(path: Path | None) -> dict[str, float]:
    """Return joint → largest speed (rad/s or m/s) of a URDF file, which MuJoCo does not keep; 0 states none."""
    if path is None or path.suffix.lower() != ".urdf":
        return {}
    with readable(path, "URDF or MJCF file"):
        root = ElementTree.fromstring(read_text(path, KIND))
        limits = {joint.get("name", ""): joint.find("limit") for joint in root.iter("joint")}
        speeds = {name: float(limit.get("velocity", 0)) for name, limit in limits.items() if limit is not None}
    return {name: speed for name, speed in speeds.items() if speed > 0}
