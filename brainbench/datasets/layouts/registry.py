"""Recording layouts, named ways to read a data set, and their registry.

Other packages add theirs through the entry point group ``brainbench.recordings``: an entry point names a
:class:`~brainbench.datasets.RecordingLayout`, or a module whose import runs :func:`register_layout`.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.contracts import as_labels
from brainbench.core.errors import (
    DataError,
    MissingDependencyError,
    UsageError,
    check_name,
    install_command,
)
from brainbench.core.plugins import load_entry_points, load_module
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.selection import DEFAULT, FIRST_CONTACT, Conditions, Selection, Window

if TYPE_CHECKING:
    import xarray as xr

ENTRY_POINTS = "brainbench.recordings"


@dataclass(frozen=True)
class RecordingLayout:
    """The way one published data set is read; an argument of ``open_recordings`` overrides any part."""

    name: str
    title: str
    citation: str
    conditions: Conditions
    orders: Mapping[str, tuple[str, ...]]
    """Column → its values in fixed order; other values are not part of the experiment."""
    selection: Selection
    window: Window
    columns: tuple[str, ...]
    """Columns of the condition table by which a file of this data set is recognised; empty: never, the
    layout has to be named."""
    remarks: tuple[str, ...] = ()
    adapt: Callable[[Session], Session] | None = None
    """Turns the file's own layout into units and interval tables; must leave alone what is already
    adapted (an export keeps what it made)."""
    touch: str = FIRST_CONTACT
    """Event that neurons answer within 5 to 30 ms, an anchor of :class:`Window`: it tells whether
    spikes and behaviour share a clock."""
    dandiset: str = ""
    """Number on the DANDI archive."""
    assets: str = ""
    """Glob of the archive's files that hold units; all of them if empty."""
    stimuli: str = ""
    """Recipe of the stimuli that the animals felt, if there is one."""
    synthetic: bool = False
    """Layout of files that a program made; no others are recognised by it."""
    endings: tuple[str, ...] = ()
    """Endings of files whose responses are counted already, in lower case; ``open_counted`` reads them."""
    open_counted: Callable[..., xr.Dataset] | None = None
    """Returns the recordings of such a file; takes the options of ``open_recordings``, which it may refuse."""
    check_counted: Callable[[Path, list[str]], Iterator[Any]] | None = None
    """Yields each Finding about such a file, and adds the names of its sessions to the list."""

    def matches(self, session: Session) -> bool:
        """Return whether a session's condition table has the columns of this data set."""
        table = session.tables.get(self.conditions.table)
        complete = table is not None and not table.fault and all(column in table for column in self.columns)
        return bool(self.columns) and complete and (session.synthetic or not self.synthetic)

    def adapted(self, session: Session) -> Session:
        """Return the session with the units and tables that this data set stores in its own way."""
        with_stimuli = session if session.stimuli else replace(session, stimuli=self.stimuli)
        return with_stimuli if self.adapt is None else self.adapt(with_stimuli)

    def vocabulary(self, conditions: Conditions) -> tuple[str, ...] | None:
        """Return the fixed labels, or None if a column's values are not declared here."""
        if conditions.table != self.conditions.table or any(name not in self.orders for name in conditions.columns):
            return None
        orders = (as_labels(np.array(self.orders[name], dtype=str)).tolist() for name in conditions.columns)
        return tuple("-".join(values) for values in product(*orders))

    def describe(self) -> str:
        """Return every rule of the layout, one per line."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{self.name}: {self.title}"
        yield f"citation: {self.citation}"
        yield f"conditions: {self.conditions}"
        vocabulary = self.vocabulary(self.conditions)
        yield f"vocabulary: {', '.join(vocabulary) if vocabulary else 'the values found, sorted naturally'}"
        yield f"window: {self.window}"
        if self.window.fallback is not None:
            yield f"window of sessions without contact tables: {self.window.fallback}"
        yield from self.selection.lines()
        yield from self.remarks


_LAYOUTS: dict[str, RecordingLayout] = {}
_loaded: list[str] = []  # groups of entry points that were loaded: once, on first use


def register_layout(layout: RecordingLayout) -> RecordingLayout:
    """Make a layout known by its name and its columns for the rest of this process; returns it.

    On the command line ``FILE.py:PATH`` registers the ``LAYOUT`` that a file defines.
    """
    if not is_name(layout.name):
        raise UsageError(
            f"A layout's name is a word of at least two letters, digits, '-' or '_', beginning with a letter; "
            f"received {layout.name!r}."
        )
    registered = _LAYOUTS.setdefault(layout.name, layout)
    if registered != layout:
        raise UsageError(
            f"There is already a recording layout {layout.name!r} ({registered.title}); choose another name."
        )
    return layout


def get_layout(name: str) -> RecordingLayout:
    """Return a layout by name."""
    check_name("recording layout", name, _known())
    return _LAYOUTS[name]


def list_layouts() -> list[str]:
    """Return the names of the layouts."""
    return sorted(_known())


def counted_layout(path: Path, layout: RecordingLayout | None = None) -> RecordingLayout | None:
    """Return the layout that opens a file of counted responses: the one that was named, or the one of its ending."""
    if layout is not None:
        return layout if layout.open_counted else None
    ending = path.suffix.lower()
    return next((candidate for candidate in _known().values() if ending in candidate.endings), None)


def detect_layout(session: Session) -> RecordingLayout | None:
    """Return the layout that a session has, if any; of several the most specific one."""
    matching = [layout for layout in _known().values() if layout.matches(session)]
    return max(matching, key=lambda layout: len(layout.columns), default=None)


def load_layout(path: str) -> RecordingLayout:
    """Run a Python file and register the layout that it calls ``LAYOUT`` (or ``RECIPE``)."""
    module = load_module(path)
    candidate = getattr(module, "LAYOUT", getattr(module, "RECIPE", None))
    if not isinstance(candidate, RecordingLayout):
        raise UsageError(
            f"The file {path!r} defines no LAYOUT = brainbench.datasets.RecordingLayout(…); "
            f"docs/recordings.md shows one."
        )
    return register_layout(candidate)


def is_name(word: str) -> bool:
    """Return whether a word could be a layout's name; a drive letter could not."""
    return len(word) >= 2 and word.replace("-", "_").isidentifier()


def _known() -> dict[str, RecordingLayout]:
    """Return the registry with the layouts of other packages."""
    if ENTRY_POINTS not in _loaded:
        _loaded.append(ENTRY_POINTS)
        load_entry_points(ENTRY_POINTS, _take)
    return _LAYOUTS


def _take(_: str, candidate: Any) -> None:
    if isinstance(candidate, RecordingLayout):
        register_layout(candidate)


SYNTHETIC = RecordingLayout(
    name="synthetic",
    title="animals drawn by brainbench.datasets.synthetic; no animal was recorded",
    citation="brainbench, this version",
    conditions=Conditions("trials", ("stimulus",)),
    orders={},
    selection=DEFAULT,
    window=Window(FIRST_CONTACT, stop="choice"),
    columns=("stimulus", "choice_time"),
    synthetic=True,
    remarks=("truth: truth.json beside the files says what the neurons encode",),
)


def fetch(name: str, folder: str | os.PathLike[str] = ".", *, assets: str | None = None) -> Path:
    """Download a data set of the DANDI archive (https://dandiarchive.org); return its folder, ``folder/NUMBER``.

    What is there already is kept if unchanged, so an interrupted download goes on.

    Args:
        name: a layout's name, or the six digits of a dandiset.
        folder: where to put it.
        assets: glob of the files wanted, such as ``"sub-231CR/*"``; by default those that the layout can use, else all.
    """
    number, pattern = _dandiset(name)
    client = shutil.which("dandi")
    if client is None:
        raise MissingDependencyError(
            "Downloading from the DANDI archive needs its client, which is not installed: "
            f"{install_command('dandi')}; or get DANDI:{number} elsewhere: every other command works on files, "
            "without a network."
        )
    pattern = assets or pattern
    source = f"dandi://dandi/{number}/{pattern}" if pattern else f"DANDI:{number}"
    target = Path(folder)
    # Keeping the tree keeps two animals' files of the same name apart.
    command = [client, "download", "--output-dir", str(target), "--existing", "refresh", "--preserve-tree"]
    command += ["--path-type", "glob"] if pattern else []
    target.mkdir(parents=True, exist_ok=True)
    status = subprocess.run([*command, source], check=False).returncode
    if status:
        raise DataError(f"The dandi client ended with status {status} while fetching {source}; its messages say why.")
    return target / number


def _dandiset(name: str) -> tuple[str, str]:
    if match := re.fullmatch(r"(?:DANDI:)?(\d{6})", name, re.IGNORECASE):
        layouts = [get_layout(item) for item in list_layouts()]
        return match[1], next((item.assets for item in layouts if item.dandiset == match[1]), "")
    public = [item for item in list_layouts() if get_layout(item).dandiset]
    check_name("data set", name, public, hint="Or give the six digits of a dandiset, such as 000231.")
    layout = get_layout(name)
    return layout.dandiset, layout.assets
