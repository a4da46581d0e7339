"""The check that a folder holds the run that is to go on in it, and not another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from brainbench.core.errors import UsageError, shown


def check_same(folder: Path, known: object, identity: Mapping[str, Any], what: str = "run") -> None:
    """Check that what is known of the run in a folder is what identifies this one, both as JSON has it.

    Raises:
        UsageError: the folder holds another run.
    """
    other, mine = (dict(_leaves(part)) if isinstance(part, Mapping) else {} for part in (known, identity))
    # Of what identifies a run, no part may have more in it than now.
    names = [*mine, *(name for name in other if name not in mine and name.partition(".")[0] in identity)]
    if differing := [name for name in names if other.get(name) != mine.get(name)]:
        told = ", ".join(f"{name} {shown(other.get(name))} (now {shown(mine.get(name))})" for name in differing[:4])
        raise UsageError(f"{str(folder)!r} holds another {what}: {told}. Choose another folder, or delete this one.")


def _leaves(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value
