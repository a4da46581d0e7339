"""Whether a stored policy fits an environment: made for these tasks, for this hand, for these contacts."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, UsageError, brief, listing
from robotics_bridge.policies.contract import TrainedMap, from_json, trained_contacts
from robotics_bridge.policies.shipped import stored
from robotics_bridge.tasks.settings import contacts_name
from robotics_bridge.tasks.task import MEASURED, TASK_VERSION, Task

if TYPE_CHECKING:
    from robotics_bridge.envs.env import Env

_LOG = logging.getLogger(__name__)
_RATE = 40.0  # control steps per second of teachers that do not state it
_SAME_ANGLE = 1e-4  # difference of two positions that is rounding [rad]


def with_contacts_of(task: Task, policies: Iterable[str]) -> Task:
    """Return a task with the contacts in which some policies were trained; unchanged without any.

    A policy is a shipped one or the folder of a run; ``zero`` and ``random`` were trained in none.
    """
    contacts = {name: trained_contacts(described) for name in policies if (described := stored(name))}
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
        for joint, trained, now in zip(action_map.names, theirs, ours.tolist(), strict=True):
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

    Other contacts than those of training are told as a warning: how a policy bears them is a question one may ask. So
    are a hand whose file was changed, and a student that reads the goal, as published ones do.
    """
    check_version(described, name)
    student = described.get("distill")
    hand = str(described.get("hand") or (student.get("hand", "") if isinstance(student, dict) else ""))
    if hand and hand != env.hand.name and Path(hand).stem != Path(str(env.hand.path or env.hand.name)).stem:
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
    if (contacts := trained_contacts(described)) != env.task.contacts:
        _LOG.warning(
            "The policy %r was trained with contacts %s; these are %s.", name, contacts_name(contacts),
            contacts_name(env.task.contacts),
        )  # fmt: skip
