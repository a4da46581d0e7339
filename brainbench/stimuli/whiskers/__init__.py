"""Whiskers: a tapered curved rod (``whisker``), arrays of them on the face of a mouse or rat (``array``), the naming of
some of them (``selection``), and the chain of links that engines simulate in place of a rod (``chain``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.whiskers.array import MountedWhisker, WhiskerArray
    from brainbench.stimuli.whiskers.chain import Chain, build_chain
    from brainbench.stimuli.whiskers.selection import match_whiskers
    from brainbench.stimuli.whiskers.whisker import Whisker

__all__ = ["Chain", "MountedWhisker", "Whisker", "WhiskerArray", "build_chain", "match_whiskers"]

_MODULES = {
    ".array": ("MountedWhisker", "WhiskerArray"),
    ".chain": ("Chain", "build_chain"),
    ".selection": ("match_whiskers",),
    ".whisker": ("Whisker",),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
