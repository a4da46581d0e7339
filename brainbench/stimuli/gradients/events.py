"""Changes of contact in a run, and whether its derivatives hold on both sides of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Nearness = Literal["ending", "beginning", "passing", "slipping", "sticking"]
SMALL_FORCE = 1e-5
"""Share of the whisker's largest contact force below which a contact is about to end or has just begun."""
SMALL_GAP = 1e-5
"""Gap (mm) at the end of a step up to which an open contact is about to close."""
SMALL_LEAD = 1e-6
"""Gap (mm) by which one link is nearer than the next up to which a contact is about to pass from one to the other."""
FULL_CONE = 1 - 1e-5
"""Share of the friction cone from which sticking is close to sliding."""
SMALL_SLIP = 1e-5
"""Share of the whisker's fastest slip below which sliding is close to sticking."""


@dataclass(frozen=True)
class ContactEvents:
    """Changes of contact of one whisker in its run."""

    status: Literal["smooth", "one-sided", "degenerate", "unstable"]
    """``smooth``: the gradient holds on both sides. ``one-sided``: in some step a contact was so near to opening,
    closing, passing from link to link, sticking or sliding (``close``) that the gradient on the other side is another.
    ``degenerate``: in some step contacts shared their load in more than one way, or their forces could not be solved to
    rounding. ``unstable``: the simulation cannot be trusted, and the gradient is NaN."""
    begun: int
    """Steps in which more contacts pressed than before."""
    ended: int
    """Steps in which fewer did."""
    slipped: int
    """Steps in which as many pressed and more, or fewer, of them slid."""
    close: tuple[Nearness, ...]
    """What some contact was close to in some step."""


def contact_events(summary: Any, reason: str) -> ContactEvents:
    """Return the events of one job from its ``fitting.derivatives.kernels.contacts.ContactSummary``.

    ``reason`` is why the run cannot be trusted, if so.
    """
    close: list[Nearness] = []
    if summary["least_force"] < SMALL_FORCE * summary["largest_force"]:
        close.append("ending")
    if summary["least_gap"] < SMALL_GAP:
        close.append("beginning")
    if summary["least_lead"] < SMALL_LEAD:
        close.append("passing")
    if summary["fullest_cone"] > FULL_CONE:
        close.append("slipping")
    if summary["slowest_slip"] < SMALL_SLIP * summary["fastest_slip"]:
        close.append("sticking")
    status: Literal["smooth", "one-sided", "degenerate", "unstable"] = "one-sided" if close else "smooth"
    if summary["degenerate"]:
        status = "degenerate"
    if reason:
        status = "unstable"
    begun = int(summary["begun"]) + int(summary["first"] > 0)
    return ContactEvents(status, begun, int(summary["ended"]), int(summary["slipped"]), tuple(close))
