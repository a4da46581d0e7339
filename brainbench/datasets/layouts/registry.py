"""The registry of recording layouts: named ways to read a data set.

Other packages add theirs through the entry point group ``brainbench.recordings``: an entry point names a
:class:`~brainbench.datasets.RecordingLayout`, or a module whose import runs :func:`register_layout`.
"""

from __future__ import annotations

from typing import Any

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.plugins import load_entry_points, load_module
from brainbench.datasets.layouts.layout import RecordingLayout
from brainbench.datasets.sessions import Session

ENTRY_POINTS = "brainbench.recordings"

_LAYOUTS: dict[str, RecordingLayout] = {}
_loaded: list[str] = []
"""Groups of entry points that were loaded: once, on first use."""


def register_layout(layout: RecordingLayout) -> RecordingLayout:
    """Make a layout known by its name and its columns for the rest of this process; returns it.

    On the command line ``FILE.py:PATH`` registers the ``LAYOUT`` that a file defines.

    Raises:
        UsageError: another layout has this name, or it could not be told from a path.
    """
    if not is_name(layout.name):
        raise UsageError(
            f"A layout's name is a word of at least two letters, digits, '-' or '_', beginning with a letter; "
            f"received {layout.name!r}."
        )
    known = _LAYOUTS.setdefault(layout.name, layout)
    if known != layout:
        raise UsageError(f"There is already a recording layout {layout.name!r} ({known.title}); choose another name.")
    return layout


def get_layout(name: str) -> RecordingLayout:
    """Return a layout by name.

    Raises:
        UsageError: there is no such layout (the nearest is named).
    """
    if name not in _known():
        raise unknown_name("recording layout", name, _LAYOUTS)
    return _LAYOUTS[name]


def list_layouts() -> list[str]:
    """Return the names of the layouts."""
    return sorted(_known())


def detect_layout(session: Session) -> RecordingLayout | None:
    """Return the layout that a session has, if any; of several the most specific one."""
    found = [layout for layout in _known().values() if layout.matches(session)]
    return max(found, key=lambda layout: len(layout.columns), default=None)


def load_layout(path: str) -> RecordingLayout:
    """Run a Python file and register the layout that it calls ``LAYOUT`` (or ``RECIPE``).

    Raises:
        DataFileNotFoundError: there is no such file.
        DataError: it fails.
        UsageError: it defines no layout.
    """
    module = load_module(path)
    found = getattr(module, "LAYOUT", getattr(module, "RECIPE", None))
    if not isinstance(found, RecordingLayout):
        raise UsageError(
            f"The file {path!r} defines no LAYOUT = brainbench.datasets.RecordingLayout(…); "
            f"docs/recordings.md shows one."
        )
    return register_layout(found)


def is_name(word: str) -> bool:
    """Return whether a word could be a layout's name; a drive letter could not."""
    return len(word) >= 2 and word.replace("-", "_").isidentifier()


def _known() -> dict[str, RecordingLayout]:
    """Return the registry with the layouts of other packages."""
    if ENTRY_POINTS not in _loaded:
        _loaded.append(ENTRY_POINTS)
        load_entry_points(ENTRY_POINTS, _take)
    return _LAYOUTS


def _take(_: str, found: Any) -> None:
    if isinstance(found, RecordingLayout):
        register_layout(found)
