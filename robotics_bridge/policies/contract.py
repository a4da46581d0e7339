"""What stored policies state: the contract of an exported one (``FILE.json``), and whether one fits an environment.

A contract is checked once, when it is written and when it is read; JSON is read as classes that state kinds and ranges.
Errors name the place in the file. A policy fits an environment that is made for its version of the tasks, its hand and
its contacts.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast

import msgspec
from msgspec import Meta

from brainbench.core.errors import DataError, UsageError, brief, check_each, listing, repeats
from brainbench.core.files import read_mapping, to_json, to_plain
from brainbench.core.reading.values import typed_values
from robotics_bridge.envs.step import ActionMap, Angle, Name, Names
from robotics_bridge.hands.observations import OBSERVATIONS
from robotics_bridge.policies.shipped import stored
from robotics_bridge.tasks.settings import CONTACTS, ContactModel, contacts_name
from robotics_bridge.tasks.task import MEASURED, TASK_VERSION, Task

if TYPE_CHECKING:
    from robotics_bridge.envs.env import Env

MOST_NUMBERS = 10_000_000  # most numbers of all observations, and of a policy's memory
Sizes = Annotated[tuple[Annotated[int, Meta(ge=1, le=MOST_NUMBERS)], ...], Meta(min_length=1, max_length=3)]
Groups = Annotated[tuple[tuple[Name, Sizes], ...], Meta(min_length=1)]
"""Group and shape of each observation; a list, since JSON keeps the order of lists alone."""

T = TypeVar("T")


def from_json(kind: type[T], values: Any, where: str) -> T:
    """Return parsed JSON of ``where``, a file or a place in one, as a class."""
    if is_dataclass(kind) and isinstance(values, Mapping):
        check_each(f"setting in {where!r}", values, kind.__dataclass_fields__)
    return typed_values(kind, values, repr(where), advice=f" It stands in {where!r}.")


def wrong(where: str, place: str, received: Any, allowed: str) -> DataError:
    """Return the error for a value at a place of a file."""
    what = f"{place!r} in {where!r}" if place else repr(where)
    return DataError(f"{what} is {brief(received)}: {allowed.rstrip('.')}.")


def shapes_of(groups: Groups, where: str, place: str) -> dict[str, tuple[int, ...]]:
    """Return group → shape; DataError if a group stands there twice or all together have too many numbers."""
    shapes = dict(groups)
    if len(shapes) < len(groups):
        raise wrong(where, place, repeats(name for name, _ in groups), "each group stands there once")
    if (numbers := sum(map(math.prod, shapes.values()))) > MOST_NUMBERS:
        raise wrong(where, place, numbers, f"at most {MOST_NUMBERS:,} numbers are allowed")
    return shapes


RATE = (1.0, 1000.0)
"""Control steps per second [Hz]."""
MOST_TWIST = 100.0  # N·m·s
REQUIRED = ("action_map", "contacts", "frozen", "hand", "joints", "rate", "twist")
"""What ``deployment`` must say before a hand can run the policy."""


@dataclass(frozen=True)
class TrainedMap(ActionMap):
    """The map from actions to targets as it stands in a file; ValueError where it is none."""

    def __post_init__(self) -> None:
        if twice := repeats(self.names):
            raise ValueError(f"'names' has {twice[0][:80]!r} twice")
        for name in ("default", "scale", "low", "high"):
            if len(row := getattr(self, name)) != len(self.names):
                raise ValueError(f"{name!r} has {len(row)} numbers for {len(self.names)} joints")
        for low, high, scale in zip(self.low, self.high, self.scale, strict=True):
            if not low < high:
                raise ValueError(f"'low' must be less than 'high'; received {low:g} and {high:g}")
            if scale == 0:
                raise ValueError("'scale' of a joint that actions move must not be 0")


@dataclass(frozen=True, eq=False)
class PolicyContract:
    """What the file of an exported policy reads, and what a robot needs to run it: the latter as files hold it."""

    inputs: Mapping[str, tuple[int, ...]]
    """Group → shape, in the order of the file."""
    rate: Annotated[float, Meta(ge=RATE[0], le=RATE[1])]
    """Control steps per second."""
    hand: Name
    """Name of the hand that it was trained on."""
    joints: Names
    """All driven joints J, in the order of ``proprio``."""
    moved: tuple[Name, ...]
    """Joints A that actions move."""
    action_map: TrainedMap
    """Map from actions to targets of the joints A; its rows by name may be given, without the names of joints."""
    frozen: dict[str, Angle]
    """Joint → position (rad) of those that actions do not move."""
    links: tuple[Name, ...] = ()
    """Links with touch, in the order of ``tactile``."""
    observe: str = "none"
    """Tactile observation type."""
    sha256: str = ""
    """Hash of the file of the network; empty in contracts of earlier versions."""
    contacts: ContactModel = CONTACTS["published"]
    """Contact model in which it was trained."""
    twist: Annotated[float, Meta(ge=0, le=MOST_TWIST)] | None = None
    """Torsional friction of force taxels [N·m·s]; None: they hold. The rest is None where nothing is stated."""
    task: Name | None = None
    placement: Name | None = None
    resolution: Name | None = None
    probes: Name | None = None
    """Hash of a probe file."""
    sub_steps: Annotated[int, Meta(ge=1, le=1000)] | None = None
    command: tuple[Annotated[float, Meta(ge=-1e6, le=1e6)], ...] | None = None
    """What it is told by default."""
    action_limit: Annotated[float, Meta(ge=1e-6, le=1e6)] | None = None
    starts: Name | None = None
    """What episodes began with, such as ``grasps``, and actions were counted from; None: from ``action_map``."""

    def __post_init__(self) -> None:
        if isinstance(self.action_map, Mapping):
            object.__setattr__(self, "action_map", TrainedMap(self.moved, **self.action_map))
        object.__setattr__(self, "moved", self.action_map.names)

    @classmethod
    def read(cls, path: Path) -> PolicyContract:
        """Read a contract."""
        return cls.of(read_mapping(path, "JSON file of names and values"), path.name)

    @classmethod
    def of(cls, document: Mapping[str, Any], where: str) -> PolicyContract:
        """Return the contract of the values of a file; errors as :meth:`read`."""
        deployment = document.get("deployment")
        if not {"inputs", "format"} <= set(document) or not isinstance(deployment, dict):
            raise DataError(f"{where!r} is not the contract of a policy: it needs 'format', 'inputs' and 'deployment'.")
        if document["format"] == "jit":
            raise DataError(
                f"{where!r} is of TorchScript, a program that may read and write files; a hand runs ONNX alone: "
                "export the policy again."
            )
        if missing := [name for name in REQUIRED if name not in deployment]:
            raise UsageError(
                f"The contract {where!r} does not say {missing[0]!r}, so no hand can run the policy; "
                "export it from a trained run."
            )
        # A file says the inputs elsewhere, and the joints that move in the map of actions alone.
        deployment = {**deployment, "inputs": {}, "moved": ()}
        written = from_json(_Written, {**document, "deployment": deployment}, where)
        given, inputs = written.deployment, shapes_of(written.inputs, where, "inputs")
        joints, moved = given.joints, given.moved
        if sorted((*moved, *given.frozen)) != sorted(joints) or repeats(joints):
            allowed = "every joint stands there once, and either in 'action_map' or in 'frozen'"
            raise wrong(where, "deployment.joints", joints, allowed)
        size = 2 * len(joints) + len(moved)
        if inputs.get("proprio", (size,)) != (size,):
            allowed = f"with {len(joints)} joints and {len(moved)} actions it is ({size},)"
            raise wrong(where, "inputs.proprio", inputs["proprio"], allowed)
        touch: dict[str, Any] = {"links": (), "observe": "none"}
        if "tactile" in inputs:
            touch = {}
            _check_touch(given, inputs["tactile"], where)
        command = given.command if "command" in inputs else None
        if command is not None and len(command) != (count := math.prod(inputs["command"])):
            raise wrong(where, "deployment.command", command, f"the policy reads {count} numbers")
        read = {"inputs": inputs, "sha256": written.sha256, "contacts": trained_contacts(deployment, where)}
        return replace(given, **read, command=command, **touch)


class _Written(msgspec.Struct):
    format: Literal["onnx"]
    inputs: Groups
    deployment: PolicyContract
    sha256: str = ""


def _check_touch(given: PolicyContract, shape: tuple[int, ...], where: str) -> None:
    """Raise DataError unless observation type, links and shape of the touch that a policy reads fit one another."""
    if given.observe not in OBSERVATIONS:
        raise wrong(where, "deployment.observe", given.observe, f"one of {', '.join(OBSERVATIONS)} is allowed")
    if not given.links or repeats(given.links):
        raise wrong(where, "deployment.links", given.links, "different names of links are needed")
    kind = OBSERVATIONS[given.observe]
    items = len(given.links) if kind.per_link else "N"
    if len(shape) != 3 or shape[2] != kind.channels or (kind.per_link and shape[1] != items):
        raise wrong(where, "inputs.tactile", shape, f"(S, {items}, {kind.channels}) is that of {given.observe!r}")


def trained_contacts(described: Mapping[str, Any], where: str = "config.json") -> ContactModel:
    """Return the contact model in which the policy of a ``config.json`` was trained.

    Runs of versions that did not state it had the published one.
    """
    given = described.get("contacts")
    return CONTACTS["published"] if given is None else from_json(ContactModel, given, f"contacts of {where}")


def check_contract(contract: Mapping[str, Any], name: str) -> None:
    """Check what is about to be written as the contract ``name``, if it says all that a hand needs (errors: ``of``)."""
    if set(REQUIRED) <= set(contract["deployment"]):
        PolicyContract.of(json.loads(to_json(contract)), name)


_LOG = logging.getLogger(__name__)
_RATE = 40.0  # control steps per second of teachers that do not state it
_LEARNING = (
    "rewards", "groups", "decoders", "auxiliary", "goal_terms", "start_threshold", "mastered", "narrowing",
)  # fmt: skip
_SAME_ANGLE = 1e-4  # difference of two positions that is rounding [rad]


def world_of(task: Task) -> dict[str, Any]:
    """Return what makes a task as plain values, terms by name, without what the other facts of a run state."""
    stated = ("name", "text", "contacts", "teacher", "student")
    parts = {item.name: getattr(task, item.name) for item in fields(task) if item.name not in stated}
    return json.loads(json.dumps(to_plain(parts), default=lambda term: getattr(term, "__qualname__", str(term))))


def differences(trained: Mapping[str, Any], here: Mapping[str, Any], place: str = "") -> Iterator[str]:
    """Yield what differs between two worlds, by dotted names, but for what learning alone reads."""
    for name in (name for name in here if name in trained and name not in _LEARNING):
        theirs, ours = trained[name], here[name]
        if isinstance(theirs, dict) and isinstance(ours, dict):
            yield from differences(theirs, ours, f"{place}{name}.")
        elif theirs != ours:
            yield f"{place}{name} (trained with {brief(theirs, most=40)}, here {brief(ours, most=40)})"


def with_contacts_of(task: Task, policies: Iterable[str]) -> Task:
    """Return a task with the contacts, and of students the law of forces, of some policies; unchanged without any.

    A policy is a shipped one or the folder of a run; ``zero`` and ``random`` were trained in none.
    """
    facts = {name: described for name in policies if (described := stored(name))}
    contacts = {name: trained_contacts(described) for name, described in facts.items()}
    deployments = [from_json(dict, described.get("deployment", {}), "deployment") for described in facts.values()]
    laws = {from_json(cast(Any, float | None), facts["twist"], "twist") for facts in deployments if "twist" in facts}
    if len(laws) > 1:
        raise UsageError(f"The students {', '.join(facts)} learned from forces of different laws; take one at a time.")
    if laws:
        task = replace(task, taxel_twist=laws.pop())
    models = {*contacts.values()} or {task.contacts}
    if len(models) > 1:
        names = ", ".join(f"{name} ({contacts_name(model)})" for name, model in contacts.items())
        raise UsageError(
            f"The policies were trained with different contacts: {names}. Say which they all get (--change "
            "contacts=firm), or take one at a time."
        )
    return replace(task, contacts=models.pop())


def check_version(described: Mapping[str, Any], name: str) -> None:
    """Check that a policy is of this version of the tasks, by its ``config.json``; raise DataError for another."""
    version = described.get("task_version", 1)
    if version != TASK_VERSION:
        maker = described.get("provenance")
        maker = f" (brainbench {maker.get('version')} made it)" if isinstance(maker, dict) else ""
        raise DataError(
            f"The policy {name!r} is of version {str(version)[:20]} of the tasks, and this package has version "
            f"{TASK_VERSION}: train it again, or use the package of that version{maker}."
        )


def check_actions(described: Mapping[str, Any], env: Env, name: str) -> None:
    """Check that an action means the target, and lasts as long, as in training; raise UsageError where it does not.

    Tasks, their configurations and hands differ in the pose from which actions are counted, and in their units. Earlier
    runs do not state theirs, and earlier teachers no rate: theirs is that of all tasks of the package.
    """
    given = from_json(dict, described.get("deployment", described), f"deployment of {name}")
    if "action_map" not in given:
        return
    action_map, here = from_json(TrainedMap, given["action_map"], f"action_map of {name}"), env.action_map
    if action_map.names != here.names:
        raise UsageError(
            f"The policy {name!r} moves {listing(action_map.names, limit=3)} (task {str(given.get('task'))[:80]!r}), "
            f"and the task {env.task.name!r} moves {listing(here.names, limit=3)}: take the task of its training."
        )
    sides = (("are counted from", action_map.default, here.default), ("move by", action_map.scale, here.scale))
    for what, theirs, ours in sides:
        for joint, trained, now in zip(action_map.names, theirs, ours, strict=True):
            if abs(trained - now) > _SAME_ANGLE:
                raise UsageError(
                    f"Actions of the policy {name!r} {what} {joint} = {trained:g} rad, and here {now:g} rad: take the "
                    "task, the hand and the configuration (--config) in which it was trained."
                )
    rate = given.get("rate", _RATE)
    if not (isinstance(rate, int | float) and math.isclose(rate * env.step_dt, 1, rel_tol=1e-6)):
        raise UsageError(
            f"The policy {name!r} was trained with {brief(rate)} actions per second, and here are {1 / env.step_dt:g}: "
            "take the solver.timestep and solver.decimation of the task in which it was trained."
        )


def check_hand(described: Mapping[str, Any], env: Env, name: str) -> None:
    """Warn where the file of the hand of a policy is no longer what it was in training; earlier runs do not tell."""
    if (trained := described.get("hand_physics")) and trained != env.hand.physics:
        _LOG.warning(
            "The file of the hand %s has changed since the policy %r was trained: masses, drives, frictions or places "
            "differ. Bring back that file, or train again.", env.hand.name, name,
        )  # fmt: skip


def check_fit(described: Mapping[str, Any], env: Env, name: str) -> None:
    """Check what the ``config.json`` of a teacher or student says against an environment.

    What else differs from the world of training is told as a warning: how a policy bears it is a question one may ask.
    So are a hand whose file was changed, and a student that reads the goal, as published ones do.
    """
    check_version(described, name)
    student = described.get("distill")
    hand = str(described.get("hand") or (student.get("hand", "") if isinstance(student, dict) else ""))
    if hand and hand != env.hand.name and Path(hand).stem != Path(env.hand.source).stem:
        raise UsageError(
            f"The policy {name!r} was trained for the hand {hand[:80]!r}; received {env.hand.name!r}: make the "
            "environment with that hand."
        )
    check_hand(described, env, name)
    check_actions(described, env, name)
    # Encoders that look up taxels by their number would read other taxels.
    groups = described.get("groups", ())
    for group, shape in groups:
        if (here := env.observation_shapes.get(group)) != tuple(shape):
            raise UsageError(
                f"The policy {name!r} reads {group} {shape}, and the environment gives "
                f"{'none' if here is None else list(here)}: make it with the touch and the task of its training."
            )
    if unmeasured := [group for group, _ in groups if group not in MEASURED]:
        _LOG.warning("The student %r reads %s, which only the simulation knows.", name, ", ".join(unmeasured))
    world = from_json(dict, described.get("world", {}), f"world of {name}")
    trained = {**world, "contacts": contacts_name(trained_contacts(described))}
    here = {**(world_of(env.task) if world else {}), "contacts": contacts_name(env.task.contacts)}
    if changes := [*differences(trained, here)]:
        _LOG.warning(
            "The policy %r acts in another world than that of its training: %s. Take the --config and --change of its "
            "training, or read the result as one of this world.", name, listing(changes, limit=3, quoted=False),
        )  # fmt: skip
