"""Campaigns that need a GPU: what is open, and each of them in pieces that go on where the last one stopped.

    python -m benchmarks.policies.jobs                          list what is open
    python -m benchmarks.policies.jobs try [NAME …]             here: every command, with four environments and one step
    python -m benchmarks.policies.jobs check                    on the GPU machine: what it lacks, in a few seconds
    python -m benchmarks.policies.jobs run NAME … [--minutes 8.5]   there: one piece of each
    python -m benchmarks.policies.jobs keep NAME FOLDER         here: keep what came back, for the next piece

A call of the GPU machine lasts 10 minutes at most, a session 30. A job works in ``/tmp/run/NAME``, which the calls of a
session share; each call also leaves it in ``$OUT`` as ``NAME.tar.gz.00``, …, without the weights of what is finished.
The next session goes on from there: ``keep`` puts the parts into ``.run/NAME`` (ignored by git), the call names
``.run`` in ``carry``, and ``run`` unpacks it. Teachers and students then go on exactly, with environments and random
numbers (37 MB for 8,192 environments). The tree has to stay below 64 MiB with ``.run``: make the calls from a
commit without ``leaderboards/*/records``, ``leaderboards/results`` and ``docs/images``.

Wheels that policies need on that machine: ``../shared/device/pack.sh`` with :data:`PACKED` (rsl-rl-lib and tensordict
are the script's own). There is no gymnasium; commands log with ``--loggers csv``. ``run`` checks first, so that no
minute goes into a job that ends for want of a package.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.files import read_json

FILE = Path(__file__).with_name("jobs.toml")
PACKED = "msgspec h5netcdf manifold3d platformdirs gitpython gitdb smmap pyvers importlib_metadata orjson"
"""Wheels beside those of ``pack.sh``, as its arguments. Of TensorBoard, which rsl-rl-lib 5.5.1 imports at once, the
machine had its own; else also pack tensorboard, protobuf and absl-py (6 MB)."""
NEEDED = (
    "torch", "warp", "mujoco", "mujoco_warp", "tensordict", "rsl_rl.algorithms", "rsl_rl.models", "typer", "rich",
    "msgspec", "safetensors", "scipy", "xarray", "h5netcdf", "manifold3d", "platformdirs", "trimesh",
    "robotics_bridge.policies.training.teacher", "robotics_bridge.policies.training.students", "brainbench.cli",
)  # fmt: skip
"""Modules that the commands import, at once or late."""
KEYS = {"name", "why", "minutes", "command", "each", "stop_at", "then", "result"}
CARRIED, WORK = Path(".run"), Path("/tmp/run")
PIECE = 8.5
"""Minutes of a call; what it leaves needs the rest of its ten."""
_PART, _MOST = 15 << 20, 4
"""Bytes of a file that comes back, and so many of them."""
SMALL = (
    (r"--device cuda", "--device cpu"),
    (r"--minutes \d+", "--minutes 0.05"),
    (r"--envs \d+", "--envs 4"),
    (r"--(iterations|stop-at) \d+", r"--\1 1"),
    (r"--episodes \d+", "--episodes 4"),
    (r"--epochs \d+", "--epochs 1"),
    (r"procedural:\d+", "brick:2 bowl:2"),
    (r"--seconds [\d.]+", "--seconds 0.5"),
    (r"--precision bf16", ""),
    (r"--(untrained|reservoirs|draws|seeds|together) \d+", r"--\1 1"),
    (r"--shard (\d)/\d+", r"--shard \1/40"),
    (r"(policy probe .*)--envs 4", r"\1--envs 20"),
)
"""What makes a command small enough for a processor."""


def read_jobs(path: Path = FILE) -> list[dict[str, Any]]:
    """Return the jobs of a list, those with ``each`` once for each value, with a name of its own and a command."""
    with path.open("rb") as stream:
        jobs = [one for job in tomllib.load(stream)["jobs"] for one in _each(job)]
    names = [job["name"] for job in jobs]
    for job in jobs:
        if odd := sorted(set(job) - KEYS):
            raise ValueError(f"Job {job['name']!r} has the key {odd[0]!r}; allowed: {sorted(KEYS)}.")
        if not job["command"] or names.count(job["name"]) > 1 or not job["minutes"] > 0:
            raise ValueError(f"Job {job['name']!r} needs a name of its own, a command and minutes above 0.")
    return jobs


def _each(job: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for value in job.get("each", [None]):
        if value is None:
            yield job
        else:
            texts = {key: job[key].replace("{each}", str(value)) for key in ("command", "then") if key in job}
            yield {**job, **texts, "name": f"{job['name']}-{str(value).partition('/')[0]}"}


def find(name: str) -> dict[str, Any]:
    """Return a job; raise UsageError for an unknown name."""
    jobs = {job["name"]: job for job in read_jobs()}
    if name not in jobs:
        raise unknown_name("job", name, jobs)
    return jobs[name]


def shell(command: str, run: Path, minutes: float) -> int:
    """Run a command with ``$RUN``, ``$MINUTES`` and ``$END`` set and return its status; it is ended 30 s later."""
    # The GPU machine has no command `brainbench`.
    words = re.sub(r"\b(?:(brainbench) (?=policy |stimuli |train )|python -m )",
                   lambda found: f"{sys.executable} -m {'brainbench ' * bool(found[1])}", command)  # fmt: skip
    given = {**os.environ, "RUN": str(run), "MINUTES": f"{minutes:g}", "END": str(int(time.time() + 60 * minutes))}
    process = subprocess.Popen(["bash", "-ec", words], env=given, start_new_session=True)
    try:
        return process.wait(60 * minutes + 30)
    except subprocess.TimeoutExpired:
        # What was saved last is where the next piece goes on.
        os.killpg(process.pid, 15)
        return process.wait()


def check_machine(needed: Iterable[str] = NEEDED) -> None:
    """Check that this machine has a GPU and all packages of the jobs.

    Raises:
        UsageError: something is missing.
    """
    missing = []
    for name in needed:
        try:
            importlib.import_module(name)
        except ImportError as error:
            missing.append(str(error.name or name).partition(".")[0])
    if missing:
        names = ", ".join(dict.fromkeys(missing))
        raise UsageError(f"This machine lacks {names}; pack it here: ../shared/device/pack.sh {PACKED}, and that.")
    import torch

    if not torch.cuda.is_available():
        raise UsageError("This machine has no GPU; `jobs try` runs the commands small on a processor.")


def run_piece(name: str, minutes: float) -> int:
    """Go on with a job for so long, and leave its folder in ``$OUT``."""
    job, folder = find(name), WORK / name
    if not folder.is_dir() and (CARRIED / name).is_dir():
        unpack(CARRIED / name, folder)
    folder.mkdir(parents=True, exist_ok=True)
    status = shell(job["command"], folder, minutes)
    print(
        f"{name}: status {status}; {', '.join(pack(folder, Path(os.environ['OUT']), name, job.get('stop_at')))}",
        flush=True,
    )
    return status


def pack(folder: Path, out: Path, name: str, stop_at: int | None) -> list[str]:
    """Write a folder into parts ``NAME.tar.gz.00``, … and return their names.

    Of the models of a run the newest goes, of a student that was evaluated after ``stop_at`` iterations only numbers.

    Raises:
        UsageError: it is too large to come back.
    """
    packed = out / f"{name}.tar.gz"
    with tarfile.open(packed, "w:gz", compresslevel=1) as file:
        for path in sorted(path for path in folder.rglob("*") if path.is_file() and not _superseded(path, stop_at)):
            file.add(path, path.relative_to(folder))
    data = packed.read_bytes()
    packed.unlink()
    count = math.ceil(len(data) / _PART)
    for number in range(count):
        out.joinpath(f"{packed.name}.{number:02d}").write_bytes(data[number * _PART : (number + 1) * _PART])
    if count > _MOST:
        raise UsageError(
            f"{name!r} leaves {len(data) >> 20} MiB, and {_MOST * _PART >> 20} come back; run fewer at once."
        )
    return [f"{packed.name}.{number:02d}" for number in range(count)]


def _superseded(path: Path, stop_at: int | None) -> bool:
    if found := re.fullmatch(r"model_(\d+)\.safetensors", path.name):
        others = (re.fullmatch(r"model_(\d+)\.safetensors", other.name) for other in path.parent.iterdir())
        return int(found[1]) < max(int(other[1]) for other in others if other)
    evaluation = path.with_name("evaluation.json")
    if stop_at is None or path.suffix != ".safetensors" or not evaluation.is_file():
        return False
    return all(one["iterations"] >= stop_at for one in read_json(evaluation))


def unpack(parts: Path, folder: Path) -> None:
    """Lay out a folder that :func:`pack` wrote."""
    whole = folder.with_suffix(".tar.gz")
    whole.parent.mkdir(parents=True, exist_ok=True)
    whole.write_bytes(b"".join(part.read_bytes() for part in sorted(parts.glob("*.tar.gz.*"))))
    with tarfile.open(whole) as file:
        file.extractall(folder, filter="data")
    whole.unlink()


def keep(name: str, came_back: Path) -> None:
    """Put the parts of a job that came back where the next session's calls carry them from."""
    find(name)
    parts, to = sorted(came_back.glob(f"{name}.tar.gz.*")), CARRIED / name
    if not parts:
        raise UsageError(f"{str(came_back)!r} holds no {name}.tar.gz.00; give the folder of the files that came back.")
    exclude = Path(".git/info/exclude")
    if f"/{CARRIED}/" not in exclude.read_text(encoding="utf-8").splitlines():
        with exclude.open("a", encoding="utf-8") as file:
            file.write(f"/{CARRIED}/\n")
    shutil.rmtree(to, ignore_errors=True)
    to.mkdir(parents=True)
    for part in parts:
        shutil.copyfile(part, to / part.name)


def try_all(names: list[str]) -> int:
    """Run the commands of open jobs small on a processor, and say which fail."""
    failed = []
    for job in (job for job in read_jobs() if not job["result"] and (not names or job["name"] in names)):
        command = job["command"]
        for pattern, small in SMALL:
            command = re.sub(pattern, small, command)
        folder = Path("/tmp/try") / job["name"]
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        print(f"== {job['name']}: {command}", flush=True)
        if shell(command, folder, 0.05 if "$MINUTES" in command else 8):
            failed.append(job["name"])
    print(f"failed: {', '.join(failed) or 'none'}")
    return bool(failed)


def list_jobs() -> None:
    """Print all jobs and the minutes that are open."""
    jobs = read_jobs()
    for job in jobs:
        pieces = math.ceil(job["minutes"] / PIECE)
        state = (
            f"done: {job['result']}" if job["result"] else f"open, {job['minutes']:g} device minutes, {pieces} calls"
        )
        print(f"{job['name']} ({state})\n  {job['why']}\n  {job['command']}")
    print(f"{sum(job['minutes'] for job in jobs if not job['result']):g} device minutes are open.")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="what")
    parts.add_parser("check")
    tried = parts.add_parser("try")
    tried.add_argument("names", nargs="*")
    running = parts.add_parser("run")
    running.add_argument("names", nargs="+")
    running.add_argument("--minutes", type=float, default=PIECE, help="of all of them together")
    keeping = parts.add_parser("keep")
    keeping.add_argument("name")
    keeping.add_argument("folder", type=Path)
    options = parser.parse_args()
    if options.what == "try":
        return try_all(options.names)
    if options.what in ("check", "run"):
        check_machine()
    if options.what == "check":
        print("nothing is missing")
        return 0
    if options.what == "run":
        return max(run_piece(name, options.minutes / len(options.names)) for name in options.names)
    if options.what == "keep":
        keep(options.name, options.folder)
        return 0
    list_jobs()
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except UsageError as error:
        raise SystemExit(str(error)) from None
