"""The check that a folder holds the run that is to go on in it, and not another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from brainbench.core.errors import UsageError, shown
from brainbench.core.files import read_mapping, to_plain, write_json
from brainbench.core.writing.temporaries import is_temporary

CONFIG = "config.json"


def check_same(folder: Path, known: object, identity: Mapping[str, Any], what: str = "run") -> None:
    """Check that what is known of the run in a folder is what identifies this one, both as JSON has it."""
    other, mine = (dict(_leaves(part)) if isinstance(part, Mapping) else {} for part in (known, identity))
    # Of what identifies a run, no part may have more in it than now.
    names = [*mine, *(name for name in other if name not in mine and name.partition(".")[0] in identity)]
    if differing := [name for name in names if other.get(name) != mine.get(name)]:
        told = ", ".join(f"{name} {shown(other.get(name))} (now {shown(mine.get(name))})" for name in differing[:4])
        raise UsageError(f"{str(folder)!r} holds another {what}: {told}. Choose another folder, or delete this one.")


def begin_run(folder: Path, config: Mapping[str, Any], what: str, *, made: str) -> None:
    """Note in an existing folder what is begun there, or check that it is what was begun.

    A first try that made none of the files ``made`` (a pattern) does not stand in the way: its note is replaced.
    """
    path, config = folder / CONFIG, to_plain(config)
    if not path.exists():
        if strange := sorted(item.name for item in folder.iterdir() if not is_temporary(item.name)):
            raise UsageError(
                f"{str(folder)!r} is not empty and holds no {what} (it has {strange[0]!r}); choose a new folder."
            )
    elif any(folder.glob(made)):
        check_same(folder, read_mapping(path), config, what)
        return
    write_json(path, config)


def _leaves(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value
