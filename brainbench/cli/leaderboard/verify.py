"""``brainbench leaderboard verify | check-submission | hold-out``: check records, and score their models again.

A pull request may bring records to a board and nothing else; they are verified like any others, also on animals or
stimuli that were kept back.
"""

from __future__ import annotations

import math
import secrets
import subprocess
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import SCORE, SCORE_FLAGS, option_fields, out_folder, out_folder_option, with_options
from brainbench.cli.output import Output, progress_bar, table_of, tracked
from brainbench.core.errors import BrainbenchError, DataError, UsageError, brief, check_number, look_alike, visible
from brainbench.core.files import content_hash, private_folder, write_json
from brainbench.core.limits import NotNegative, limited
from brainbench.core.reading.regular import temporary_folder
from brainbench.core.reading.values import typed_values
from brainbench.core.records import ResultRecord, Score
from brainbench.scoring.demo import DEMOS
from brainbench.scoring.options import ScoreOptions
from leaderboards.audit import differences, in_short, remarks
from leaderboards.held_out import DATA, Commitment, digest, new_salt
from leaderboards.ranking import standing_of
from leaderboards.store import StoredRecord, read_records

if TYPE_CHECKING:
    import xarray as xr

PUBLIC = "public.h5"  # file of the public part
FEWEST = {"animals": 2, "stimuli": 3}  # fewest on either side: less has no score


@with_options(SCORE, ("conditions", "select", "window"), build=False)
def hold_out(
    recordings: Annotated[str, typer.Argument(help="An NWB or HDF5 file, a folder, a glob, or 'demo'.")],
    animals: Annotated[int, typer.Option(help="Number of animals to hold back.")] = 0,
    stimuli: Annotated[int, typer.Option(help="Number of stimuli to hold back.")] = 0,
    out: Annotated[Path, out_folder_option("Folder of what is published.")] = Path("board"),
    secret: Annotated[
        Path, typer.Option(callback=out_folder, help="Folder of what is kept back; never publish it.")
    ] = Path("held-out-secret"),
    options: Any = None,
) -> Output:
    """Split recordings into a public part and a held-out part, drawn at random, and publish a hash of the latter.

    Anybody can score models on the public part; ``leaderboard verify --held-out`` scores a submission on the rest.
    """
    from brainbench.datasets import write_recordings
    from brainbench.datasets.reading import find_recordings
    from brainbench.scoring.neural_responses import open_neural_responses

    if (animals > 0) == (stimuli > 0):
        raise UsageError(f"Hold back either --animals or --stimuli; received {animals} and {stimuli}.")
    if secret.exists():
        raise UsageError(f"The folder {str(secret)!r} exists; name a new one, so that no earlier secret is lost.")
    sources = [] if recordings in DEMOS else find_recordings(recordings)[1]
    if (out / PUBLIC).resolve() in [path.resolve() for path in sources]:
        raise UsageError(f"The public part would take the place of {recordings!r}, which it is of; give another --out.")
    kind = "animals" if animals else "stimuli"
    with progress_bar() as progress:
        whole = open_neural_responses(recordings, progress=progress, **options).dataset
    names = list(whole.attrs["vocabulary"]) if stimuli else sorted(set(map(str, whole["subject"].values)))
    held_count = animals or stimuli
    check_number(f"{kind} held back", held_count, least=FEWEST[kind], most=len(names) - FEWEST[kind])
    drawn = set(secrets.SystemRandom().sample(names, held_count))
    held, public = (split(whole, kind, [n for n in names if (n in drawn) is kept]) for kept in (True, False))
    data = write_recordings(private_folder(secret) / DATA, held)
    data.chmod(0o600)
    of, hashed = str(whole.attrs["content_hash"]), digest(data, new_salt(secret))
    commitment = Commitment(kind, held_count, len(names) - held_count, of, hashed)
    files = [
        write_recordings(out / PUBLIC, public),
        # Stimuli without recordings are left out only where the pairs are named.
        write_json(out / "match.json", {name: name for name in public.attrs["vocabulary"]}),
        write_json(out / "held-out.json", commitment.plain),
    ]
    text = f"published  {out}: {', '.join(path.name for path in files)}\nkept back  {secret}: {held_count} {kind}"
    return Output({"published": files, "secret": secret, "commitment": commitment.plain}, text)


def split(whole: xr.Dataset, kind: str, names: list[str]) -> xr.Dataset:
    """Return the trials, and of animals also the units, of some animals or stimuli of a recordings data set."""
    from brainbench.datasets.trials.session_trials import fingerprint

    if kind == "animals":
        part = whole.isel(trial=whole["subject"].isin(names).values, unit=whole["unit_subject"].isin(names).values)
    else:
        part = whole.isel(trial=whole["stimulus"].isin(names).values)
    labels = [label for label in whole.attrs["vocabulary"] if kind == "animals" or label in names]
    part_hash = content_hash(whole.attrs["content_hash"], kind, names)
    return part.assign_attrs(vocabulary=labels, content_hash=part_hash, fingerprint=fingerprint(part))


def score_held_out(record: ResultRecord, commitment: Commitment, secret: Path) -> dict[str, Any]:
    """Score the model of a record on held-out recordings, with the options that the record states.

    The answer is rounded to two digits: many submissions shall learn little of the held-out part.
    """
    from brainbench.datasets import open_recordings
    from brainbench.scoring.scores import score_record

    held = open_recordings(commitment.open(secret))
    pairs = record.score.provenance.pairs
    settings = {**record.score.provenance.settings, "conditions": None, "select": None, "window": None, "bin": None}
    match = settings.get("match") or {label: pairs.get(label, label) for label in held.attrs["vocabulary"]}
    options = ScoreOptions.stated_in(settings, recordings=held, match=match)
    held_score = score_record(str(settings["model"]), options).score
    return {
        "held_out": f"{commitment.held} {commitment.kind}",
        "on_public": _two_digits(record.score),
        "on_held_out": _two_digits(held_score),
    }


def _two_digits(score: Score) -> dict[str, Any]:
    span = score.scaled_interval
    values = {"score": score.scaled, "low": span.low if span else math.nan, "high": span.high if span else math.nan}
    return {name: round(value, 2) if math.isfinite(value) else None for name, value in values.items()} | {
        "standing": standing_of(score, above_raw=False)
    }


@limited
class Repetition:
    """How records are scored again."""

    recordings: str | None = None
    """Where the recordings are, if not 'demo'."""
    stimuli: str | None = None
    """Stimuli, if not a recipe of the package."""
    benchmark: str | None = None
    """Benchmark (.zip, .toml or name) that the records are of, in place of recordings and stimuli."""
    score: bool = True
    """Score the model again and compare; else only read the files."""
    tolerance: NotNegative = 1e-3
    """Numbers that differ by no more are equal, distances by no more than this share of the largest."""
    trust_code: bool = False
    """Also run code and weights that do not come with this package."""
    held_out: str | None = None
    """Published commitment; also score on what it holds back."""
    secret: Path = Path("held-out-secret")
    """Folder of the held-out recordings."""

    def commitment(self) -> Commitment | None:
        """Return the commitment, if there is one; one that is not usable, or a secret, is told before any score."""
        # An empty text too is none: workflows pass on a variable that a board may lack.
        if not self.held_out:
            return None
        commitment = Commitment.read(Path(self.held_out))
        commitment.open(self.secret)
        return commitment


REPETITION = "brainbench.cli.leaderboard.verify:Repetition"


@with_options(REPETITION, parameter="how", flags=SCORE_FLAGS)
def verify(
    records: Annotated[list[Path], typer.Argument(help="Record files or folders of them.")],
    how: Repetition,
) -> Output:
    """Check records: the file against its hash, the records against one another, the numbers against a repetition.

    Only models of the registry, weights and stimuli that come with the package are repeated: code that a record names
    could do anything, and could read the answer, and a path in it could be that of any file. Exit status 1 if a file
    was edited, a repetition gives something else or cannot be made; what differs is printed.
    """
    commitment = how.commitment()
    return verdicts(read_records(records), how, commitment)


def verdicts(stored: Sequence[StoredRecord], how: Repetition, commitment: Commitment | None = None) -> Output:
    """Return what is found about records, with exit status 1 where one is refused, differs or is not repeated."""
    doubts = remarks(stored)
    results: list[dict[str, Any]] = []
    for entry in tracked(stored, "records verified"):
        result: dict[str, Any] = {"record": entry.path.name, "verdict": "refused", "problem": entry.problem}
        if entry.record is not None:
            result |= {"verdict": "intact", "doubts": doubts.get(entry.record.identity, ())}
            try:
                if how.score:
                    again = score_again(entry.record, how)
                    changes = differences(entry.record, again, tolerance=how.tolerance)
                    result |= {"verdict": "differs" if changes else "confirmed", "differences": changes}
                    result |= {"value": again.score.value}
                if commitment is not None and result["verdict"] in ("intact", "confirmed"):
                    refuse_foreign_code(entry.record, trusted=how.trust_code)
                    result |= score_held_out(entry.record, commitment, how.secret)
            except BrainbenchError as error:
                result |= {"verdict": "not repeated", "problem": str(error)}
        results.append(result)
    failed = any(result["verdict"] in ("refused", "differs", "not repeated") for result in results)
    text = "\n".join(_verdict(result) for result in results)
    return Output(results, text, failure=typer.Exit(1) if failed else None)


def score_again(record: ResultRecord, how: Repetition) -> ResultRecord:
    """Repeat a record's computation from its provenance, of which only names that this package knows are taken.

    Only demo recordings are found without ``how.recordings``, since records keep no folders.
    """
    from brainbench.scoring.scores import score_record

    origin = record.score.provenance
    model, source = origin.settings.get("model"), origin.recordings.get("source")
    _check_kinds(record, model, source)
    if not isinstance(model, str):
        raise DataError(
            f"The record of {record.score.name!r} does not name a model that can be loaded (a module in memory or a "
            "record of an earlier layout); score the model again."
        )
    refuse_foreign_code(record, trusted=how.trust_code, stimuli=how.stimuli or how.benchmark)
    more = _additions(origin.statistics)
    if how.benchmark is not None:
        return score_record(model, ScoreOptions.stated_in(origin.settings, benchmark=how.benchmark, **more))
    if name := origin.benchmark_name:
        raise UsageError(f"The record was made on the benchmark {brief(name)}; give it with --benchmark FILE.")
    if how.recordings is None and (not isinstance(source, str) or source not in DEMOS):
        raise UsageError(f"The record was made with recordings {str(source)[:80]!r}; give them with --recordings PATH.")
    others = {"recordings": how.recordings or source, "match": origin.settings.get("match") or origin.pairs or None}
    others |= more | ({"stimuli": how.stimuli} if how.stimuli else {})
    return score_record(model, ScoreOptions.stated_in(origin.settings, **others))


def _additions(statistics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options by which statistics came into a record beside those of every score."""
    board: Any = statistics.get("groups")
    groups = board.get("groups") if isinstance(board, Mapping) else ()
    groups = groups if isinstance(groups, list | tuple) else ()
    names = "|".join(str(group.get("group")) for group in groups if isinstance(group, Mapping))
    return {"explain": "estimator_walk" in statistics, "by": f"{board.get('by')}={names}" if names else None}


def _check_kinds(record: ResultRecord, model: Any, source: Any) -> None:
    """Raise DataError for settings of other kinds than the options of a score: anyone may have written the record."""
    origin = record.score.provenance
    stated: dict[str, tuple[Any, Any]] = {
        "model": (model, str),
        "source": (source, str | list[str]),
        "pairs": (origin.pairs, dict[str, str | None]),
        # Presets are texts, other fidelities their fields.
        "fidelity": (origin.settings.get("fidelity"), str | dict[str, Any]),
    }
    for name, option in option_fields(SCORE).items():
        kind = list[str] if option.several else str if option.kind is Path else option.kind
        stated.setdefault(name, (origin.settings.get(name), kind))
    for name, (value, kind) in stated.items():
        typed_values(kind | None, value, f"the setting {name!r} of {record.score.name[:80]!r}")


def refuse_foreign_code(record: ResultRecord, *, trusted: bool, stimuli: str | None = None) -> None:
    """Refuse to run or open what a record names unless it is in the registry or comes with the package.

    ``stimuli`` given by whoever asks stand in place of the record's.
    """
    from brainbench.metrics import list_metrics
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped
    from brainbench.stimuli.scenes.recipes import is_packaged

    settings = record.score.provenance.settings
    if not (trusted or stimuli or settings.get("stimuli") is None or is_packaged(settings["stimuli"])):
        raise UsageError(
            f"The stimuli {brief(settings['stimuli'])} of the record do not come with this package, and what a record "
            "names is not opened; give yours with --stimuli, or trust the record with --trust-code."
        )
    ours = {"model": [*list_models(), *shipped()], "metric": list_metrics()}
    for what, names in ours.items():
        if not trusted and settings.get(what) not in names:
            raise UsageError(
                f"The {what} {str(settings.get(what))[:80]!r} of the record is not in the registry and does not come "
                "with this package; read its code, then run it with --trust-code."
            )


def _verdict(result: dict[str, Any]) -> str:
    words = {
        "confirmed": "confirmed: scored again with the same result",
        "intact": "intact: the file fits its hash (not scored again)",
        "differs": "differs: scored again with another result",
        "not repeated": f"not repeated: {result['problem']}",
        "refused": f"refused: {result['problem']}",
    }
    lines = [visible(result["record"]), f"  {visible(words[result['verdict']])}"]
    lines += [f"  {visible(doubt)}" for doubt in result.get("doubts", ())]
    if held := result.get("held_out"):
        columns = {name: f"{{0[{name}]}}" for name in ("on", "score", "low", "high", "standing")}
        rows = [{"on": "public part", **result["on_public"]}, {"on": f"held-out {held}", **result["on_held_out"]}]
        lines.append(table_of("", rows, columns))
    if changes := result.get("differences"):
        cells = [(change.what, in_short(change.before), in_short(change.after)) for change in changes[:12]]
        lines.append(table_of("", cells, {"what": "{0[0]}", "record": "{0[1]}", "now": "{0[2]}"}))
        lines += [f"  and {len(changes) - 12} more"] if len(changes) > 12 else []
    return "\n".join(lines)


MOST_RECORDS = 200  # records of one submission
MOST_BYTES = 16 << 20  # bytes of one record
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
        with temporary_folder() as temporary:
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
