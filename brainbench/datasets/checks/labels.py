"""Checks of the labels: missing, misspelled or unbalanced ones, and answers that contradict themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from brainbench.core.errors import BrainbenchError, nearest
from brainbench.datasets.checks.findings import Finding, share, some
from brainbench.datasets.inspection import propose
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import Session, SessionTable, as_labels
from brainbench.datasets.trials.conditions import Conditions, joined_labels

_FEW = 2
"""Split halves need this many trials of every stimulus."""


def check_labels(session: Session, layout: RecordingLayout | None, conditions: Conditions | None) -> Iterator[Finding]:
    """Yield the findings about the condition labels of one session."""
    if conditions is None:
        proposals = [item.conditions for item in propose(session)]
        if session.tables:
            message = f"no layout fits, so labels were not checked; columns to try: {some(proposals, 3)}"
            yield Finding("note", "labels", message, "Pass --conditions TABLE:COLUMN to check them.")
        return
    try:
        table = session.table(conditions.table)
        values = conditions.values(table)
    except BrainbenchError as error:
        yield Finding("error", "labels", str(error))
        return
    counts = Counter(joined_labels(values))
    missing = counts.pop("", 0)
    if missing:
        message = f"{share(missing, len(table))} trials have no value of {', '.join(conditions.columns)}"
        yield Finding("warning" if missing < len(table) else "error", "labels", message, "They are left out.")
    vocabulary = layout.vocabulary(conditions) if layout else None
    if vocabulary is None:
        yield from _spelling(counts)
    else:
        yield from _strangers(counts, vocabulary, layout)
        counts = Counter({label: counts[label] for label in vocabulary})
    yield from _balance(counts, vocabulary)
    if {"outcome", "choice", "rewarded_side"} <= set(table.columns):
        yield from _answers(table)


def _spelling(counts: Counter[str]) -> Iterator[Finding]:
    folded: dict[str, list[str]] = {}
    for label in counts:
        folded.setdefault("".join(label.lower().split()), []).append(label)
    for twins in (found for found in folded.values() if len(found) > 1):
        message = f"labels differ only in case or blanks: {', '.join(map(repr, sorted(twins)))}"
        yield Finding("warning", "labels", message, "They count as different stimuli: make them one.")


def _strangers(counts: Counter[str], vocabulary: tuple[str, ...], layout: RecordingLayout | None) -> Iterator[Finding]:
    # What the layout refuses by rule (such as "nothing") is known and no misspelling.
    refused = {value for rule in layout.selection.trials for value in rule.refuse} if layout else set()
    for label in sorted(label for label in counts if label not in vocabulary and not refused & set(label.split("-"))):
        guess = nearest(label, vocabulary)
        meant = f"; did they mean {guess!r}?" if guess else ""
        message = f"{counts[label]} trials are labelled {label!r}, which is no stimulus of this experiment{meant}"
        yield Finding("warning", "labels", message, "They are left out.", {"label": label, "trials": counts[label]})


def _balance(counts: Counter[str], vocabulary: tuple[str, ...] | None) -> Iterator[Finding]:
    present = {label: number for label, number in counts.items() if number}
    if len(present) < 2:
        message = f"only {len(present)} label has trials; comparing responses needs at least two"
        yield Finding("error", "labels", message)
        return
    absent = [label for label in vocabulary or () if not counts[label]]
    if absent:
        message = f"no trial of {some(absent)}"
        yield Finding("warning", "labels", message, "Pairs with them are missing in this animal's RDM.")
    few = [f"{label} ({number})" for label, number in present.items() if number < _FEW]
    if few:
        message = f"{len(few)} labels have fewer than {_FEW} trials: {some(few)}"
        yield Finding("warning", "labels", message, "A session cannot be split into halves without two of each.")
    least, most = min(present.values()), max(present.values())
    if least >= _FEW and most > 4 * least:
        message = f"trials per label range from {least} to {most}"
        yield Finding("note", "labels", message, "Distances to the rarest label are the noisiest.")


def _answers(table: SessionTable) -> Iterator[Finding]:
    """Hold outcome against choice and rewarded side: they are equal in correct trials of either task."""
    try:
        outcome, choice, side = (as_labels(table.column(name)) for name in ("outcome", "choice", "rewarded_side"))
    except BrainbenchError:
        return
    decided = np.isin(outcome, ("correct", "error")) & np.isin(choice, ("left", "right"))
    wrong = decided & ((outcome == "correct") != (choice == side))
    if decided.any() and wrong.sum() > 0.02 * decided.sum():
        those = share(int(wrong.sum()), int(decided.sum()))
        message = f"outcome contradicts choice and rewarded_side in {those} trials"
        advice = "A column of the table has slipped, or outcome follows another rule; labels may be wrong too."
        yield Finding("error", "labels", message, advice, {"contradicted": int(wrong.sum())})
    if "stimulus" not in table:
        return
    # What was presented decides the rewarded side: by shape in one task, by presence in the other.
    stimulus = as_labels(table.column("stimulus"))
    mixed = []
    for label in sorted(set(stimulus.tolist()) - {""}):
        sides = Counter(side[(stimulus == label) & np.isin(side, ("left", "right"))].tolist())
        if sides and min(sides.values()) / sum(sides.values()) > 0.05 and len(sides) > 1:
            mixed.append(label)
    if mixed:
        message = f"both sides were rewarded for {some(mixed)}"
        advice = "In either task a stimulus has one rewarded side: stimulus and rewarded_side do not belong together."
        yield Finding("error", "labels", message, advice)
