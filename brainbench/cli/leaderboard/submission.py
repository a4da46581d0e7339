"""``brainbench leaderboard check-submission``: what a pull request may bring to a board, which is records alone."""

from __future__ import annotations

import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import typer

from brainbench.cli.leaderboard.verify import REPETITION, Repetition, verdicts
from brainbench.cli.options import with_options
from brainbench.cli.output import Output
from brainbench.core.errors import DataError, UsageError, brief, look_alike, visible

MOST_RECORDS = 200
"""Records of one submission."""
MOST_BYTES = 16 << 20
"""Bytes of one record."""
_PLAIN_FILE = "100644"
_KINDS = {
    "D": "is deleted", "M": "is changed", "T": "becomes a file of another type", "120000": "is a link",
    "160000": "is another repository", "100755": "is executable",
}  # fmt: skip
"""Change, or mode of the new file, in words."""


@dataclass(frozen=True)
class ChangedFile:
    """One file that differs between two commits; a file that moved is one deleted and one added."""

    path: str
    change: str
    """``A`` added, ``M`` changed, ``D`` deleted, ``T`` of another type."""
    mode: str
    """Type of the new file, as git writes it."""
    blob: str
    """Name of its content."""


@with_options(REPETITION, ("score", "held_out", "secret"), parameter="how")
def check_submission(
    base: Annotated[str, typer.Argument(help="Commit of the board that the submission is for.")],
    head: Annotated[str, typer.Argument(help="Commit of the submission; of it only records are read, as data.")],
    how: Repetition,
    results: Annotated[str, typer.Option(help="Folder of the board's records in the repository.")] = (
        "leaderboards/results"
    ),
) -> Output:
    """Check what a submission changes: it may add records to the board's folder, and nothing else.

    Records that are edited, deleted, renamed, replaced by a link or named like another one, and files outside the
    folder, are refused, whatever git calls the change. New records are then verified as by leaderboard verify; nothing
    of the submission is run, and no file that a record names is opened. Exit status 1 if anything is refused.
    """
    from leaderboards.store import read_records

    commitment = how.commitment()
    before, after = (_commit(name) for name in (base, head))
    folder = PurePosixPath(results)
    changes = list(changed_files(_git("merge-base", before, after).decode().strip(), after))
    present = [name for name in _git("ls-tree", "-r", "-z", "--name-only", before, "--", results).split(b"\0") if name]
    refused = list(refusals(changes, folder, [name.decode(errors="surrogateescape") for name in present]))
    text = [f"refused: {visible(item['path'])} {item['problem']}" for item in refused]
    added = [file for file in changes if file.path not in {item["path"] for item in refused}]
    checked = Output([], "no new record")
    if added:
        with tempfile.TemporaryDirectory() as temporary:
            # Each in a folder of its own, so that no name takes the place of another.
            files = [Path(temporary, str(number), _name(file.path)) for number, file in enumerate(added)]
            for file, path in zip(added, files, strict=True):
                path.parent.mkdir()
                path.write_bytes(_git("cat-file", "blob", file.blob))
            checked = verdicts(read_records(files), how, commitment)
    failure = typer.Exit(1) if refused else checked.failure
    data: dict[str, Any] = {"refused": refused, "records": checked.data}
    return Output(data, "\n".join([*text, checked.text]), failure=failure)


def changed_files(before: str, after: str) -> Iterator[ChangedFile]:
    """Yield the files that differ between two commits, none of them taken for a renamed or copied one."""
    command = ("diff", "--raw", "-z", "--no-renames", "--no-abbrev", "--no-ext-diff", "--ignore-submodules=none")
    parts = iter(_git(*command, before, after, "--").split(b"\0"))
    for head, path in zip(parts, parts, strict=False):
        _, mode, _, blob, change = head.decode().removeprefix(":").split(" ")
        yield ChangedFile(path.decode(errors="surrogateescape"), change[0], mode, blob)


def refusals(changes: list[ChangedFile], folder: PurePosixPath, present: list[str]) -> Iterator[dict[str, str]]:
    """Yield, as path and problem, what a submission may not do to a folder of records that holds some files."""
    names = Counter(look_alike(_name(path)) for path in present)
    names.update(look_alike(_name(file.path)) for file in changes if file.change == "A")
    if len(changes) > MOST_RECORDS:
        yield {"path": str(folder), "problem": f"gets {len(changes)} changes; at most {MOST_RECORDS} at once"}
        changes = changes[:0]
    for file in changes:
        path = PurePosixPath(file.path)
        problem = ""
        if folder not in path.parents:
            problem = f"is outside of {folder}: a submission adds records and nothing else"
        elif file.change != "A" or file.mode != _PLAIN_FILE:
            words = _KINDS.get(file.change) or _KINDS.get(file.mode, "is no plain file")
            problem = f"{words}; a submission adds new record files, and leaves those that are there"
        elif path.suffix != ".json" or path.name.startswith("."):
            problem = "is no record file (.json)"
        elif not file.path.isascii() or visible(file.path) != file.path:
            problem = "has a name with other characters than plain ones; give it the name that brainbench score gave it"
        elif names[look_alike(path.name)] > 1:
            problem = "has the name of another record"
        elif int(_git("cat-file", "-s", file.blob)) > MOST_BYTES:
            problem = f"is larger than {MOST_BYTES:,} bytes"
        if problem:
            yield {"path": file.path, "problem": problem}


def _name(path: str) -> str:
    return PurePosixPath(path).name


def _commit(name: str) -> str:
    """Return the hash of a commit, so that no name of it is read as an option."""
    try:
        return _git("rev-parse", "--verify", "--end-of-options", f"{name}^{{commit}}").decode().strip()
    except DataError as error:
        raise UsageError(
            f"There is no commit {brief(name)} in the repository of this folder; fetch it first."
        ) from error


def _git(*words: str) -> bytes:
    try:
        return subprocess.run(["git", *words], capture_output=True, check=True).stdout
    except FileNotFoundError as error:
        raise DataError("git is needed to compare a submission with its board; install it.") from error
    except subprocess.CalledProcessError as error:
        why = next(iter(error.stderr.decode(errors="replace").splitlines()), "no reason stated")
        raise DataError(f"git {words[0]} failed: {brief(why, quoted=False, most=160)}.") from error
