"""Whether a stored policy fits an environment: made for these tasks, for this hand, for these contacts."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, UsageError
from robotics_bridge.policies.shipped import unmeasured_inputs
from robotics_bridge.tasks.contact_model import CONTACTS, ContactModel
from robotics_bridge.tasks.task import TASK_VERSION

if TYPE_CHECKING:
    from robotics_bridge.envs.env import Env

_LOG = logging.getLogger(__name__)


def check_fit(described: Mapping[str, Any], env: Env, name: str) -> None:
    """Check what the ``config.json`` of a teacher or student says against an environment.

    Other contacts than those of training are told as a warning: how a policy bears them is a question one may ask.

    Raises:
        DataError: the policy is of another version of the tasks.
        UsageError: it was trained for another hand.
    """
    # Runs of versions that did not state it are of version 1, and had the published contacts.
    version = described.get("task_version", 1)
    if version != TASK_VERSION:
        made = described.get("provenance")
        made = f" (brainbench {made.get('version')} made it)" if isinstance(made, dict) else ""
        raise DataError(
            f"The policy {name!r} is of version {str(version)[:20]} of the tasks, and this package has version "
            f"{TASK_VERSION}: train it again, or use the package of that version{made}."
        )
    student = described.get("distill")
    hand = str(described.get("hand") or (student.get("hand", "") if isinstance(student, dict) else ""))
    if hand and hand != env.hand.name and Path(hand).stem != Path(str(env.hand.path or env.hand.name)).stem:
        raise UsageError(
            f"The policy {name!r} was trained for the hand {hand[:80]!r}; received {env.hand.name!r}: make the "
            "environment with that hand."
        )
    if unmeasured := unmeasured_inputs(described):
        _LOG.warning(
            "The student %r reads %s, which only the simulation knows: on a hand it does worse.", name,
            ", ".join(unmeasured),
        )  # fmt: skip
    plain = asdict(ContactModel()) | (described.get("contacts") or {})
    own = {key: tuple(value) if isinstance(value, list) else value for key, value in plain.items()}
    if own != asdict(env.task.contacts):
        names = {model: word for word, model in CONTACTS.items()}
        _LOG.warning(
            "The policy %r was trained with contacts %s; these are %s.", name,
            next((word for word, model in CONTACTS.items() if asdict(model) == own), "of its own"),
            names.get(env.task.contacts, "of their own"),
        )  # fmt: skip
