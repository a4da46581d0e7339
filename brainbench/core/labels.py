"""Pairs of condition labels in recordings and stimulus labels."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from brainbench.core.errors import UsageError, check_once, listing, repeats


def join_labels(
    vocabulary: tuple[str, ...],
    labels: tuple[str, ...],
    match: str | os.PathLike[str] | Mapping[str, str | None] | None,
) -> dict[str, str]:
    """Pair recording labels with stimulus labels, in the order of the recordings' vocabulary.

    Args:
        vocabulary: condition labels of the recordings.
        labels: stimulus labels of the model side.
        match: recording label → stimulus label (None drops it), or a file of such pairs. Labels it
            does not name are paired with their equals; without it every label must have an equal.
    """
    explicit = read_match(match) if isinstance(match, (str, os.PathLike)) else dict(match or {})
    sides = f"recordings: {listing(vocabulary, limit=40)}; stimuli: {listing(labels, limit=40)}"
    for label, partner in explicit.items():
        if label not in vocabulary:
            raise UsageError(
                f"The match names {label!r}, which is no label of the recordings ({sides}). A CSV file has no headings."
            )
        if partner is not None and partner not in labels:
            raise UsageError(f"The match pairs {label!r} with {partner!r}, which is no stimulus ({sides}).")
    pairs = {label: explicit.get(label, label) for label in vocabulary}
    pairs = {label: partner for label, partner in pairs.items() if partner is not None}
    alone = [label for label, partner in pairs.items() if partner not in labels]
    unused = [] if explicit else [label for label in labels if label not in pairs.values()]
    if alone or unused:
        lonely = {"without a stimulus": alone, "without recordings": unused}
        words = "; ".join(f"{what}: {listing(found, limit=40)}" for what, found in lonely.items() if found)
        free = next((label for label in labels if label not in pairs.values()), "")
        raise UsageError(
            f"The labels of recordings and stimuli do not match ({words}; equal on both sides: "
            f"{len(pairs) - len(alone)}). Pair them with --match FILE, a line for each label of the recordings as in "
            f"'{next(iter(alone or vocabulary), 'label')},{free}' (.csv; nothing after the comma drops the label)."
        )
    if twice := repeats(pairs.values()):
        raise UsageError(f"Two recording labels are paired with the stimulus {twice[0]!r}; pairs must be one to one.")
    return {label: str(partner) for label, partner in pairs.items()}


def read_match(path: str | os.PathLike[str]) -> dict[str, str | None]:
    """Read label pairs from JSON or TOML (an object) or CSV (two columns; an empty second one drops)."""
    import csv

    from brainbench.core.reading.regular import readable
    from brainbench.core.reading.texts import read_mapping, read_text

    path = Path(path)
    if not path.is_file():
        raise UsageError(f"There is no match file {str(path)!r}.")
    kind = path.suffix.lower()
    if kind in (".json", ".toml"):
        pairs = read_mapping(path)
    elif kind == ".csv":
        lines = read_text(path, "match file").splitlines()
        with readable(path, "table of labels"):
            rows = [row for row in csv.reader(lines) if row]
        if any(len(row) != 2 for row in rows):
            raise UsageError(f"{str(path)!r} must have two columns: recording label, stimulus label.")
        check_once(repr(str(path)), [row[0] for row in rows])
        pairs = dict(rows)
    else:
        raise UsageError(f"A match file ends in .json, .toml or .csv; received {path.name!r}.")
    if not all(isinstance(value, (str, type(None))) for value in pairs.values()):
        raise UsageError(f"{str(path)!r} must map recording labels to stimulus labels (text, or null to drop one).")
    return {str(key): value or None for key, value in pairs.items()}
