"""Train the models that come with brainbench, on every GPU there is, several at a time on each.

    PYTHONPATH=. python benchmarks/train_zoo.py --minutes 9 --out $OUT          # makes the data, trains, scores, packs
    PYTHONPATH=. python benchmarks/train_zoo.py --install FOLDER_OF_TARS        # puts the small ones into the package

One process per GPU; in it one thread and stream per job, whole training steps as CUDA graphs (``zoo_loop.py``), all
sweeps in the GPU's memory. Jobs are in ``zoo_jobs.py``, the most valuable first; each is claimed by one process. At
the deadline unfinished jobs save their state. What comes back: ``results.jsonl``, ``curves.jsonl`` and up to six tar
files with checkpoints of small networks, result records and states; given with ``--resume`` they are gone on with.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from zoo_jobs import Job, all_jobs

_log = logging.getLogger("train_zoo")
ROOT = Path(__file__).resolve().parent.parent
CLOSING = 100.0
"""Seconds before the end when training stops; then the last networks are evaluated, scored and packed."""
ROLES = ("small", "full", "untrained")
"""A process each per GPU: Python's threads would wait for one another's compilers and probes."""
TAR_BYTES, TARS = 15 * 2**20, 4
"""What may come back: files of at most 16 MiB, 64 MiB in all."""


def parser() -> argparse.ArgumentParser:
    told = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    told.add_argument("--out", type=Path, default=Path("zoo-out"), help="where results are packed")
    told.add_argument("--work", type=Path, default=Path("/tmp/zoo-work"), help="folders of the jobs")
    told.add_argument("--data", type=Path, help="a data set that is there already")
    told.add_argument("--recipe", default="thesis-high")
    told.add_argument("--objects", default="procedural-24:10")
    told.add_argument("--limit", type=int, help="sweeps per object; all of them if not given")
    told.add_argument("--links", type=int, default=12)
    told.add_argument("--step", type=float, default=1e-3)
    told.add_argument("--minutes", type=float, default=9.4, help="from start to end, packing included")
    told.add_argument("--end", type=float, help="the same as seconds since 1970: $(($(date +%%s) + 570)) of the shell")
    told.add_argument("--last", action="store_true", help="no later call will go on: end every schedule in this one")
    told.add_argument("--small-seconds", type=float, default=130.0, help="training time of a small job")
    told.add_argument("--full-seconds", type=float, default=200.0, help="training time of a full-size job")
    told.add_argument("--places", type=int, default=4, help="small jobs at a time on a GPU, beside a full-size one")
    told.add_argument("--precision", default="bf16")
    told.add_argument("--epochs", type=int, help="epochs at most, whatever the job says")
    told.add_argument("--only", help="substring of the names of jobs to train")
    told.add_argument("--jobs", type=int, help="only so many jobs")
    told.add_argument("--resume", type=Path, help="folder with the tar files of an earlier call")
    told.add_argument("--no-score", action="store_true")
    told.add_argument("--device", default=None, help="cpu for a trial run; all GPUs if not given")
    told.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    told.add_argument("--role", help=argparse.SUPPRESS)
    told.add_argument("--score", type=Path, help=argparse.SUPPRESS)
    told.add_argument("--shards", help=argparse.SUPPRESS)
    told.add_argument("--until", type=float, help=argparse.SUPPRESS)
    told.add_argument("--install", type=Path, help="unpack tar files and put trained models into the package")
    return told


def main() -> None:
    args = parser().parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if args.install:
        install(args.install)
    elif args.score:
        score(args.score)
    elif args.shards:
        make_shards(args)
    elif args.worker is not None:
        Worker(args).run()
    else:
        campaign(args)


def campaign(args: argparse.Namespace) -> None:
    """Make the data, start a process per GPU, wait, pack."""
    started = time.time()
    end = args.end or started + 60 * args.minutes
    args.until = end - CLOSING
    gpus = 0 if args.device == "cpu" else count_gpus()
    args.work.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(args.work / "claims", ignore_errors=True)
    (args.work / "claims").mkdir()
    if args.resume:
        unpack(args.resume, args.work)
    scoring = (
        None if args.no_score else subprocess.Popen(command(args, score=args.work / "warm-up"), env=environment(None))
    )
    if args.data is None:
        args.data = make_data(args, gpus)
        _log.info("data after %.0f s", time.time() - started)
    # Sessions of their own, so that the end ends what they started too.
    workers = [
        subprocess.Popen(
            command(args, worker=index, role=role), env=environment(index if gpus else None), start_new_session=True
        )
        for index in range(max(1, gpus))
        for role in ROLES
    ]
    seen: Any = None
    while any(worker.poll() is None for worker in workers) and time.time() < end - 12:
        time.sleep(5.0)
        # What is done is packed at once: a cut then costs what was running alone.
        if (found := written(args.work)) != seen:
            seen = found
            pack(args.work, args.out)
    for worker in workers:
        if worker.poll() is None:
            _log.warning("a worker is not done at the end and is left behind")
        with contextlib.suppress(ProcessLookupError):
            os.killpg(worker.pid, signal.SIGKILL)
    if scoring is not None and scoring.poll() is None:
        scoring.kill()
    for result in pack(args.work, args.out):
        print(row(result))
    _log.info("everything after %.0f s", time.time() - started)


def written(work: Path) -> list[tuple[str, float]]:
    """Return which results and states there are, and since when."""
    names = ("result.json", "record.json", "state.safetensors")
    paths = sorted(path for name in names for path in (work / "jobs").glob(f"*/{name}"))
    return [(str(path), path.stat().st_mtime) for path in paths]


def count_gpus() -> int:
    """Return how many GPUs there are, without starting CUDA in this process."""
    asked = "import torch; print(torch.cuda.device_count())"
    return int(subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout)


def command(args: argparse.Namespace, **changes: Any) -> list[str]:
    """Return the command line of a process of this campaign."""
    words = [sys.executable, str(Path(__file__).resolve())]
    for name, value in {**vars(args), **changes}.items():
        option = f"--{name.replace('_', '-')}"
        if value is True:
            words.append(option)
        elif value is not None and value is not False:
            words += [option, str(value)]
    return words


def environment(gpu: int | None) -> dict[str, str]:
    """Return the environment of a process that sees one GPU, or none."""
    threads = str(max(1, (os.cpu_count() or 1) // 16))
    return {**os.environ, "OMP_NUM_THREADS": threads, "CUDA_VISIBLE_DEVICES": "" if gpu is None else str(gpu)}


def make_plan(args: argparse.Namespace, gpus: int) -> Any:
    from brainbench.stimuli import Fidelity
    from brainbench.stimuli.collections import resolve_objects
    from brainbench.stimuli.generation.plan import GenerationPlan, Settings
    from brainbench.stimuli.sweeps import GRIDS

    settings = Settings(
        fidelity=Fidelity(links=args.links, time_step=args.step),
        backend="rod",
        device="cuda" if gpus else "cpu",
        limit=args.limit,
        shard_size=3120 if gpus else None,
    )
    return GenerationPlan(args.recipe, GRIDS[args.recipe], resolve_objects([args.objects], surfaces=True), settings)


def make_data(args: argparse.Namespace, gpus: int) -> Path:
    """Generate the sweeps, every GPU its share of the shards; return their folder."""
    from brainbench.files import to_plain, write_json
    from brainbench.stimuli.generation.run import CONFIG, generate

    folder = args.work / "data"
    folder.mkdir(parents=True, exist_ok=True)
    plan = make_plan(args, gpus)
    if gpus > 1:
        write_json(folder / CONFIG, to_plain(plan.config))
        makers = [
            subprocess.Popen(command(args, shards=f"{index}/{gpus}"), env=environment(index)) for index in range(gpus)
        ]
        if any([maker.wait() for maker in makers]):
            _log.error("a process could not make its shards; this one makes them")
    manifest = generate(plan, folder)
    _log.info("%d sweeps, hash %s, %d unstable", manifest["sweeps"], manifest["content_hash"], manifest["unstable"])
    return folder


def make_shards(args: argparse.Namespace) -> None:
    """Make every n-th shard of the data set."""
    from brainbench.stimuli.generation.local import run_here
    from brainbench.stimuli.generation.manifest import is_whole

    index, count = map(int, args.shards.split("/"))
    folder = args.work / "data"
    missing = [task for task in make_plan(args, count).shards[index::count] if not is_whole(folder / task.name, task)]
    if missing:
        run_here(missing, folder, max(1, (os.cpu_count() or 1) // count), lambda done: None)


class Gate:
    """Many threads that launch, or one that records: recording waits for the launching to pause.

    Long work that is not to be interrupted is waited for without pausing the others.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._inside, self._waiting, self._long = 0, False, 0

    @contextlib.contextmanager
    def long(self) -> Iterator[None]:
        with self._changed:
            self._changed.wait_for(lambda: self._inside >= 0 and not self._waiting)
            self._long += 1
        try:
            yield
        finally:
            with self._changed:
                self._long -= 1
                self._changed.notify_all()

    @contextlib.contextmanager
    def shared(self) -> Iterator[None]:
        with self._changed:
            self._changed.wait_for(lambda: self._inside >= 0 and not self._waiting)
            self._inside += 1
        try:
            yield
        finally:
            with self._changed:
                self._inside -= 1
                self._changed.notify_all()

    @contextlib.contextmanager
    def exclusive(self) -> Iterator[None]:
        with self._changed:
            self._changed.wait_for(lambda: self._inside >= 0 and not self._long and not self._waiting)
            self._waiting = True
            self._changed.wait_for(lambda: self._inside == 0)
            self._inside, self._waiting = -1, False
        try:
            yield
        finally:
            with self._changed:
                self._inside = 0
                self._changed.notify_all()


class Worker:
    """The jobs of one GPU."""

    def __init__(self, args: argparse.Namespace) -> None:
        import torch

        self.args = args
        self.device = torch.device("cuda" if args.device != "cpu" and torch.cuda.is_available() else "cpu")
        self.deadline = time.monotonic() + args.until - time.time()
        self.gate = Gate()
        self.places = args.places if args.role == "small" else 1
        self.free = self.places
        self.changed = threading.Condition()
        self.scores: list[subprocess.Popen[bytes]] = []
        chosen = [job for job in all_jobs() if not args.only or args.only in job.name][: args.jobs]
        self.jobs = [job for job in chosen if job.role == args.role]

    def run(self) -> None:
        import torch
        from zoo_loop import Resident

        if self.device.type == "cuda":
            torch.backends.cudnn.benchmark = True
            torch.set_float32_matmul_precision("high")
        sys.setswitchinterval(1e-4)
        if not self.jobs:
            return
        self.data = Resident(self.args.data, self.device)
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        _log.info("worker %s %s: %s", self.args.worker, self.args.role, self.data.summary())
        threads = []
        while time.monotonic() < self.deadline - 20:
            with self.changed:
                job = next((item for item in self.jobs if not self._claimed(item)), None)
                if job is None:
                    break
                if not self.free:
                    self.changed.wait(1.0)
                    continue
                if not self._claim(job) or self._late(job):
                    continue
                self.free -= 1
            thread = threading.Thread(target=self._train, args=(job,))
            thread.start()
            threads.append(thread)
        for thread in threads:
            thread.join()
        for process in self.scores:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(max(1.0, self.deadline + CLOSING - 25 - time.monotonic()))

    def _late(self, job: Job) -> bool:
        """Whether too little time is left for a job to be worth beginning."""
        needed = 0.6 * self._budget(job) if self.args.last and job.objective != "untrained" else 30.0
        return self.deadline - time.monotonic() < needed

    def _budget(self, job: Job) -> float:
        if job.full:
            # The published sizes without recurrence over areas are ten times cheaper.
            return self.args.full_seconds * (1.0 if job.model.startswith("zhuang") else 0.35)
        return self.args.small_seconds

    def _claimed(self, job: Job) -> bool:
        return (self.args.work / "claims" / job.name).exists()

    def _claim(self, job: Job) -> bool:
        try:
            os.close(os.open(self.args.work / "claims" / job.name, os.O_CREAT | os.O_EXCL))
        except FileExistsError:
            return False
        return True

    def _train(self, job: Job) -> None:
        import dataclasses

        import torch
        from zoo_loop import run_job

        out = self.args.work / "jobs" / job.name
        if self.args.epochs:
            job = dataclasses.replace(job, epochs=min(job.epochs, self.args.epochs))
        stream = torch.cuda.Stream() if self.device.type == "cuda" else None
        started = time.monotonic()
        status = "failed"
        try:
            with torch.cuda.stream(stream) if stream is not None else contextlib.nullcontext():
                status = run_job(
                    job,
                    self.data,
                    self.device,
                    out,
                    exclusive=self.gate.exclusive,
                    shared=self.gate.shared,
                    long=self.gate.long,
                    budget=self._budget(job),
                    deadline=self.deadline,
                    precision=self.args.precision,
                    last_call=self.args.last,
                )
        except Exception:  # noqa: BLE001 - one job must not take the others with it
            _log.exception("%s failed", job.name)
        _log.info("%s: %s after %.0f s", job.name, status, time.monotonic() - started)
        if status in ("finished", "diverged") and not self.args.no_score:
            self.scores.append(subprocess.Popen(command(self.args, score=out), env=environment(None)))
        with self.changed:
            self.free += 1
            self.changed.notify_all()


def score(folder: Path) -> None:
    """Score a job's network on the demo recordings; without a job, only make the stimuli."""
    from brainbench.files import read_json, write_text
    from brainbench.scoring import score_record

    if (folder / "record.json").is_file():
        return
    if not (folder / "result.json").is_file():
        score_record("zhuang-small")
        return
    job = read_json(folder / "result.json")["job"]
    trained = job["objective"] != "untrained"
    record = score_record(f"local-dir:{folder / 'best'}" if trained else job["model"], seed=job["seed"])
    write_text(folder / "record.json", record.to_json() + "\n")


def pack(work: Path, out: Path) -> list[dict[str, Any]]:
    """Write what comes back, the most valuable first; return the results."""
    from brainbench.files import read_json, write_text

    out.mkdir(parents=True, exist_ok=True)
    results, curves = [], []
    order = {job.name: index for index, job in enumerate(all_jobs())}
    folders = sorted((work / "jobs").glob("*"), key=lambda path: order.get(path.name, len(order)))
    for folder in folders:
        if (folder / "log.jsonl").is_file():
            curves.append((folder / "log.jsonl").read_text(encoding="utf-8"))
        if (folder / "result.json").is_file():
            result = read_json(folder / "result.json")
            if (folder / "record.json").is_file():
                result["score"] = read_json(folder / "record.json")["score"]
            results.append(result)
    write_text(out / "results.jsonl", "".join(json.dumps(result) + "\n" for result in results))
    write_text(out / "curves.jsonl", "".join(curves))
    ship = {job.name for job in all_jobs() if job.ship}
    shipped = [path for folder in folders if folder.name in ship for path in sorted((folder / "best").glob("*"))]
    records = [path for folder in folders for path in (folder / "record.json", folder / "result.json")]
    states = [folder / "state.safetensors" for folder in folders]
    others = [path for folder in folders if folder.name not in ship for path in sorted((folder / "best").glob("*"))]
    fill(out, work, [path for path in (*shipped, *records, *states, *others) if path.is_file()])
    return results


def row(result: dict[str, Any]) -> str:
    """Return one line of the table that is printed at the end."""
    found, scored = result["evaluation"], result.get("score") or {}
    low, high = found["interval"]["low"], found["interval"]["high"]
    value = scored.get("value")
    speed = f"{result.get('training_seconds', 0):5.0f} s {result.get('sweeps_per_second', 0):8,.0f}/s"
    parts = [
        f"{result['name']:52} {result.get('status', ''):9} {result['epochs']:4d} ep {speed}",
        f"top1 {found['top1']:.3f} [{low:.3f}, {high:.3f}] top5 {found['top5']:.3f}",
        "COLLAPSED" if found["collapsed"] else "",
        f"score {'–' if value is None else format(value, '.3f')} {scored.get('status', '')}",
    ]
    return " ".join(part for part in parts if part)


def fill(out: Path, work: Path, paths: list[Path]) -> None:
    """Put files into tar files of limited size, as many as fit, in order."""
    from brainbench.files import atomic_path

    room = [TAR_BYTES] * TARS
    inside: list[list[Path]] = [[] for _ in room]
    left = 0
    for path in paths:
        size = path.stat().st_size + 2048
        place = next((index for index, free in enumerate(room) if free >= size), None)
        if place is None:
            left += 1
            continue
        room[place] -= size
        inside[place].append(path)
    for index, chosen in enumerate(inside):
        if chosen:
            with atomic_path(out / f"zoo-{index}.tar") as temporary, tarfile.open(temporary, "w") as file:
                for path in chosen:
                    file.add(path, str(path.relative_to(work)))
    _log.info("%d files packed, %d left out", sum(map(len, inside)), left)


def unpack(folder: Path, work: Path) -> None:
    """Put the files of an earlier call where this one looks for them."""
    for path in sorted(folder.glob("zoo-*.tar")):
        with tarfile.open(path) as file:
            file.extractall(work, filter="data")


def install(folder: Path) -> None:
    """Put the trained networks that are to be shipped into the package."""
    work = folder / "unpacked"
    unpack(folder, work)
    target = ROOT / "brainbench" / "models" / "weights"
    for job in all_jobs():
        best = work / "jobs" / job.name / "best"
        if job.ship and (work / "jobs" / job.name / "result.json").is_file():
            place = target / f"{job.model}.{job.objective}"
            shutil.rmtree(place, ignore_errors=True)
            shutil.copytree(best, place)
            size = sum(path.stat().st_size for path in place.iterdir())
            _log.info("%s: %.2f MB", place.relative_to(ROOT), size / 1e6)


if __name__ == "__main__":
    main()
