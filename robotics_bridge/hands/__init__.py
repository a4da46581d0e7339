"""Robot hands: two of our own made of primitives, any URDF or MJCF file, and where their probes sit.

``files`` reads the file of a hand, ``hand`` makes it ready for use, ``layouts`` and ``tree`` place probes on its links,
``observations`` turns their readings into what a policy gets, and ``scenes`` lays an object on the palm. Our own hands
are MJCF files (``sharpa.xml``, ``xhand1.xml``), each with its palm, fingers, pads and speeds beside it (``.toml``).
"""

from __future__ import annotations

import os
from pathlib import Path

from brainbench.core.errors import unknown_name
from brainbench.core.lazy import lazy_exports
from brainbench.core.reading.texts import read_toml
from robotics_bridge.hands.hand import Hand, all_from_file, from_file
from robotics_bridge.hands.layouts import Pad

__all__ = ["Hand", "list_hands", "load", "load_all"]

_OWN = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.toml"))}


def list_hands() -> tuple[str, ...]:
    """Return the names of the hands that come with the package."""
    return tuple(_OWN)


def load(name_or_path: str | os.PathLike[str], *, palm: str | None = None) -> Hand:
    """Return a hand of ours by name (:func:`list_hands`), or that of a URDF or MJCF file.

    Of several hands in a file it is that with the link ``palm``, or the first, with a warning.
    """
    name = os.fspath(name_or_path)
    if name in _OWN:
        data = read_toml(_OWN[name])
        fingers = {finger: tuple(chain) for finger, chain in data["fingers"].items()}
        pads = {link: Pad(**pad) for link, pad in data["pads"].items()}
        return Hand(name, data["palm"], fingers, _OWN[name].with_suffix(".xml"), pads, data["speeds"])
    return from_file(_hand_file(name), palm)


def load_all(path: str | os.PathLike[str]) -> tuple[Hand, ...]:
    """Return every hand of a URDF or MJCF file, that with most fingers first; all share the file's model."""
    return all_from_file(_hand_file(os.fspath(path)))


def _hand_file(name: str) -> Path:
    if Path(name).suffix.lower() in (".urdf", ".xml", ".mjcf"):
        return Path(name)
    raise unknown_name("hand", name, _OWN, hint="Or give the path of a URDF or MJCF file.")


__getattr__, __dir__ = lazy_exports(__name__)
