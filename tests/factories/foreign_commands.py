"""What others send, changed by seed and given to the command that takes it, in a process of its own.

``python -m tests.factories.foreign_commands FOLDER NAME --cases N`` prints one JSON object for each case. Functions
that take such inputs are surfaces (:mod:`tests.factories.reading_surfaces`).
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
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from pathlib import Path

import torch

from tests.factories.forks import fork
from tests.factories.reading_trials import LONGEST, Outcome, numbers
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
    words: str
    """Words of the command line, with ``{file}`` and ``{folder}``."""


def cases(door: Door, folder: Path, seeds: range) -> Iterator[Outcome]:
    """Yield what becomes of the good input, and then of each change; each case is a fork.

    What the first case imports is loaded for all.
    """
    (folder / "good").mkdir(parents=True)
    good = getattr(import_module("tests.factories.foreign_goods"), door.make)(folder / "good")
    root = folder / "cases"
    for seed in (None, *seeds):
        (root / "etc").mkdir(parents=True)
        (root / "etc" / "passwd").write_text(f'{{"{SECRET}": 1}}\n')
        place = root / "a" / "case"
        shutil.copytree(folder / "good", place)
        path = place / good.relative_to(folder / "good")
        what = "nothing" if seed is None else restructure(path, seed)
        verdict = _judge(door, path, place, what)
        if seed is None:
            imported = root / "a" / "modules"
            for module in imported.read_text().splitlines() if imported.is_file() else ():
                with suppress(Exception, SystemExit):
                    import_module(module)
            gc.freeze()  # a fork copies what the collector touches
        shutil.rmtree(root, ignore_errors=True)
        yield verdict


def _judge(door: Door, path: Path, place: Path, what: str) -> Outcome:
    before, out, err = _files(place), place.with_name("out"), place.with_name("err")
    child = fork(partial(_run, door, path, place), out, err)
    status = _wait(child)
    out, err = (stream.read_text(errors="replace") for stream in (out, err))
    error = re.sub(r"\s+", " ", err).strip().removeprefix("brainbench: ")
    written = _files(place) - before
    verdict = partial(Outcome, what=what, detail=error[-600:])
    if status in (None, -signal.SIGXCPU):
        return verdict("hang")
    if status < 0:
        return verdict("crash", detail=f"signal {-status}: {error[-400:]}")
    if "Traceback (most recent call last)" in err + out:
        return verdict("traceback")
    texts = [out, err, *(file.read_bytes().decode(errors="replace") for file in written if file.is_file())]
    if any(SECRET in text or "root:x:0" in text for text in texts):
        return verdict("leaked")
    if status:
        if written:
            return verdict("half-written", detail=f"{sorted(file.name for file in written)}: {error[:300]}")
        return verdict("wordy" if len(error) > LONGEST or not error else "refused")
    unfinished = [file.name for file in written if file.name.startswith(".")]
    if unfinished:
        return verdict("half-written", detail=str(unfinished))
    return verdict("silent" if _odd(out) else "accepted", detail=out[:300])


def _run(door: Door, path: Path, place: Path) -> None:
    """Do the work of a case within its bounds."""
    try:
        os.chdir(place)
        os.environ["BRAINBENCH_CONFIG"] = str(place)
        os.setpgid(0, 0)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
        faulthandler.enable(sys.stderr)
        values = {"file": path, "folder": place, "stem": path.with_suffix("")}
        sys.argv = ["brainbench", *(word.format(**values) for word in shlex.split(door.words))]
        import_module("brainbench.cli").main()
    finally:
        (place.parent / "modules").write_text("\n".join(sys.modules))


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


def _odd(out: str) -> bool:
    """Return whether a result holds a number that is not finite or no quantity has."""
    try:
        value = json.loads(out, parse_constant=lambda word: math.inf)
    except ValueError:
        return False
    return any(abs(number) > LARGEST for number in numbers(value, depth=99))


_FIT = "stimuli fit {file} --most-iterations 1 --links 4 --steps-per-period 20 --json"
_TRACK = f"{_FIT} --whisker mouse:C2 --metres-per-pixel 5e-5 --frame-rate 500"
_REPLAY = "tactile replay {folder}/set --hand {folder}/jaws.urdf --json"
_IMPORT = "--out {folder}/imported --json"

DOORS = (
    Door("contract", "contract", "policy deploy {stem} --seconds 0.05 --input command=0 --json"),
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
    Door(
        "task file", "task",
        "policy evaluate foreign --task-file {file} --envs 1 --episodes 1 --seeds 1 --change episode=0.2 --json",
    ),
    Door("benchmark", "benchmark", "benchmark check {file} --json"),
    Door("benchmark, packed", "packed", "benchmark check {file} --json"),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("name", choices=[door.name for door in DOORS], metavar="NAME")
    parser.add_argument("--cases", type=int, default=200)
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # a fork of a process whose threads have worked waits for them for ever
    door = next(door for door in DOORS if door.name == chosen.name)
    for verdict in cases(door, chosen.folder.absolute(), range(chosen.cases)):
        sys.stdout.write(json.dumps(asdict(verdict)) + "\n")
        sys.stdout.flush()  # a fork would write it again


if __name__ == "__main__":
    main()
