"""Commands killed at any instant, given again, end with the bytes of an unbroken run and leave nothing else.

``python -m tests.core.test_kills FOLDER NAME… --kills N`` loads the modules of a command once; every run is a fork, so
that a kill hits the work and not the loading. It prints one JSON object for each; without arguments it prints the
names.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import torch

from brainbench.core.errors import BrainbenchError
from tests.factories.forks import fork
from tests.factories.sweep_batches import files_of

ROOT = Path(__file__).parents[2]
PAUSE = 0.2
"""Seconds for which a stopped command stands still."""
TIMES = ("time", "seconds", "sweeps_per_second", "collect_s", "learn_s")
"""Fields of JSON files that hold times and durations; all else is compared by its bytes."""


@dataclass(frozen=True)
class KillJob:
    """A command with small inputs."""

    name: str
    kills: int
    """Kills of the slow test."""
    run: Callable[[Path, Path], None]
    """Does the work, from a folder of inputs into a folder."""
    prepare: Callable[[Path], None] = lambda inputs: None
    """Makes the inputs."""
    modules: tuple[str, ...] = ()
    """Loaded before the first run."""
    resumes: bool = False
    """True where finished parts are kept; else all is done again."""
    part: str = ""
    """Pattern of the first finished part, where it comes late: every second kill falls after it."""
    apart: tuple[str, ...] = ()
    """Names of files that hold times, which are only there or not."""

    def do(self, inputs: Path, out: Path) -> None:
        """Do the work; the process ends with the sentence of an error, as the command line does."""
        try:
            self.run(inputs, out)
        except BrainbenchError as error:
            sys.exit(str(error))


@dataclass
class Outcome:
    """What became of a command that was killed."""

    name: str
    seconds: float = 0.0
    """Duration of an unbroken run after loading."""
    kills: int = 0
    """Kills that met a running process."""
    resumed: int = 0
    repeated: int = 0
    different: list[str] = field(default_factory=list)
    """Files that differ from those of an unbroken run, after the repetition."""
    left: list[str] = field(default_factory=list)
    """Files that an unbroken run does not leave."""
    failed: list[str] = field(default_factory=list)
    """Last lines of repetitions that failed."""
    pairs: int = 0
    together: list[str] = field(default_factory=list)
    """What was wrong after two runs at once."""


def content(folder: Path, job: KillJob) -> dict[str, Any]:
    """Return the files of a folder, by name: bytes, or JSON without its times."""
    found: dict[str, Any] = {}
    for name, data in files_of(folder).items():
        if "events.out.tfevents" in name:
            # TensorBoard names its files by time and process, and begins a new one in every run.
            continue
        if name.endswith((".json", ".jsonl")):
            lines = data.splitlines() if name.endswith(".jsonl") else [data]
            found[name] = [_without_times(json.loads(line, parse_constant=str)) for line in lines]
        else:
            found[name] = b"" if any(part in name for part in job.apart) else data
    return found


def measure(job: KillJob, folder: Path, kills: int, signals: Sequence[str] = ("KILL",), pairs: int = 1) -> Outcome:
    """Send a command so many signals in turn, at times drawn with a fixed seed, and repeat what they end each time.

    One that was stopped (``STOP``) is let go on. So many ``pairs`` of runs share a folder.
    """
    for module in job.modules:
        import_module(module)
    inputs, whole = folder / "inputs", folder / "whole"
    inputs.mkdir(parents=True)
    _finish(fork(lambda: job.prepare(inputs), folder / "prepare.log"), folder / "prepare.log")
    # The first run may compile what later ones find in the machine's own caches.
    _finish(fork(partial(job.do, inputs, folder / "first"), folder / "first.log"), folder / "first.log")
    begin = time.monotonic()
    child = fork(partial(job.do, inputs, whole), folder / "whole.log")
    _wait_for_part(whole, job.part)
    first = _work(child)
    work = _finish(child, folder / "whole.log")
    outcome = Outcome(job.name, time.monotonic() - begin)
    expected = content(whole, job)
    outcome.different += [f"two unbroken runs: {name}" for name in _differ(content(folder / "first", job), expected)]
    draw = random.Random(f"{job.name} {kills}")
    for place in range(5 * kills):
        if outcome.kills == kills:
            break
        out, log = folder / str(place), folder / f"{place}.log"
        child = fork(partial(job.do, inputs, out), log)
        late = bool(job.part) and place % 2 == 1
        if late:
            _wait_for_part(out, job.part)
        _let_work(child, draw.uniform(first * late, work))
        sent = signals[outcome.kills % len(signals)]
        os.kill(child, signal.Signals[f"SIG{sent}"])
        if sent == "STOP":
            time.sleep(PAUSE)
            os.kill(child, signal.SIGCONT)
        status = os.waitpid(child, 0)[1]
        before = content(out, job) if out.is_dir() else {}
        # A training that SIGTERM asks to stop ends well, and early.
        met = os.WIFSIGNALED(status) or (status == 0) == (sent == "STOP") or before != expected
        outcome.kills += met
        there = out.is_dir() and any(not Path(name).name.startswith(".") for name in files_of(out))
        outcome.resumed += met and there and job.resumes
        outcome.repeated += met and not (there and job.resumes)
        status = os.waitpid(fork(partial(job.do, inputs, out), log), 0)[1]
        now = content(out, job) if out.is_dir() else {}
        # What was finished before the kill may refuse to be written once more.
        if status and now != expected:
            outcome.failed.append(log.read_text(errors="replace").strip().splitlines()[-1:][0])
        outcome.left += sorted(now.keys() - expected.keys())
        outcome.different += [name for name in _differ(now, expected) if name in expected]
        shutil.rmtree(out, ignore_errors=True)
    for _ in range(pairs):
        _run_together(job, inputs, folder, expected, outcome)
    return outcome


def _wait_for_part(out: Path, part: str) -> None:
    """Wait until a run has finished its first part."""
    while part and not any(out.glob(part)):
        time.sleep(0.01)


def _work(child: int) -> float:
    """Return the processor time [s] that a process has taken, which a busy machine does not stretch."""
    values = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
    return (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")


def _let_work(child: int, seconds: float) -> None:
    """Wait until a process has worked so long, or has ended."""
    while _work(child) < seconds and not os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT):
        time.sleep(0.002)


def _run_together(job: KillJob, inputs: Path, folder: Path, expected: dict[str, Any], outcome: Outcome) -> None:
    """Run a command twice at once into one folder: both finish, or one is refused in a sentence."""
    out, logs = folder / "together", [folder / f"together-{place}.log" for place in range(2)]
    children = [fork(partial(job.do, inputs, out), log) for log in logs]
    failed = [log.read_text() for child, log in zip(children, logs, strict=True) if os.waitpid(child, 0)[1]]
    if len(failed) > 1:
        outcome.together.append("none finished")
    outcome.together += [text.strip()[-300:] for text in failed if "Traceback" in text]
    outcome.together += _differ(content(out, job), expected)
    outcome.pairs += 1
    shutil.rmtree(out)


def _finish(child: int, log: Path) -> float:
    """Wait for an unbroken run, and return its processor time [s] without that of its own processes."""
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    work = _work(child)
    if os.waitpid(child, 0)[1]:
        raise SystemExit(f"An unbroken run failed: {log.read_text(errors='replace')[-2000:]}")
    return work


def _differ(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))


def _without_times(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_times(item) for key, item in value.items() if key not in TIMES}
    return [_without_times(item) for item in value] if isinstance(value, list) else value


def _command(words: str, cache: str = "") -> Callable[[Path, Path], None]:
    """Return what runs a command; ``{inputs}`` and ``{out}`` stand for its folders, also in that of its cache."""

    def run(inputs: Path, out: Path) -> None:
        from brainbench.cli import main

        if cache:
            os.environ["BRAINBENCH_CACHE"] = cache.format(out=out)
        sys.argv = ["brainbench", *(word.format(inputs=inputs, out=out) for word in shlex.split(words))]
        main()

    return run


def _factory(module: str, name: str) -> Callable[[Path], None]:
    """Return a function of the factories, which is imported where it is called."""
    return lambda inputs: getattr(import_module(f"tests.factories.{module}"), name)(inputs)  # noqa: PLW0108 - later


def _generate(inputs: Path, out: Path) -> None:
    from brainbench.stimuli.sweeps.generation import generate
    from tests.factories.sweep_batches import killed_plan

    generate(killed_plan(), out, workers=1)


def _train(inputs: Path, out: Path) -> None:
    from brainbench.models.training.config import TrainingConfig
    from brainbench.models.training.trainer import train
    from tests.factories.training_sweeps import tiny

    options: dict[str, Any] = {"epochs": 3, "batch_size": 8, "optimizer": "adamw", "learning_rate": 1e-3}
    options |= {"checkpoint_seconds": 1e-9, "augmentation": "physical", "precision": "float32"}
    train(TrainingConfig.published("zhuang-small", "supervised", **options), tiny(), out=out, device="cpu")


def _train_policy(inputs: Path, out: Path) -> None:
    from robotics_bridge import tasks
    from robotics_bridge.policies.training.teacher import TeacherRun, train
    from robotics_bridge.tasks.settings import TeacherSettings

    small = TeacherSettings(num_envs=2, steps_per_env=4, iterations=12, epochs=1, minibatches=1, hidden=(8,))
    env = tasks.make(tasks.load("in_palm_rotate"), num_envs=2, threads=1, seed=0)
    train(env, out, TeacherRun(iterations=12, save_every=1), settings=small)


def _write_records(inputs: Path) -> None:
    from leaderboards import write_record
    from tests.factories.records import make_record

    for index in range(24):
        write_record(make_record(f"net-{index}", 0.3 + 0.02 * index), inputs / "records")


def _write_recordings(inputs: Path) -> None:
    import numpy as np

    from brainbench.datasets import write_recordings
    from tests.factories.recordings import LABELS, make_simple_session

    columns = {"stimulus": np.resize(np.array(LABELS), 48)}
    write_recordings(inputs / "rec.h5", make_simple_session(subject="m", trials=48, units=8, columns=columns))


def _write_checkpoint(inputs: Path) -> None:
    from brainbench.models.registry import load_model
    from tests.factories.published_files import lightning_state

    state = lightning_state(load_model("s4-small", seed=5, classes=9))
    torch.save({"state_dict": state, "epoch": 6, "global_step": 50}, inputs / "x.ckpt")


def _write_tree(inputs: Path) -> None:
    from tests.factories.published_files import write_tree

    write_tree(inputs / "tree", sizes=(40, 20, 20))


def _write_set(inputs: Path) -> None:
    _write_tree(inputs)
    _command("stimuli convert {inputs}/tree/train {inputs}/set.h5 --json")(inputs, inputs)


def _make_benchmark(inputs: Path, out: Path) -> None:
    for path in (inputs / "eight.h5", *(inputs / "data").iterdir()):
        place = out / path.relative_to(inputs)
        place.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            place.hardlink_to(path)
    words = "--conditions trials:texture --stimuli {out}/eight.h5 --citation Doe --out {out}/lab.toml --json"
    _command(f"benchmark make -r {{out}}/data {words}", _BESIDE)(inputs, out)


_BESIDE = "{out.parent}/cache-{out.name}"
_CLI = ("brainbench.cli",)
_TRAINER = ("brainbench.models.training.trainer", "tests.factories.training_sweeps")
_SCORE = ("brainbench.scoring.scores", "brainbench.stimuli", "brainbench.models.zoo", "brainbench.datasets", "warp")
_BENCHMARK = ("brainbench.benchmarks.commands", "brainbench.scoring.scores", "brainbench.datasets", "h5py")
_TEACHER = ("mujoco", "robotics_bridge.envs", "robotics_bridge.policies.training.teacher", "rsl_rl")

JOBS = (
    KillJob(
        "stimulus generation", 12, _generate, modules=("brainbench.stimuli.sweeps.generation", "mujoco"), resumes=True
    ),
    KillJob("train", 12, _train, modules=_TRAINER, resumes=True),
    KillJob("policy train", 10, _train_policy, modules=_TEACHER, resumes=True, part="state.safetensors"),
    KillJob(
        "leaderboard add", 16, _command("leaderboard add {inputs}/records --to {out}"),
        _write_records, (*_CLI, "leaderboards"), resumes=True,
    ),
    KillJob(
        "leaderboard build", 16, _command("leaderboard build {inputs}/records --out {out}"),
        _write_records, (*_CLI, "leaderboards.site"),
    ),
    KillJob(
        "score, empty cache", 12,
        _command(
            "score zhuang-small -r {inputs}/rec.h5 --conditions trials:stimulus --stimuli rodgers --whiskers C2 "
            "--fidelity fast --out {out}/records --json", "{out}/cache",
        ),
        _write_recordings, (*_CLI, *_SCORE), resumes=True, apart=(".html",),
    ),
    KillJob(
        "models export", 8, _command("export zhuang-small --format torch --out {out}/step.pt2 --json"),
        modules=(*_CLI, "torch.export", "brainbench.models.export"),
    ),
    KillJob(
        "stimuli convert, sweeps", 12, _command("stimuli convert {inputs}/tree {out} --json", _BESIDE),
        _write_tree, (*_CLI, "h5py", "brainbench.stimuli"), resumes=True,
    ),
    KillJob(
        "stimuli convert, a run", 8, _command("stimuli convert {inputs}/set.h5 {out}/run -s 00000000 --json"),
        _write_set, (*_CLI, "h5netcdf", "brainbench.stimuli"),
    ),
    KillJob("benchmark make", 8, _make_benchmark, _factory("scored_files", "write_study"), (*_CLI, *_BENCHMARK)),
    KillJob(
        "benchmark pack", 8, _command("benchmark pack {inputs}/lab.toml --out {out}/lab.zip --json"),
        _factory("scored_files", "write_laboratory"), (*_CLI, *_BENCHMARK),
    ),
    KillJob(
        "models import", 12, _command("models import {inputs}/x.ckpt --architecture s4-small --out {out} --json"),
        _write_checkpoint, (*_CLI, "brainbench.published.checkpoint_import"),
    ),
)  # fmt: skip


def _killed(name: str, folder: Path, *words: str) -> dict[str, Any]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.core.test_kills", str(folder / "work"), name, *words]
    ended = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(ended.stdout.splitlines()[-1])


def _check(found: dict[str, Any]) -> None:
    assert {name: found[name] for name in ("different", "left", "failed", "together")} == {
        "different": [], "left": [], "failed": [], "together": []
    }  # fmt: skip


@pytest.mark.slow
def test_a_killed_addition_is_repeated(tmp_path):
    found = _killed("leaderboard add", tmp_path, "--kills", "1")
    _check(found)
    assert found["kills"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["leaderboard add", "leaderboard build", "score, empty cache"])
def test_commands_that_are_ended_stopped_or_run_in_pairs_lose_nothing(name, tmp_path):
    found = _killed(name, tmp_path, "--kills", "27", "--signals", "TERM,HUP,STOP", "--pairs", "9")
    _check(found)
    assert (found["kills"], found["pairs"]) == (27, 9)


@pytest.mark.slow
@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.name)
def test_commands_killed_at_many_instants_end_with_the_bytes_of_unbroken_ones(job, tmp_path):
    if job.name == "policy train":
        pytest.importorskip("rsl_rl")
    found = _killed(job.name, tmp_path)
    _check(found)
    assert found["kills"] == job.kills


def main() -> None:
    if not sys.argv[1:]:
        sys.stdout.write("".join(f"{job.name}\n" for job in JOBS))
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="+", choices=[job.name for job in JOBS], metavar="NAME")
    parser.add_argument("--kills", type=int)
    parser.add_argument("--signals", default="KILL", help="sent in turn: KILL,TERM,HUP,STOP")
    parser.add_argument("--pairs", type=int, default=1)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for job in JOBS:
        if job.name in chosen.names:
            kills = job.kills if chosen.kills is None else chosen.kills
            folder = chosen.folder / job.name
            outcome = measure(job, folder, kills, chosen.signals.split(","), chosen.pairs)
            sys.stdout.write(json.dumps(asdict(outcome)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
