"""Open recordings: files → sessions → one data set of counted trials.

The result (contract: :func:`brainbench.core.contracts.check_recordings`) depends on the content of the files
only: trials are sorted by subject, session, start time and id, units by subject, session and id.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.contracts import check_recordings
from brainbench.core.errors import DataError, UsageError, listing, unknown_name
from brainbench.datasets import hdf5
from brainbench.datasets.layouts.registry import RecordingLayout, list_recipes, resolve_selection
from brainbench.datasets.reading import Source, each_session, find_recordings
from brainbench.datasets.sessions import Session
from brainbench.datasets.sources import open_file
from brainbench.datasets.trials.conditions import Conditions
from brainbench.datasets.trials.counting import ReadingOptions, SessionCounts, extract, has_units, no_units
from brainbench.datasets.trials.joining import join
from brainbench.datasets.trials.proposals import propose
from brainbench.datasets.trials.selection import DEFAULT, Selection
from brainbench.datasets.trials.windows import WHOLE, Window, resolve_window

if TYPE_CHECKING:
    import xarray as xr


def open_recordings(
    source: Source,
    *,
    conditions: str | Conditions | None = None,
    select: Selection | str | None = None,
    window: Window | str | None = None,
    bin: float | None = None,
) -> xr.Dataset:
    """Read recordings into counted trials.

    Args:
        source: a file (NWB 2.x or our HDF5 layout), a folder, a glob, a list of these, or
            ``RECIPE:PATH`` to read them by a named recipe. Every file is a session.
        conditions: ``TABLE:COLUMN[,COLUMN]``: the interval table whose rows are trials and the columns
            whose values, joined with "-", label them.
        select: a :class:`Selection`, a name ("none", "default", "rodgers") or rules in text. By default
            the recipe's, else all trials and every unit with a spike.
        window: a :class:`Window` or text such as "first-contact..choice" or "start+0.2..+0.5". By
            default the recipe's, else start..stop.
        bin: bin width, s; None counts each window as one bin.

    A recipe is used when it is named, or when every file has its layout and ``conditions`` are left out
    or use its table; an argument replaces the recipe's part. Labels follow the recipe's fixed
    vocabulary, else they are sorted naturally; never by appearance.

    Returns:
        ``counts`` [trial, time, unit] (float32; NaN = not recorded) and ``duration`` [trial, time] (s),
        with ``stimulus, subject, session, trial_id, window_start, window_stop`` per trial,
        ``unit_subject, unit_session, unit_id, depth, layer, inhibitory`` per unit, ``time`` (begin of
        the bin, s from the window's begin), and attributes: vocabulary, conditions, recipe, window,
        bin, selection, removed (rule → trials or units that it removed, each counted once, in the
        order of the rules), missing (subject → labels without a trial), sessions, notes, source,
        synthetic, content_hash.

    Raises:
        DataFileNotFoundError: the source names nothing.
        UsageError: an unknown table, column, recipe or rule, or no conditions where they are needed.
        DataError: a file is damaged or unusable, a session appears twice, or fewer than two
            conditions, no trial or no unit remain.
    """
    recipe, paths = find_recordings(source)
    wanted = Conditions.parse(conditions) if isinstance(conditions, str) else conditions
    if len(paths) == 1 and (ready := _already_counted(paths[0], (wanted, select, window, bin, recipe))) is not None:
        return ready
    reader = _Reader(recipe, wanted, select, window, bin)
    for path in paths:
        reader.read(path)
    return reader.dataset(", ".join(map(str, paths)) if len(paths) < 4 else f"{len(paths)} files, {paths[0]} …")


class _Reader:
    """Collects the parts of all sessions; makes sure they are read alike and none comes twice."""

    def __init__(
        self,
        recipe: RecordingLayout | None,
        conditions: Conditions | None,
        select: Selection | str | None,
        window: Window | str | None,
        bin: float | None,
    ) -> None:
        self.recipe, self.named = recipe, recipe is not None
        self.conditions = conditions
        self.select = None if select is None else resolve_selection(select)
        self.window = None if window is None else resolve_window(window)
        self.bin = bin
        self.plan: ReadingOptions | None = None
        self.parts: list[SessionCounts] = []
        self.seen: dict[tuple[str, ...], str] = {}
        self.notes: list[str] = []
        self.skipped: list[str] = []
        self.other_subjects: list[str] = []

    def read(self, path: Path) -> None:
        """Read the sessions of one file."""
        with open_file(path) as file:
            for session, found in each_session(file, path, self.recipe if self.named else None):
                if not has_units(session):
                    self.skipped.append(no_units(session))
                    continue
                self._once(session)
                plan = self._plan(session, found)
                if plan.selection.subjects and session.subject not in plan.selection.subjects:
                    self.other_subjects.append(session.subject)
                    continue
                self.notes += session.notes
                self.parts.append(extract(session, plan))

    def _once(self, session: Session) -> None:
        keys = [("subject and session", session.subject, session.session)]
        keys += [("identifier", session.identifier)] if session.identifier else []
        for key in keys:
            if key in self.seen:
                raise DataError(
                    f"{self.seen[key]} and {session.source} are the same session (equal {key[0]}: "
                    f"{' / '.join(key[1:])}); its trials would count twice, so leave one of the files out."
                )
            self.seen[key] = session.source

    def _plan(self, session: Session, found: RecordingLayout | None) -> ReadingOptions:
        """Return the plan, made for the first session and checked against each later one."""
        if (
            not self.named
            and found is not None
            and self.conditions is not None
            and (self.conditions.table != found.conditions.table)
        ):
            found = None
        if self.plan is None:
            self.recipe = self.recipe if self.named else found
            self.plan = self._make_plan(session)
        elif not self.named and found is not self.recipe:
            # Going on with the first file's recipe would make the result depend on the order of files.
            raise UsageError(
                f"{session.source} has another layout than {next(iter(self.seen.values()))}; open them apart, or name "
                f"the recipe for both: {listing(f'{name}:PATH' for name in list_recipes())}."
            )
        return self.plan

    def _make_plan(self, session: Session) -> ReadingOptions:
        conditions = self.conditions or (self.recipe.conditions if self.recipe else None)
        if conditions is None:
            proposals = [item.conditions for item in propose([session])][:4]
            if not proposals:
                raise DataError(
                    f"{session.source} has no interval table with a column that could label trials (2 to 60 values, "
                    f"each at least twice; tables: {listing(session.tables)}); there is nothing to compare."
                )
            raise UsageError(
                f"{session.source} does not say which column holds the conditions; pass conditions TABLE:COLUMN, such "
                f"as {listing(proposals)}."
            )
        recipe = self.recipe
        return ReadingOptions(
            conditions=conditions,
            vocabulary=recipe.vocabulary(conditions) if recipe else None,
            selection=self.select or (recipe.selection if recipe else DEFAULT),
            window=self.window or (recipe.window if recipe else WHOLE),
            bin=self.bin,
        )

    def dataset(self, source: str) -> xr.Dataset:
        """Join all parts; see :func:`open_recordings`."""
        if self.plan is None:
            raise DataError(_first_and_count(self.skipped))
        if not self.parts:
            raise unknown_name("subject", self.plan.selection.subjects[0], sorted(set(self.other_subjects)))
        notes = self.notes + self.skipped
        return check_recordings(join(self.parts, self.plan, source=source, recipe=self._recipe_name(), notes=notes))

    def _recipe_name(self) -> str:
        if self.recipe is None:
            return ""
        return self.recipe.name if self.named else f"{self.recipe.name} (detected from the layout)"


def _already_counted(path: Path, options: Iterable[Any]) -> xr.Dataset | None:
    with open_file(path) as file:
        if not hdf5.is_ours(file) or hdf5.read_kind(file, path) != "counts":
            return None
        if any(option is not None for option in options):
            raise UsageError(
                f"{path} holds responses that are already counted, so conditions, select, window, bin and recipes "
                f"cannot apply; leave them out, or open the original spike times."
            )
        return hdf5.read_counts(file, path)


def _first_and_count(reasons: list[str]) -> str:
    more = f" ({len(reasons) - 1} more files likewise)" if len(reasons) > 1 else ""
    return f"{reasons[0]}{more}" if reasons else "The file holds no session."
