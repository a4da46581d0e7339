"""Open recordings: files → sessions → one data set of counted trials.

The result (contract: :func:`brainbench.types.check_recordings`) depends on the content of the files
only: trials are sorted by subject, session, start time and id, units by subject, session and id.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.datasets import hdf5
from brainbench.datasets._extract import UNIT_COLUMNS, Part, Plan, extract, has_units, no_units
from brainbench.datasets.conditions import Conditions, natural_vocabulary
from brainbench.datasets.recipes import Recipe, detect_recipe, get_recipe, resolve_selection, split_source
from brainbench.datasets.selection import DEFAULT, Selection
from brainbench.datasets.sessions import Session, natural_key
from brainbench.datasets.sources import find_files, open_file, read_file
from brainbench.datasets.window import WHOLE, Window, resolve_window
from brainbench.errors import DataError, UsageError, listing, unknown_name
from brainbench.files import content_hash
from brainbench.types import check_recordings

if TYPE_CHECKING:
    import xarray as xr

Source = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


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
    recipe, paths = _resolve(source)
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
        recipe: Recipe | None,
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
        self.plan: Plan | None = None
        self.parts: list[Part] = []
        self.seen: dict[tuple[str, ...], str] = {}
        self.notes: list[str] = []
        self.skipped: list[str] = []
        self.other_subjects: list[str] = []

    def read(self, path: Path) -> None:
        """Read the sessions of one file."""
        with open_file(path) as file:
            for session in read_file(file, path):
                if not has_units(session):
                    self.skipped.append(no_units(session))
                    continue
                self._once(session)
                plan = self._plan(session)
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

    def _plan(self, session: Session) -> Plan:
        """Return the plan, made for the first session and checked against each later one."""
        found = None if self.named else detect_recipe(session)
        if found is not None and self.conditions is not None and self.conditions.table != found.conditions.table:
            found = None
        if self.plan is None:
            self.recipe = self.recipe if self.named else found
            self.plan = self._make_plan(session)
        elif not self.named and found is not self.recipe and self.conditions is None:
            raise UsageError(
                f"{session.source} has another layout than {next(iter(self.seen.values()))}; say with conditions "
                f"TABLE:COLUMN how both are to be read."
            )
        return self.plan

    def _make_plan(self, session: Session) -> Plan:
        conditions = self.conditions or (self.recipe.conditions if self.recipe else None)
        if conditions is None:
            from brainbench.datasets.inspection import propose

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
        return Plan(
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
        self.notes += self.skipped
        return check_recordings(_join(self, self.plan, source))


def _resolve(source: Source) -> tuple[Recipe | None, list[Path]]:
    if not isinstance(source, str):
        return None, find_files(source)
    name, rest = split_source(source)
    return (get_recipe(name) if name else None), find_files(rest)


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


def _join(reader: _Reader, plan: Plan, source: str) -> xr.Dataset:
    import xarray as xr

    parts = sorted(reader.parts, key=lambda part: (natural_key(part.subject), natural_key(part.session)))
    removed = _total(part.tally.removed for part in parts)
    trials, units = sum(len(part.labels) for part in parts), sum(len(part.unit_ids) for part in parts)
    if not trials or not units:
        what = "trial" if not trials else "unit"
        reasons = "; ".join(f"{rule} removed {number}" for rule, number in removed.items() if number)
        raise DataError(f"No {what} remains of {source}: {reasons or 'the tables are empty'}.")
    vocabulary = plan.vocabulary or natural_vocabulary(row for part in parts for row in part.values)
    present = {label for part in parts for label in part.labels}
    if len(present) < 2:
        raise DataError(
            f"All {trials} trials of {source} that remain have the one condition {next(iter(present))!r} "
            f"({plan.conditions}); comparing responses needs at least two, choose another column."
        )
    bins = max(part.counts.shape[1] for part in parts)
    counts = np.full((trials, bins, units), np.nan, dtype=np.float32)
    duration = np.zeros((trials, bins))
    row = column = 0
    for part in parts:
        count, depth, width = part.counts.shape
        counts[row : row + count, :depth, column : column + width] = part.counts
        duration[row : row + count, :depth] = part.duration
        row, column = row + count, column + width
    edges = np.concatenate([part.edges for part in parts])
    coordinates: dict[str, Any] = {
        "time": ("time", np.arange(bins) * (plan.bin or 0.0)),
        "stimulus": ("trial", [label for part in parts for label in part.labels]),
        "subject": ("trial", [part.subject for part in parts for _ in part.labels]),
        "session": ("trial", [part.session for part in parts for _ in part.labels]),
        "trial_id": ("trial", [name for part in parts for name in part.trial_ids]),
        "window_start": ("trial", edges[:, 0]),
        "window_stop": ("trial", edges[:, 1]),
        "unit_subject": ("unit", [part.subject for part in parts for _ in part.unit_ids]),
        "unit_session": ("unit", [part.session for part in parts for _ in part.unit_ids]),
        "unit_id": ("unit", [name for part in parts for name in part.unit_ids]),
        **{name: ("unit", np.concatenate([part.columns[name] for part in parts])) for name in UNIT_COLUMNS},
    }
    dataset = xr.Dataset(
        {"counts": (("trial", "time", "unit"), counts), "duration": (("trial", "time"), duration)}, coordinates
    )
    dataset.attrs = {
        "vocabulary": list(vocabulary),
        "conditions": str(plan.conditions),
        "recipe": _recipe_name(reader),
        "window": str(plan.window),
        "bin": plan.bin,
        "selection": {"name": plan.selection.name, "rules": list(plan.selection.lines())},
        "removed": removed,
        "missing": _missing(parts, vocabulary),
        "sessions": [_about(part) for part in parts],
        "notes": [*reader.notes, *(note for part in parts for note in part.tally.notes)],
        "source": source,
        "synthetic": any(part.synthetic for part in parts),
        "content_hash": content_hash(vocabulary, *(item for part in parts for item in _content(part))),
    }
    return dataset


def _content(part: Part) -> tuple[Any, ...]:
    """What makes the data: all else (window, selection, file names) only says how they came about."""
    names = (part.subject, part.session, part.labels, part.trial_ids, part.unit_ids)
    return part.counts, part.duration, names


def _about(part: Part) -> dict[str, Any]:
    return {
        "subject": part.subject,
        "session": part.session,
        "source": part.source,
        "trials": len(part.labels),
        "trials_in_file": part.trials,
        "units": len(part.unit_ids),
        "units_in_file": part.units,
        "removed": dict(part.tally.removed),
        "synthetic": part.synthetic,
    }


def _missing(parts: list[Part], vocabulary: tuple[str, ...]) -> dict[str, list[str]]:
    have: dict[str, set[str]] = {}
    for part in parts:
        have.setdefault(part.subject, set()).update(part.labels)
    gaps = {subject: [label for label in vocabulary if label not in labels] for subject, labels in have.items()}
    return {subject: labels for subject, labels in gaps.items() if labels}


def _recipe_name(reader: _Reader) -> str:
    if reader.recipe is None:
        return ""
    return reader.recipe.name if reader.named else f"{reader.recipe.name} (detected from the layout)"


def _total(tallies: Iterable[dict[str, int]]) -> dict[str, int]:
    total: dict[str, int] = {}
    for tally in tallies:
        for rule, number in tally.items():
            total[rule] = total.get(rule, 0) + number
    return total


def _first_and_count(reasons: list[str]) -> str:
    more = f" ({len(reasons) - 1} more files likewise)" if len(reasons) > 1 else ""
    return f"{reasons[0]}{more}" if reasons else "The file holds no session."
