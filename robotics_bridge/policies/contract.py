"""The contract of an exported policy: what stands in ``FILE.json``, with the range of every value.

All of it is checked once, when it is written and when it is read.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import to_json
from robotics_bridge.hands.observations import OBSERVATIONS
from robotics_bridge.policies.schema import Values
from robotics_bridge.tasks.contact_model import CONTACTS, ContactModel

RATE = (1.0, 1000.0)
"""Control steps per second [Hz]."""
ANGLE = (-4 * math.pi, 4 * math.pi)
"""Positions of joints (rad)."""
MOST_TWIST = 100.0
"""N·m·s."""
SCALE = (-10.0, 10.0)
"""Radians per unit of action; 0 is not allowed."""
JOINTS = 255
"""Most joints; a frame counts them in one byte."""
MOST_NUMBERS = 10_000_000
"""Most numbers of all observations, and of a policy's memory."""
REQUIRED = ("action_map", "contacts", "frozen", "hand", "joints", "rate", "twist")
"""What ``deployment`` must say before a hand can run the policy."""


@dataclass(frozen=True, eq=False)
class PolicyContract:
    """What the file of an exported policy reads, and what a robot needs to run it."""

    inputs: Mapping[str, tuple[int, ...]]
    """Group → shape, in the order of the file."""
    rate: float
    """Control steps per second."""
    hand: str
    """Name of the hand that it was trained on."""
    joints: tuple[str, ...]
    """All driven joints J, in the order of ``proprio``."""
    moved: tuple[str, ...]
    """Joints A that actions move."""
    action_map: Mapping[str, tuple[float, ...]]
    """``default``, ``scale``, ``low`` and ``high`` [A] (rad)."""
    frozen: Mapping[str, float]
    """Joint → position (rad) of those that actions do not move."""
    links: tuple[str, ...] = ()
    """Links with touch, in the order of ``tactile``."""
    observe: str = "none"
    """Tactile observation type."""
    sha256: str = ""
    """Hash of the file of the network; empty in contracts of earlier versions."""
    more: Mapping[str, Any] = field(default_factory=dict)
    """``task``, ``placement``, ``resolution``, ``sub_steps``, ``command`` (what it is told by default) and
    ``action_limit``, where they stand in the contract, and ``twist``, the torsional friction of force taxels (N·m·s;
    None: they hold), and ``contacts``, the contact model in which it was trained."""

    @classmethod
    def read(cls, path: Path) -> PolicyContract:
        """Read a contract.

        Raises:
            DataError: the file is no contract, or a value is out of range, not finite or of another kind.
            UsageError: it does not say what a hand needs; export the policy from a trained run.
        """
        return cls.of(Values.read(path))

    @classmethod
    def of(cls, found: Values) -> PolicyContract:
        """Return the contract of a file's values; errors as :meth:`read`."""
        if not {"inputs", "format", "deployment"} <= set(found.values):
            raise DataError(f"{found.where!r} is not the contract of a policy.")
        if found.values["format"] == "jit":
            raise DataError(
                f"{found.where!r} is of TorchScript, a program that may read and write files; a hand runs ONNX alone: "
                "export the policy again."
            )
        found.text("format", ("onnx",))
        given = found.part("deployment")
        if missing := [name for name in REQUIRED if name not in given.values]:
            raise UsageError(
                f"The contract {found.where!r} does not say {missing[0]!r}, so no hand can run the policy; "
                "export it from a trained run."
            )
        inputs, joints = found.shapes("inputs", MOST_NUMBERS), given.texts("joints", JOINTS)
        if (numbers := sum(map(math.prod, inputs.values()))) > MOST_NUMBERS:
            raise found.error("inputs", f"at most {MOST_NUMBERS:,} numbers", numbers)
        moved, action_map = read_action_map(given.part("action_map"))
        still = given.part("frozen")
        frozen = {name: still.number(name, *ANGLE) for name in still.values}
        if sorted((*moved, *frozen)) != sorted(joints):
            raise given.error("joints", "every joint once, either in 'action_map' or in 'frozen'", list(joints))
        size = 2 * len(joints) + len(moved)
        if inputs.get("proprio", (size,)) != (size,):
            allowed = f"({size},) with {len(joints)} joints and {len(moved)} actions"
            raise found.error("inputs.proprio", allowed, inputs["proprio"])
        links, observe = (), "none"
        if "tactile" in inputs:
            links, observe = given.texts("links", MOST_NUMBERS), given.text("observe", OBSERVATIONS)
            kind, shape = OBSERVATIONS[observe], inputs["tactile"]
            fits = len(shape) == 3 and shape[2] == kind.channels and (not kind.per_link or shape[1] == len(links))
            if not fits:
                items = len(links) if kind.per_link else "N"
                raise found.error("inputs.tactile", f"(S, {items}, {kind.channels}) for {observe!r}", shape)
        said = ("task", "placement", "resolution")
        more: dict[str, Any] = {name: given.text(name) for name in said if name in given.values}
        if "sub_steps" in given.values:
            more["sub_steps"] = given.whole("sub_steps", 1, 1000)
        if "command" in given.values and "command" in inputs:
            more["command"] = given.numbers("command", math.prod(inputs["command"]), -1e6, 1e6)
        if given.values.get("action_limit") is not None:
            more["action_limit"] = given.number("action_limit", 1e-6, 1e6)
        more["twist"] = None if given.values["twist"] is None else given.number("twist", 0.0, MOST_TWIST)
        more["contacts"] = trained_contacts(given.values, found.where)
        return cls(
            inputs, given.number("rate", *RATE), given.text("hand"), joints, moved,
            action_map, frozen, links, observe, found.text("sha256") if "sha256" in found.values else "", more,
        )  # fmt: skip


def trained_contacts(described: Mapping[str, Any], where: str = "config.json") -> ContactModel:
    """Return the contact model in which the policy of a ``config.json`` was trained.

    Runs of versions that did not state it had the published one.

    Raises:
        DataError: a value is of another kind, or out of range.
    """
    if described.get("contacts") is None:
        return CONTACTS["published"]
    found = Values(where, described).part("contacts").fields(ContactModel)
    plain: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in found.items()}
    try:
        return ContactModel(**plain)
    except UsageError as error:
        raise DataError(f"{where!r} is damaged: {error}") from error


def read_action_map(given: Values) -> tuple[tuple[str, ...], dict[str, tuple[float, ...]]]:
    """Return the joints that actions move, and by name the numbers of each; DataError where they make no map."""
    moved = given.texts("names", JOINTS)
    ranges = {"default": ANGLE, "scale": SCALE, "low": ANGLE, "high": ANGLE}
    numbers = {name: given.numbers(name, len(moved), *ends) for name, ends in ranges.items()}
    for joint, low, high, scale in zip(moved, numbers["low"], numbers["high"], numbers["scale"], strict=True):
        if not low < high:
            raise given.error("low", f"less than 'high' ({high:g}) for {joint!r}", low)
        if scale == 0:
            raise given.error("scale", f"not 0 for {joint!r}, which actions move", scale)
    return moved, numbers


def check_contract(contract: Mapping[str, Any], name: str) -> None:
    """Check what is about to be written as the contract ``name``, if it says all that a hand needs (errors: ``of``)."""
    if set(REQUIRED) <= set(contract["deployment"]):
        PolicyContract.of(Values(name, json.loads(to_json(contract))))
