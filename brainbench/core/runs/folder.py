"""The folder of a run: a document says which run it holds, and a run goes on there only if it is that one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from brainbench.core.errors import DataError, UsageError, brief
from brainbench.core.files import read_mapping, to_plain, write_json
from brainbench.core.writing.temporaries import is_temporary

RUN, CONFIG = "run.json", "config.json"
RESTART = "Delete it to start anew."
EARLIER_STATE = "resume.safetensors"
"""State of a teacher before all runs had one format."""


@dataclass(frozen=True)
class RunEnd:
    """How a run ended, at least for now."""

    status: Literal["finished", "stopped", "diverged"]
    """``stopped``: before its end, by time, count or signal; start it again to go on."""
    reason: str
    """Why it stopped or diverged; empty for a finished run."""
    folder: Path


def claim(
    document: Path,
    identity: Mapping[str, Any],
    begin: Callable[[], Mapping[str, Any]],
    *,
    stated: Callable[[dict[str, Any]], object],
    what: str = "run",
    write: bool = True,
) -> None:
    """Enter a run into its folder, or find it there: a run goes on if its identity is equal.

    Args:
        document: The file that says which run the folder holds.
        identity: What must be equal.
        begin: Gives the document of a new run.
        stated: Checks an earlier document, and returns what it states of the identity.
        what: What the folder holds, for messages.
        write: Off in all processes but one: a folder without a run stays so.
    """
    if document.is_file():
        if document.with_name(EARLIER_STATE).exists():
            raise earlier_state(document.with_name(EARLIER_STATE))
        check_same(document.parent, stated(read_mapping(document)), to_plain(identity), what)
    elif write:
        document.parent.mkdir(parents=True, exist_ok=True)
        write_json(document, begin())


def mark(document: Path, **values: Any) -> None:
    """Add to what a document says of its run."""
    write_json(document, {**read_mapping(document), **values})


def earlier_state(path: Path) -> DataError:
    """Return the error for a state of another format."""
    return DataError(
        f"{brief(str(path))} was saved by an earlier brainbench, and this one cannot go on from it: end the run with "
        "that one, or delete its folder to start anew."
    )


def check_same(folder: Path, stated: object, identity: Mapping[str, Any], what: str = "run") -> None:
    """Check that what a folder states of its run is what identifies this one, both as JSON has it."""
    before, now = (dict(_leaves(part)) if isinstance(part, Mapping) else {} for part in (stated, identity))
    # Of what identifies a run, no part may have more in it than now.
    names = [*now, *(name for name in before if name not in now and name.partition(".")[0] in identity)]
    if differing := [name for name in names if before.get(name) != now.get(name)]:
        changes = ", ".join(f"{name} {brief(before.get(name))} (now {brief(now.get(name))})" for name in differing[:4])
        raise UsageError(f"{str(folder)!r} holds another {what}: {changes}. Choose another folder, or delete this one.")


def begin_run(folder: Path, config: Mapping[str, Any], what: str, *, results: str) -> None:
    """Note in an existing folder what is begun there, or check that it is what was begun.

    A first try that made none of its ``results`` (a pattern of files) does not stand in the way: its note is replaced.
    """
    path, config = folder / CONFIG, to_plain(config)
    if not path.exists():
        if strange := sorted(path.name for path in folder.iterdir() if not is_temporary(path.name)):
            raise UsageError(
                f"{str(folder)!r} is not empty and holds no {what} (it has {strange[0]!r}); choose a new folder."
            )
    elif any(folder.glob(results)):
        check_same(folder, read_mapping(path), config, what)
        return
    write_json(path, config)


def _leaves(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value
