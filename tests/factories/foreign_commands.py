"""What others send, changed by seed and given to the command or function that takes it, in a process of its own.

``python -m tests.factories.foreign_commands FOLDER NAME… --cases N`` writes what becomes of each case into the folder,
leaves out cases that stand there, and prints the table; ``--before OTHER`` adds what stands in another folder. The good
input stands in the folder or is made there, so that another version of the packages (PYTHONPATH) can be given the same.
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import json
import math
import os
import re
import resource
import select
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import torch

from tests.factories.forks import fork, sentences
from tests.factories.reading_trials import LONGEST, not_finite, numbers
from tests.factories.structures import restructure

FAILURES = ("traceback", "hang", "crash", "silent", "leaked", "half-written", "wordy")
SECONDS = 60
"""Processor time of a case."""
PATIENCE = 300.0
"""Time of a case by the clock, which a busy machine stretches."""
MEMORY = 16 << 30
"""Address space [bytes] of a case; libraries reserve much more than they use."""
SECRET = "PRIVATE-7f3a91"
"""Stands in files that no case was given: ``../../etc/passwd`` from its folder, and the user's settings beside it."""
LARGEST = 1e200
"""Magnitude that no number of a result has."""


@dataclass(frozen=True)
class Door:
    """An entrance for files or words of others."""

    name: str
    make: str
    """Function of :mod:`tests.factories.foreign_goods` that writes a good input into a folder, and returns the file to
    be changed."""
    words: str = ""
    """Words of the command line, with ``{file}`` and ``{folder}``."""
    read: Callable[[Path], Any] | None = None
    """Without words: a public function; what it imports may not be there."""
    after: Callable[[Path], None] | None = None
    """What whoever changes a file can do to make it pass for whole, such as sealing it again."""


@dataclass(frozen=True)
class Verdict:
    """What became of a case: ``accepted``, ``refused``, ``absent`` (no such entrance), or one of :data:`FAILURES`."""

    kind: str
    what: str = ""
    """The change."""
    detail: str = ""


def cases(door: Door, folder: Path, seeds: range) -> Iterator[Verdict]:
    """Yield what becomes of the good input, and then of each change; each case is a fork.

    The good input stands in the folder, where an earlier call has made it. What its case imports is loaded for all.
    """
    note = folder / "name.txt"
    if not note.is_file():
        (folder / "good").mkdir(parents=True)
        path = getattr(import_module("tests.factories.foreign_goods"), door.make)(folder / "good")
        note.write_text(path.relative_to(folder / "good").as_posix())
    root = folder / f"cases-{os.getpid()}"
    for seed in (None, *seeds):
        (root / "etc").mkdir(parents=True)
        (root / "etc" / "passwd").write_text(f'{{"{SECRET}": 1}}\n')
        place = root / "a" / "case"
        shutil.copytree(folder / "good", place)
        path = place / note.read_text()
        what = "nothing" if seed is None else restructure(path, seed)
        if door.after is not None and path.is_file():
            door.after(path)
        verdict = _judge(door, path, place, what)
        if seed is None:
            for module in _text(root / "a" / "modules").splitlines():
                with suppress(Exception, SystemExit):
                    import_module(module)
            gc.freeze()  # a fork copies what the collector touches
        shutil.rmtree(root, ignore_errors=True)
        yield verdict


def _judge(door: Door, path: Path, place: Path, what: str) -> Verdict:
    before, out, err = _files(place), place.with_name("out"), place.with_name("err")
    child = fork(partial(_run, door, path, place), out, err)
    status = _wait(child)
    out, err = (stream.read_text(errors="replace") for stream in (out, err))
    error = re.sub(r"\s+", " ", err).strip().removeprefix("brainbench: ")
    written = _files(place) - before
    verdict = partial(Verdict, what=what, detail=error[-600:])
    if status in (None, -signal.SIGXCPU):
        return verdict("hang")
    if status == ABSENT:
        return verdict("absent")
    if status < 0:
        return verdict("crash", detail=f"signal {-status}: {error[-400:]}")
    if "Traceback (most recent call last)" in err + out:
        return verdict("traceback")
    if _leaks([out, err, *(file.read_bytes().decode(errors="replace") for file in written if file.is_file())]):
        return verdict("leaked")
    if status:
        if written:
            return verdict("half-written", detail=f"{sorted(file.name for file in written)}: {error[:300]}")
        return verdict("wordy" if len(error) > LONGEST or not error else "refused")
    unfinished = [file.name for file in written if file.name.startswith(".")]
    if unfinished:
        return verdict("half-written", detail=str(unfinished))
    return verdict("silent" if _odd(out) else "accepted", detail=out[:300])


ABSENT = 97


def _run(door: Door, path: Path, place: Path) -> None:
    """Do the work of a case within its bounds."""
    try:
        os.chdir(place)
        os.environ["BRAINBENCH_CONFIG"] = str(place)
        os.setpgid(0, 0)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
        faulthandler.enable(sys.stderr)
        _call(door, path, place)
    finally:
        with suppress(BaseException):
            (place.parent / "modules").write_text("\n".join(sys.modules))


def _call(door: Door, path: Path, place: Path) -> None:
    if door.read is None:
        from brainbench.cli import main

        values = {"file": path, "folder": place, "stem": path.with_suffix("")}
        sys.argv = ["brainbench", *(word.format(**values) for word in shlex.split(door.words))]
        return main()
    try:
        with sentences():
            result = door.read(path)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith(("brainbench", "robotics_bridge", "leaderboards")):
            sys.exit(ABSENT)
        raise
    sys.stdout.write(json.dumps({"odd": math.nan if not_finite(result) else 0.0, "text": str(result)[:2000]}))
    return None


def _text(path: Path) -> str:
    return path.read_bytes().decode(errors="replace").replace("\0", "")[:100_000] if path.is_file() else ""


def _wait(child: int) -> int | None:
    """Return the exit status of a process, negative for a signal; None where its time was over."""
    process = os.pidfd_open(child)
    ended = bool(select.select([process], [], [], PATIENCE)[0])
    os.close(process)
    if not ended:
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGABRT)  # it says where it stands
            time.sleep(1)
            os.killpg(child, signal.SIGKILL)
    status = os.waitpid(child, 0)[1]
    return os.waitstatus_to_exitcode(status) if ended else None


def _files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.name != "__pycache__" and path.suffix != ".pyc"}


def _leaks(texts: list[str]) -> bool:
    return any(SECRET in text or "root:x:0" in text for text in texts)


def _odd(out: str) -> bool:
    """Return whether a result holds a number that is not finite or no quantity has."""
    try:
        value = json.loads(out, parse_constant=lambda word: math.inf)
    except ValueError:
        return False
    return any(abs(number) > LARGEST for number in numbers(value, depth=99))


def _layout(path: Path) -> Any:
    from robotics_bridge import hands

    return dict(hands.load("xhand1").layout(str(path)))


def _student(path: Path) -> Any:
    from robotics_bridge.policies.training.distill import load_student

    student, described = load_student(path.parent)
    return dict(student.state_dict()), described


def _batch(path: Path) -> Any:
    from brainbench.scoring.jobs import read_batch

    return [vars(job.options) for job in read_batch(path)]


def _sweep(path: Path) -> Any:
    from robotics_bridge.policies.training.distill_config import read_sweep

    return [vars(student) for student in read_sweep(path).students()]


def _plan(path: Path) -> Any:
    from brainbench.core.identity import SealedPlan  # pyright: ignore[reportAttributeAccessIssue]

    return SealedPlan.read(path)


def _seal(path: Path) -> None:
    """Give a plan the hash that it has now, as whoever edits one can."""
    with suppress(ValueError, TypeError, AttributeError, RecursionError):
        data = json.loads(path.read_text())
        data.pop("hash", None)
        with suppress(ImportError):
            from brainbench.core import identity

            path.write_text(json.dumps({**data, "hash": identity._hash(data)}))


def _hub(path: Path) -> Any:
    """Return the folder that a name is taken for by a hub that has everything."""
    import types

    from brainbench.models.training.checkpoints import find_folder

    orders: list[str] = []

    def download(repository: str, *, revision: str | None = None, allow_patterns: Any = ()) -> str:
        orders.extend((repository, revision or "", *allow_patterns))
        return str(path.parent)

    sys.modules["huggingface_hub"] = types.SimpleNamespace(snapshot_download=download)  # type: ignore[assignment]
    folder = find_folder(_text(path))
    odd = any(".." in order.split("/") or not order.isascii() or not order.isprintable() for order in orders)
    return math.nan if odd or (orders and ".." in folder.parts) else str(folder)


_FIT = "stimuli fit {file} --most-iterations 1 --links 4 --steps-per-period 20 --json"
_TRACK = f"{_FIT} --whisker mouse:C2 --metres-per-pixel 5e-5 --frame-rate 500"
_REPLAY = "tactile replay {folder}/set --hand {folder}/jaws.urdf --json"
_IMPORT = "--out {folder}/imported --json"

DOORS = (
    Door("contract", "contract", "policy deploy {stem} --seconds 0.05 --input command=0 --json"),
    Door("student, configuration", "student", read=_student),
    Door("student, weights", "student_weights", read=_student),
    Door("probe layout", "layout", read=_layout),
    Door("calibration log", "log", "tactile calibrate {file} --out {folder}/preset.json --json"),
    Door("fit table", "wrenches", f"{_FIT} --whisker mouse:C2 --parameters young_modulus"),
    Door("track, points", "points", _TRACK),
    Door("track, DeepLabCut", "deeplabcut", _TRACK),
    Door("track, DeepLabCut HDF5", "deeplabcut_hdf5", _TRACK),
    Door("track, whisk", "whisk", _TRACK),
    Door(
        "track, whisk's measurements", "whisk_labels",
        f"{_TRACK} --track 0 --identities {{file}}".replace("{file}", "{folder}/track.whiskers", 1),
    ),
    Door("track, WhiskiWrap", "whiskiwrap", _TRACK),
    Door("track, WhiskerMan", "whiskerman", f"{_TRACK} --track 1"),
    Door("track, angles", "angles", "stimuli show {folder}/scene.toml --json"),
    Door("episode, table", "replayed", "tactile replay {file} --hand {folder}/jaws.urdf --json"),
    Door("episode, LeRobot", "lerobot", _REPLAY),
    Door("episode, places", "lerobot_places", _REPLAY),
    Door("episode, frames", "lerobot_frames", _REPLAY),
    Door("models add, file", "model", "models add {file}:Mine --name mine --json"),
    Door("models add, settings", "settings", "models show mine --json"),
    Door("models import", "checkpoint", f"models import {{file}} --architecture zhuang-gru-small {_IMPORT}"),
    Door(
        "models import, graph", "graph",
        f"models import {{folder}}/best.ckpt --architecture zhuang-gru-small --config {{file}} {_IMPORT}",
    ),
    Door(
        "models import, settings", "run_settings",
        f"models import {{folder}}/best.ckpt --architecture zhuang-gru-small --config {{file}} {_IMPORT}",
    ),
    Door("batch file", "batch", read=_batch),
    Door("sweep of students", "sweep", read=_sweep),
    Door(
        "task file", "task",
        "policy evaluate foreign --task-file {file} --envs 1 --episodes 1 --seeds 1 --change episode=0.2 --json",
    ),
    Door("plan", "plan", read=_plan, after=_seal),
    Door("benchmark", "benchmark", "benchmark check {file} --json"),
    Door("benchmark, packed", "packed", "benchmark check {file} --json"),
    Door("hub name", "hub", read=_hub),
)  # fmt: skip


def tabulate(now: dict[str, list[str]], before: dict[str, list[str]]) -> str:
    """Return a table of outcomes by entrance; with an earlier tree's, as ``before → now``."""
    lines = [f"| surface | cases | {' | '.join(FAILURES)} |", "|---|---|" + "---|" * len(FAILURES)]
    sums = ({**side, "all": [kind for kinds in side.values() for kind in kinds]} for side in (before, now))
    before, now = sums
    for name in now:
        sides = [[kind for kind in side.get(name, ()) if kind != "absent"] for side in (before, now)]
        counts = [[len(side), *map(side.count, FAILURES)] for side in sides if side or side is sides[1]]
        lines.append(
            f"| {name} | " + " | ".join(" → ".join(map(str, pair)) for pair in zip(*counts, strict=True)) + " |"
        )
    return "\n".join(lines) + "\n"


def _outcomes(folder: Path) -> dict[str, list[str]]:
    """Return what became of the cases of each entrance that stand in a folder."""
    files = {door.name: folder / f"{door.name}.jsonl" for door in DOORS}
    lines = {name: file.read_text().splitlines() for name, file in files.items() if file.is_file()}
    return {name: [json.loads(line)["kind"] for line in rows] for name, rows in lines.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="entrances; all of them by default")
    parser.add_argument("--cases", type=int, default=200, help="seeds up to this one")
    parser.add_argument("--first", type=int, default=0, help="first seed, where several processes share an entrance")
    parser.add_argument("--before", type=Path, help="folder of an earlier tree")
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # a fork of a process whose threads have worked waits for them for ever
    folder = chosen.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    for door in DOORS:
        if not chosen.names or door.name in chosen.names:
            first = chosen.first + len(_outcomes(folder).get(door.name, ()))
            verdicts = cases(door, folder / door.name, range(first, chosen.cases))
            if (good := next(verdicts)).kind != "accepted":
                raise SystemExit(f"{door.name}: what is whole is not accepted: {good}")
            with (folder / f"{door.name}.jsonl").open("a") as stream:
                for seed, verdict in enumerate(verdicts, first):
                    print(json.dumps({"seed": seed, **vars(verdict)}), file=stream, flush=True)
    sys.stdout.write(tabulate(_outcomes(folder), _outcomes(chosen.before) if chosen.before else {}))


if __name__ == "__main__":
    main()
