"""Robot hands: two of our own made of primitives, any URDF or MJCF file, and where their probes sit."""

from __future__ import annotations

import os
from pathlib import Path

from brainbench.core.errors import unknown_name
from robotics_bridge.hands.hand import Hand, from_file
from robotics_bridge.hands.layouts import PLACEMENTS, RESOLUTIONS, active_count, read_probes, write_probes

__all__ = [
    "PLACEMENTS", "RESOLUTIONS", "Hand", "active_count", "list_hands", "load", "read_probes", "write_probes",
]  # fmt: skip


def list_hands() -> tuple[str, ...]:
    """Return the names of the hands that come with the package."""
    return ("sharpa", "xhand1")


def load(name_or_path: str | os.PathLike[str]) -> Hand:
    """Return a hand of ours by name (:func:`list_hands`), or that of a URDF or MJCF file.

    Raises:
        UsageError: there is no hand of this name.
        DataError: the file is missing or holds no hand.
    """
    from robotics_bridge.hands.sharpa import sharpa
    from robotics_bridge.hands.xhand1 import xhand1

    own = {"sharpa": sharpa, "xhand1": xhand1}
    name = os.fspath(name_or_path)
    if name in own:
        spec = own[name]()
        return Hand(spec.name, spec.palm, spec.fingers, spec=spec)
    if Path(name).suffix.lower() in (".urdf", ".xml", ".mjcf"):
        return from_file(Path(name))
    raise unknown_name("hand", name, own, hint="Or give the path of a URDF or MJCF file.")
