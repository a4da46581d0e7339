"""What others send beside recordings, with its structure changed by seed: refused in one sentence, or sound.

The text of a changed file still parses, and something in it is not as it should be: documents lose, double, rename and
move their keys and values; tables their rows and columns; Python files their statements. What has another structure
(HDF5, weights) is damaged. Functions that take such inputs are surfaces (:mod:`tests.factories.reading_surfaces`);
commands are given each input in a process of its own, and
``python -m tests.core.reading.test_foreign_structures FOLDER NAME --cases N`` prints one JSON object for each case.
"""

from __future__ import annotations

import argparse
import csv
import faulthandler
import gc
import io
import json
import math
import os
import random
import re
import resource
import select
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.benchmarks.opening import pack
from brainbench.core.files import write_json
from brainbench.core.identity import content_hash
from robotics_bridge import hands
from robotics_bridge.deploy.links.replay import PARTS, SessionFacts, TactilePoints, taxel_names, write_lerobot
from tests.factories.damage import SPECIAL, TWINS, alter, change, damage
from tests.factories.forks import fork
from tests.factories.hand_gallery import GALLERY
from tests.factories.policies import export_small
from tests.factories.reading_surfaces import GRAPH, SURFACES, _checkpoint, _log
from tests.factories.reading_trials import LONGEST, Outcome, attempt, numbers, written
from tests.factories.scored_files import write_laboratory
from tests.factories.whisker_measurements import write_ringdown
from tests.factories.whisker_tracks import (
    bent_shapes,
    write_deeplabcut_csv,
    write_deeplabcut_table,
    write_measurements,
    write_points,
    write_whiskerman,
    write_whiskers,
    write_whiskiwrap,
)

CELLS = (
    "nan", "inf", "-inf", "1e308", "-1", "0", "", "x", "1,5", "1e400", "0x10", "١٢", "9" * 400, "1_000", "\u200b1",
    "true", "-1e-320", "1e18", "a\x00b", "''", "2147483648.0",
)  # fmt: skip
"""What takes the place of a cell of a table."""
STATEMENTS = (
    "raise ValueError('x' * 5000)",
    "raise SystemExit(0)",
    "import no_such_module",
    "undefined_name",
    "def f(:",
    "1 / 0",
    "'\\ud800'.encode()",
    "(lambda f: f(f))(lambda f: f(f))",
    "\x00",
    "raise type('E', (Exception,), {'__str__': lambda self: 1 / 0})",
    "import sys; sys.exit('bye')",
    "from . import x",
    "raise UnicodeDecodeError('utf-8', b'x', 0, 1, '\\x1b[31m')",
    "  indented = 1",
    "return 3",
    "await x",
)
"""What stands in a Python file in place of a line."""


def restructure(path: Path, seed: int) -> str:
    """Change a file in place and say how; equal seeds do the same."""
    chance = random.Random(seed)
    change_kind = _CHANGES.get(path.suffix)
    if change_kind is None:
        return damage(path, seed + SPECIAL)
    what = [change_kind(path, chance) for _ in range(chance.choice((1, 1, 1, 2)))]
    if chance.random() < 0.05:
        data = path.read_bytes()
        path.write_bytes(data[: chance.randrange(len(data) + 1)])
        what.append("cut off")
    return ", ".join(what)


def _document(path: Path, chance: random.Random) -> str:
    try:
        value = json.loads(path.read_text())
    except ValueError:  # a change before this one
        return "nothing"
    if chance.random() < 0.08:
        path.write_text(chance.choice(("[]", "{}", "null", "3", '"x"', f"[{path.read_text()}]", '{"a":1,"a":2}')))
        return "whole"
    what = alter(value, chance)
    text = json.dumps(value)
    if chance.random() < 0.08 and isinstance(value, dict) and value:
        name = chance.choice(list(value))
        text, what = text[:-1] + f", {json.dumps(name)}: {json.dumps(value[name])}}}", f"{name[:20]} twice"
    path.write_text(text)
    return what


def _table(path: Path, chance: random.Random) -> str:
    """Change a cell, a row or a column of a table, its unit, or how it is written."""
    rows: list[Any] = list(csv.reader(io.StringIO(path.read_bytes().decode(errors="replace").replace("\0", ""))))
    rows = [row for row in rows if row] or [[""]]
    kind = chance.choice(("cell", "cell", "text", "row", "column", "scale", "short", "long", "semicolons", "mark"))
    turned = kind in ("column", "scale")
    if turned:
        rows = [list(column) for column in zip_longest(*rows, fillvalue="")]
    place, what = chance.randrange(len(rows)), kind
    row = rows[place]
    if kind in ("row", "column"):
        what = f"{kind}: {change(rows, place, chance)}"
    elif kind == "text":
        what = f"{kind}: {change(row, chance.randrange(len(row)), chance)}"
    elif kind == "cell":
        row[chance.randrange(len(row))] = chance.choice(CELLS)
    elif kind == "scale":
        factor = 10.0 ** chance.choice((-300, -9, -6, -3, 3, 6, 9, 12, 290))
        for index, cell in enumerate(row):
            with suppress(ValueError):
                row[index] = repr(float(cell) * factor)
    elif kind == "short":
        del row[chance.randrange(len(row)) :]
    elif kind == "long":
        row += ["1"] * chance.choice((1, 100))
    lists = [row if isinstance(row, list) else [row] for row in rows]
    stream = io.StringIO()
    writer = csv.writer(stream, delimiter=";" if kind == "semicolons" else ",")
    writer.writerows(zip_longest(*lists, fillvalue="") if turned else lists)
    text = ("\ufeff\ufeff" if kind == "mark" else "") + stream.getvalue()
    path.write_bytes(text.encode(errors="replace"))
    return what


def _code(path: Path, chance: random.Random) -> str:
    lines = path.read_text(errors="replace").splitlines() or [""]
    place = chance.randrange(len(lines))
    kind = chance.choice(("insert", "insert", "replace", "drop", "twin", "name", "bytes"))
    statement = chance.choice(STATEMENTS)
    indent = lines[place][: len(lines[place]) - len(lines[place].lstrip())]
    if kind == "insert":
        lines.insert(place, indent + statement)
    elif kind == "replace":
        lines[place] = indent + statement
    elif kind == "drop":
        del lines[place]
    elif kind == "twin":
        lines[place] = lines[place].translate(TWINS)
    elif kind == "name":
        words = ("None", "3", "()", "lambda *a, **k: None", "object()", "[]", "float('nan')", "-1", "'x'")
        lines.append(f"{chance.choice(('Mine', 'TASK', 'register', 'torch'))} = {chance.choice(words)}")
    path.write_text("\n".join(lines) + "\n")
    if kind == "bytes":
        path.write_bytes(path.read_bytes() + chance.choice((b"\xff\xfe", b"\0", b"# coding: no\n", b"'''")))
    return f"{kind} {statement[:30]}"


def _words(path: Path, chance: random.Random) -> str:
    """Change a text that a user types: parts of it are cut out, doubled, or others."""
    text = path.read_text(errors="replace")
    place = chance.randrange(len(text) + 1)
    end = min(len(text), place + chance.randint(0, 8))
    pieces = (
        "", "/", "//", "..", "../..", "@", ":", "\x00", "\x1b[31m", "\u202e", "%2e%2e", " ", "~", "~nobody/x", "а",
        "-", "\n", "x" * 5000, "C:\\", "hf-hub:", "local-dir:", "file:///", "https://", "*", "\U0001f600", text,
    )  # fmt: skip
    piece = chance.choice(pieces)
    path.write_text(text[:place] + piece + text[end:], errors="replace")
    return f"{piece[:10]!r} at {place}"


def _settings(path: Path, chance: random.Random) -> str:
    """Change TOML: it is written again with its tables in one line each."""
    try:
        value = tomllib.loads(path.read_text())
    except ValueError:  # a change before this one
        return "nothing"
    what = alter(value, chance)
    lines = [f"{json.dumps(key)} = {_toml(inner)}\n" for key, inner in value.items()]
    path.write_text("".join(lines), errors="replace")
    return what


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    return '"none"' if value is None else json.dumps(value, ensure_ascii=False)


_CHANGES: dict[str, Callable[[Path, random.Random], str]] = {
    ".toml": _settings,
    ".json": _document,
    ".csv": _table,
    ".py": _code,
    ".txt": _words,
}

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
    make: Callable[[Path], Path]
    """Writes a good input into a folder, and returns the file to be changed."""
    words: str
    """Words of the command line, with ``{file}`` and ``{folder}``."""


def cases(door: Door, folder: Path, seeds: range) -> Iterator[Outcome]:
    """Yield what becomes of the good input, and then of each change; each case is a fork.

    What the first case imports is loaded for all.
    """
    (folder / "good").mkdir(parents=True)
    good = door.make(folder / "good")
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


PIXEL = 5e-5
"""m"""
MODEL = """import torch


class Mine(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.read = torch.nn.Linear(6, 3)

    def forward(self, x):
        return self.read(x.flatten(3).mean(dim=(1, 3)))
"""
TASK = """from dataclasses import replace

from robotics_bridge import tasks

TASK = replace(tasks.load("in_palm_rotate"), name="foreign")


@tasks.register("foreign")
def foreign():
    return TASK
"""
SCENE = """[array]
whiskers = "C2"
[whisking]
kind = "track"
path = "angles.csv"
layout = "angles"
whiskers = { C2 = "RC2" }
[frames]
first_ms = 10
interval_ms = 10
count = 5
[[scene]]
label = "played"
"""

_SHAPES = bent_shapes() / PIXEL * (1, -1)
_SEEN = np.ones(_SHAPES.shape[:2])
_TRACES = {(frame, 0): shape for frame, shape in enumerate(_SHAPES)}
_FOLLICLES = dict.fromkeys(_TRACES, (0.0, 0.0))


def _whiskerman(folder: Path) -> Path:
    control = np.zeros((12, 3, 3))
    control[:, :2] = _SHAPES[:, [0, 4, 9]].transpose(0, 2, 1)
    return write_whiskerman(folder / "track.tr4", control, control[:, :, 0], np.ones(12, bool))


def _labels(folder: Path) -> Path:
    write_whiskers(folder / "track.whiskers", _TRACES)
    return write_measurements(folder / "labels.csv", dict.fromkeys(_TRACES, 0), _FOLLICLES)


def _angles(folder: Path) -> Path:
    (folder / "scene.toml").write_text(SCENE)
    times = 0.002 * np.arange(60)
    table = np.column_stack([times, 90 + 20 * np.sin(50 * times), 5 * np.cos(50 * times)])
    np.savetxt(
        folder / "angles.csv", table, delimiter=",", header="time_s,RC2.theta_deg,RC2.phi_deg", comments="", fmt="%.6g"
    )
    return folder / "angles.csv"


def _recorded(folder: Path) -> tuple[Any, Any, np.ndarray, Any]:
    hand = hands.load(GALLERY["urdf-mimic"].write(folder, "jaws"))
    probes = hand.layout("low", "tips")
    place, normal = ([getattr(each, name)[each.active] for each in probes.values()] for name in ("position", "normal"))
    links = np.repeat(list(probes), [len(each) for each in place])
    places = TactilePoints(tuple(links.tolist()), np.concatenate(place), np.concatenate(normal))
    closing = np.linspace(0.03, 0.0, 10)[:, None].repeat(len(hand.joints), axis=1)
    return hand, probes, closing, places


def _replayed(folder: Path) -> Path:
    hand, _, closing, places = _recorded(folder)
    names = ["time", *hand.joints, *taxel_names(places.links)]
    table = np.c_[np.arange(10) / 50, closing, np.ones((10, len(places.links)))]
    np.savetxt(folder / "log.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.6g")
    return folder / "log.csv"


def _lerobot(folder: Path) -> Path:
    hand, _, closing, places = _recorded(folder)
    touch = np.zeros((10, len(places.links), 6))
    frames = dict(zip(PARTS, (closing, 0 * closing, closing, touch, np.zeros((10, 6))), strict=True))
    facts = SessionFacts(task="close", fps=50, joints=hand.joints, points=places, robot="jaws", unit="N")
    return write_lerobot(folder / "set", frames, facts) / "meta" / "info.json"


def _settings(folder: Path) -> Path:
    model = written("mine.py", MODEL)(folder)
    return write_json(folder / "models.json", {"mine": {"target": "mine.py:Mine", "hash": content_hash(model)}})


def _graph(folder: Path) -> Path:
    _checkpoint(folder)
    return write_json(folder / "graph.json", GRAPH)


def _run_settings(folder: Path) -> Path:
    _graph(folder)
    encoder = {"model_config_file": "configs/rnn_fdb_converted_modern_gru.json"}
    return write_json(folder / "config.json", {"model": {"encoder": encoder}, "train": {"ssl": "SimCLRLoss"}})


def _packed(folder: Path) -> Path:
    pack(write_laboratory(folder), folder / "lab.zip")
    return folder / "lab.zip"


_FIT = "stimuli fit {file} --most-iterations 1 --links 4 --steps-per-period 20 --json"
_TRACK = f"{_FIT} --whisker mouse:C2 --metres-per-pixel 5e-5 --frame-rate 500"
_REPLAY = "tactile replay {folder}/set --hand {folder}/jaws.urdf --json"
_IMPORT = "--out {folder}/imported --json"

DOORS = (
    Door(
        "contract", lambda folder: export_small(folder).with_name("policy.onnx.json"),
        "policy deploy {stem} --seconds 0.05 --input command=0 --json",
    ),
    Door("calibration log", _log, "tactile calibrate {file} --out {folder}/preset.json --json"),
    Door(
        "fit table", lambda folder: write_ringdown(folder / "ringdown.csv"),
        f"{_FIT} --whisker mouse:C2 --parameters young_modulus",
    ),
    Door("track, points", lambda folder: write_points(folder / "track.csv", bent_shapes()), _TRACK),
    Door("track, DeepLabCut", lambda folder: write_deeplabcut_csv(folder / "track.csv", _SHAPES, _SEEN), _TRACK),
    Door("track, DeepLabCut HDF5", lambda folder: write_deeplabcut_table(folder / "track.h5", _SHAPES, _SEEN), _TRACK),
    Door("track, whisk", lambda folder: write_whiskers(folder / "track.whiskers", _TRACES), _TRACK),
    Door(
        "track, whisk's measurements", _labels,
        f"{_TRACK} --track 0 --identities {{file}}".replace("{file}", "{folder}/track.whiskers", 1),
    ),
    Door("track, WhiskiWrap", lambda folder: write_whiskiwrap(folder / "track.h5", _TRACES, _FOLLICLES), _TRACK),
    Door("track, WhiskerMan", _whiskerman, f"{_TRACK} --track 1"),
    Door("track, angles", _angles, "stimuli show {folder}/scene.toml --json"),
    Door("episode, table", _replayed, "tactile replay {file} --hand {folder}/jaws.urdf --json"),
    Door("episode, LeRobot", _lerobot, _REPLAY),
    Door("episode, places", lambda folder: _lerobot(folder).with_name("tactile.json"), _REPLAY),
    Door(
        "episode, frames", lambda folder: _lerobot(folder).parents[1] / "data" / "chunk-000" / "file-000.parquet",
        _REPLAY,
    ),
    Door("models add, file", written("mine.py", MODEL), "models add {file}:Mine --name mine --json"),
    Door("models add, settings", _settings, "models show mine --json"),
    Door("models import", _checkpoint, f"models import {{file}} --architecture zhuang-gru-small {_IMPORT}"),
    Door(
        "models import, graph", _graph,
        f"models import {{folder}}/best.ckpt --architecture zhuang-gru-small --config {{file}} {_IMPORT}",
    ),
    Door(
        "models import, settings", _run_settings,
        f"models import {{folder}}/best.ckpt --architecture zhuang-gru-small --config {{file}} {_IMPORT}",
    ),
    Door(
        "task file", written("task.py", TASK),
        "policy evaluate foreign --task-file {file} --envs 1 --episodes 1 --seeds 1 --change episode=0.2 --json",
    ),
    Door("benchmark", write_laboratory, "benchmark check {file} --json"),
    Door("benchmark, packed", _packed, "benchmark check {file} --json"),
)  # fmt: skip


STRUCTURES = (
    "contract", "student, configuration", "student, weights", "published settings, YAML", "network, JSON", "batch file",
    "sweep of students", "probe layout", "scene", "result record", "site manifest", "change text", "selection text",
    "plan", "hub name",
)  # fmt: skip
"""Surfaces whose readers are quick."""


@pytest.mark.parametrize(
    "surface", [pytest.param(surface, id=surface.name) for surface in SURFACES if surface.name in STRUCTURES]
)
def test_another_structure_is_refused_or_sound(surface, tmp_path):
    good = surface.make(tmp_path)
    outcomes = [attempt(surface, good, seed, restructure) for seed in range(12)]
    assert [outcome for outcome in outcomes if outcome.kind not in ("refused", "accepted")] == []


def test_changes_are_those_of_their_seed(tmp_path):
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text('{"one": [1, 2.5, "x"], "two": {"three": null}}')
    pairs = [(restructure(tmp_path / "a.json", seed), restructure(tmp_path / "b.json", seed)) for seed in range(20)]
    assert all(left == right for left, right in pairs)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("door", [pytest.param(door.name, id=door.name) for door in DOORS])
def test_commands_refuse_what_was_changed_in_one_sentence(door, tmp_path):
    words = [sys.executable, "-m", __name__, str(tmp_path), door, "--cases", "40"]
    printed = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True).stdout
    whole, *verdicts = map(json.loads, printed.splitlines())
    assert whole["kind"] == "accepted", whole
    assert len(verdicts) == 40
    assert [verdict for verdict in verdicts if verdict["kind"] in FAILURES] == []


def test_each_kind_of_failure_is_seen(tmp_path, monkeypatch):
    def verdict(work):
        monkeypatch.setattr("brainbench.cli.main", lambda: sys.stdout.write(json.dumps(work(Path(sys.argv[1])))))
        with tempfile.TemporaryDirectory(dir=tmp_path) as folder:
            (only,) = cases(Door("tried", _log, "{file}"), Path(folder), range(0))
        return only.kind

    assert verdict(lambda path: 1.0) == "accepted"
    assert verdict(lambda path: float("nan")) == "silent"
    assert verdict(lambda path: int("x")) == "traceback"
    assert verdict(lambda path: os.kill(os.getpid(), signal.SIGKILL)) == "crash"
    assert verdict(lambda path: (path.parent / "../../etc/passwd").read_text(encoding="utf-8")) == "leaked"
    assert verdict(lambda path: sys.exit("No.")) == "refused"
    assert verdict(lambda path: [(path.parent / "half").touch(), sys.exit("No.")]) == "half-written"


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
