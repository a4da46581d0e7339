"""Firmness of contacts, and strength of the drives that press on them. SI units, radians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_fields


@dataclass(frozen=True, kw_only=True)
class ContactModel:
    """Compliance of all contacts (MuJoCo's ``solref`` and ``solimp``), physics steps, and the scale of the drives."""

    time_constant: float = 0.02
    """Time in which the solver takes overlap away [s]; the published engine's default."""
    damping_ratio: float = 1.0
    """Damping of that approach; 1 is critical."""
    impedance: tuple[float, float, float] = (0.9, 0.95, 0.001)
    """Share of the constraint that is enforced at no overlap and at a full one, and the depth of a full one [m]."""
    substeps: int = 1
    """Physics steps within the solver's ``timestep``; drives and sensors keep the rate of that."""
    drive_scale: float = 1.0
    """Factor on stiffness, damping, effort and armature of the hand's drives. Free motion depends on their ratios
    alone, so it stays the same; the force of a blocked finger and the blow of a fast one become smaller."""

    def __post_init__(self) -> None:
        check_fields(self, "time_constant", "damping_ratio", "drive_scale", above=0, of="contacts.{}")
        check_fields(self, "substeps", least=1, most=100, whole=True, of="contacts.{}")
        low, high, width = self.impedance
        if not (0 < low <= high < 1 and width > 0):
            raise UsageError(
                "contacts.impedance is two shares between 0 and 1 in order, and a depth above 0 (m); received "
                f"{self.impedance}."
            )


CONTACTS = {
    "published": ContactModel(),
    "firm": ContactModel(time_constant=0.006, substeps=2, drive_scale=0.08),
}
"""Named contact models. Under ``published`` a block lies millimetres inside the fingers that press it with the released
efforts; ``firm``, on which we train, keeps 95 % of the contacts below 1 mm and of the forces below 20 N
(docs/tasks.md)."""


def contacts_name(contacts: ContactModel) -> str:
    """Return the name of a contact model, ``its own`` for one without."""
    return next((name for name, model in CONTACTS.items() if model == contacts), "its own")


def set_contacts(model: Any, contacts: ContactModel) -> None:
    """Give all geometries of a ``mujoco.MjModel`` this compliance; MuJoCo's sigmoid keeps its middle and power."""
    model.geom_solref[:] = contacts.time_constant, contacts.damping_ratio
    model.geom_solimp[:, :3] = contacts.impedance
