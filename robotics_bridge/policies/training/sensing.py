"""Policies that train without a teacher on what a hand has: their observations, and what they are as students."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, cast

from brainbench.core.errors import UsageError, check_name
from robotics_bridge.policies.student import TACTILE
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.settings import CONTACTS, TeacherSettings, contacts_name
from robotics_bridge.tasks.task import GROUPS, check_measured

if TYPE_CHECKING:
    from robotics_bridge.envs.env import Env

SENSES = {
    "proprio": "proprio", "touch": TACTILE, "command": "command", "link_pose": "link_pose", "thermal": "thermal"
}  # fmt: skip
"""Name of an observation → its group."""


def sensed_groups(observe: Iterable[str]) -> tuple[str, ...]:
    """Return the groups of observations of :data:`SENSES`; UsageError for another, or one that is privileged."""
    groups = []
    for name in observe:
        if name in GROUPS and name != TACTILE:
            check_measured((name,), "A policy without a teacher")
        check_name("observation", name, SENSES)
        groups.append(SENSES[name])
    return tuple(groups)


def sensing_policy(
    env: Env, settings: TeacherSettings, seed: int, observe: tuple[str, ...], encoder: str
) -> DistillConfig:
    """Return what a policy that reads some observations is as a student: its touch and network, and its memory."""
    for name in sensed_groups(observe):
        if name not in env.observation_shapes:
            given = "make the environment with an observation type" if name == TACTILE else "leave it out"
            raise UsageError(f"Task {env.task.name!r} gives no {name!r} here: {given}.")
    o, contacts = env.options, contacts_name(env.task.contacts)
    senses: dict[str, Any] = {"observe": "none"}
    if "touch" in observe:
        senses = {name: getattr(o, name) for name in ("observe", "placement", "resolution", "noisy")} | {
            "encoder": encoder
        }
    return DistillConfig(
        task=env.task.name, hand=str(env.hand.path or env.hand.name), embedder="lstm", hidden=settings.hidden,
        num_envs=env.num_envs, seed=seed, contacts=cast(Any, contacts if contacts in CONTACTS else None), **senses,
    )  # fmt: skip
