"""Train the models that come with brainbench, on every GPU there is, several at a time on each.

    python -m benchmarks.models.train_zoo --minutes 9 --out $OUT          # makes the data, trains, scores, packs
    python -m benchmarks.models.train_zoo --install FOLDER_OF_TARS        # puts the small ones into the package

A few processes per GPU, each with all sweeps in the GPU's memory, each doing one job after the other with whole
training steps as CUDA graphs (``zoo_loop.py``). Jobs are in ``zoo_jobs.py``, the most valuable first; each is claimed
by one process. At the deadline unfinished jobs save their state. Results come back as soon as there are any: up to four
tar files with ``results.jsonl``, ``curves.jsonl``, result records, checkpoints of small networks and states, each
replaced in one move; given with ``--resume`` they are gone on with.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import shutil
import subprocess
import sys
import tarfile
import threading
import time
from pathlib import Path
from typing import Any

from zoo_jobs import PASS, Job, all_jobs

_log = logging.getLogger("train_zoo")
ROOT = Path(__file__).resolve().parents[2]
LEAVING = 12.0
"""Seconds before the end when all that still runs is ended."""
OVERHEAD = 20.0
"""Seconds of a job beside its training: preparing, the probe, evaluating."""
MOST_FAULTS = 12
"""Workers that are replaced when they fail."""
TAR_BYTES = 15 * 2**20
"""Files of at most 16 MiB may come back."""


def parser() -> argparse.ArgumentParser:
    told = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    told.add_argument("--out", type=Path, default=Path("zoo-out"), help="where results are packed")
    told.add_argument("--work", type=Path, default=Path("/tmp/zoo-work"), help="folders of the jobs")
    told.add_argument("--data", type=Path, help="a data set that is there already")
    told.add_argument("--recipe", default="thesis-high")
    told.add_argument("--objects", default="procedural-24:10")
    told.add_argument("--limit", type=int, help="only the first sweeps of each object")
    told.add_argument("--sample", type=float, help="only this fraction of all sweeps")
    told.add_argument("--shard", type=int, help="sweeps per shard")
    told.add_argument("--links", type=int, default=12)
    told.add_argument("--step", type=float, default=1e-3)
    told.add_argument("--retry", type=int, default=5, help="as of brainbench stimuli; 1 leaves doubtful sweeps out")
    told.add_argument("--minutes", type=float, default=9.4, help="from start to end, packing included")
    told.add_argument("--end", type=float, help="the same as seconds since 1970: $(($(date +%%s) + 570)) of the shell")
    told.add_argument("--last", action="store_true", help="no later call will go on: end every schedule in this one")
    told.add_argument("--small-seconds", type=float, default=130.0, help="training time of a small job of weight 1")
    told.add_argument("--full-seconds", type=float, default=200.0, help="training time of a full-size job of weight 1")
    told.add_argument("--places", "--together", type=int, default=3, help="processes on a GPU, or on the processor")
    told.add_argument("--learning-rate", type=float, help="instead of the jobs' own")
    told.add_argument("--batch", type=int, default=256, help="sweeps per step")
    told.add_argument("--precision", default="auto", help="bf16, float32, or what is safe and fast on the device")
    told.add_argument("--epochs", type=int, help="epochs at most, whatever the job says")
    told.add_argument("--short", type=float, help="short trainings on a processor: times the steps of zoo_jobs.SHORT")
    told.add_argument("--closing", type=float, default=75.0, help="seconds before the end when training stops")
    told.add_argument(
        "--ablation", type=int, help="epochs of the jobs that compare augmentations; they come first then"
    )
    told.add_argument("--tars", type=int, default=4, help="files that may come back")
    told.add_argument("--only", help="substring of the names of jobs to train")
    told.add_argument("--jobs", type=int, help="only so many jobs")
    told.add_argument("--resume", type=Path, help="folder with the tar files of an earlier call")
    told.add_argument("--no-score", action="store_true")
    told.add_argument("--device", default=None, help="cpu for a trial run; all GPUs if not given")
    told.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    told.add_argument("--score", type=Path, help=argparse.SUPPRESS)
    told.add_argument("--shards", help=argparse.SUPPRESS)
    told.add_argument("--until", type=float, help=argparse.SUPPRESS)
    told.add_argument("--install", type=Path, help="unpack tar files and put trained models into the package")
    told.add_argument("--records", action="store_true", help="with --install: the package's weights stay as they are")
    return told


def main() -> None:
    args = parser().parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if args.install:
        install(args.install, weights=not args.records)
    elif args.score:
        score(args.score)
    elif args.shards:
        make_shards(args)
    elif args.worker is not None:
        Worker(args).run()
    else:
        campaign(args)


def campaign(args: argparse.Namespace) -> None:
    """Make the data, keep a few processes per GPU at work, bring every result back as soon as it is there."""
    started = time.time()
    end = args.end or started + 60 * args.minutes
    args.until = end - args.closing
    gpus = 0 if args.device == "cpu" else count_gpus()
    args.work.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(args.work / "claims", ignore_errors=True)
    (args.work / "claims").mkdir()
    if args.resume:
        unpack(args.resume, args.work)
    project(args, max(1, gpus))
    scorers = Scorers(args)
    scorers.start(args.work / "warm-up")
    if args.data is None:
        args.data = make_data(args, gpus)
        _log.info("data after %.0f s", time.time() - started)
    places = [index for _ in range(args.places) for index in range(max(1, gpus))]
    workers: list[subprocess.Popen[bytes] | None] = [None] * len(places)
    faults, seen = 0, None
    while time.time() < end - LEAVING:
        for place, gpu in enumerate(places):
            worker = workers[place]
            if worker is not None:
                if worker.poll() in (None, 0) or faults >= MOST_FAULTS or time.time() > args.until - 30:
                    continue
                faults += 1
                _log.error("worker %d ended with %s; another one takes its place", place, worker.poll())
            workers[place] = start_worker(args, place, gpu if gpus else None)
        scorers.look()
        # What is done is packed at once: a cut then costs what was running alone.
        if (found := written(args.work)) != seen:
            seen = found
            pack(args)
        if all(worker is not None and worker.poll() is not None for worker in workers) and scorers.idle:
            break
        time.sleep(2.0)
    for worker in workers:
        if worker is not None and worker.poll() is None:
            _log.warning("a worker is not done at the end and is ended")
            worker.kill()
    scorers.kill()
    for result in pack(args):
        print(row(result))
    _log.info("everything after %.0f s", time.time() - started)


def project(args: argparse.Namespace, gpus: int) -> None:
    """Say which jobs are still to be trained and how long they may take together."""
    open_jobs = [job for job in chosen_jobs(args) if not (args.work / "jobs" / job.name / "result.json").is_file()]
    seconds = 0.0
    for job in open_jobs:
        most = 0.0 if job.timeless else job.weight * (args.full_seconds if job.full else args.small_seconds)
        seconds += OVERHEAD + (most if job.trained else 0.0)
        _log.info("%6.0f s after the data, at most: %s", seconds / (gpus * args.places), job.name)


def start_worker(args: argparse.Namespace, place: int, gpu: int | None) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command(args, worker=place), env=environment(gpu))


class Scorers:
    """Processes that score what is trained, on the processor, a few at a time."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.most = 1 if args.device == "cpu" else max(2, (os.cpu_count() or 1) // 8)
        self.running: list[subprocess.Popen[bytes]] = []
        self.given: set[Path] = set()

    def start(self, folder: Path) -> None:
        """Score a job's network; without one, only make the stimuli."""
        if not self.args.no_score:
            self.given.add(folder)
            self.running.append(subprocess.Popen(command(self.args, score=folder), env=environment(None)))

    def look(self) -> None:
        """Start what can be scored now."""
        self.running = [process for process in self.running if process.poll() is None]
        for path in sorted((self.args.work / "jobs").glob("*/result.json")):
            # The first one makes the stimuli that all others read.
            if len(self.running) >= self.most or (self.running and len(self.given) == 1):
                return
            known = ".shipped." in path.parent.name or (path.parent / "record.json").is_file()
            if path.parent not in self.given and not known:
                self.start(path.parent)

    @property
    def idle(self) -> bool:
        """Whether all that there is has been scored."""
        self.look()
        return not self.running

    def kill(self) -> None:
        """End what still runs."""
        for process in self.running:
            process.kill()


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
    words = [sys.executable, "-m", __spec__.name]
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
    from brainbench.stimuli.objects.collections import resolve_objects
    from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings
    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS

    settings = GenerationSettings(
        fidelity=Fidelity(links=args.links, time_step=args.step),
        backend="rod",
        device="cuda" if gpus else "cpu",
        limit=args.limit,
        sample=args.sample,
        retry=args.retry,
        shard_size=args.shard or (3120 if gpus else None),
    )
    return GenerationPlan(args.recipe, GRIDS[args.recipe], resolve_objects([args.objects], surfaces=True), settings)


def make_data(args: argparse.Namespace, gpus: int) -> Path:
    """Generate the sweeps, every GPU its share of the shards; return their folder."""
    from brainbench.core.files import to_plain, write_json
    from brainbench.stimuli.sweeps.generation import CONFIG, generate

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
    from brainbench.stimuli.sweeps.manifest import is_complete
    from brainbench.stimuli.sweeps.running import run_here

    index, count = map(int, args.shards.split("/"))
    folder = args.work / "data"
    missing = [
        task for task in make_plan(args, count).shards[index::count] if not is_complete(folder / task.name, task)
    ]
    if missing:
        run_here(missing, folder, max(1, (os.cpu_count() or 1) // count), lambda done: None)


class Worker:
    """Does one job after the other on one GPU, or on the processor; others may work beside it."""

    def __init__(self, args: argparse.Namespace) -> None:
        import torch

        self.args = args
        self.device = torch.device("cuda" if args.device != "cpu" and torch.cuda.is_available() else "cpu")
        self.deadline = time.monotonic() + args.until - time.time()
        threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()

    def run(self) -> None:
        import torch
        from zoo_loop import Resident

        if self.device.type == "cuda":
            torch.backends.cudnn.benchmark = True
            torch.set_float32_matmul_precision("high")
        data = Resident(self.args.data, self.device)
        _log.info("worker %s: %s", self.args.worker, data.summary())
        while (job := self._next()) is not None:
            self._train(job, data)

    def _next(self) -> Job | None:
        """Claim the first job that nobody has claimed and that there is time for."""
        for job in chosen_jobs(self.args):
            if self.deadline - time.monotonic() < self._needed(job):
                continue
            try:
                os.close(os.open(self.args.work / "claims" / job.name, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                continue
            return job
        return None

    def _needed(self, job: Job) -> float:
        """Return the seconds without which a job is not worth beginning."""
        if not (self.args.last and job.trained) or self.args.short:
            return 25.0
        return 60.0 if job.timeless else 0.6 * self._budget(job)

    def _budget(self, job: Job) -> float:
        if job.timeless:
            return math.inf
        return job.weight * (self.args.full_seconds if job.full else self.args.small_seconds)

    def _precision(self, job: Job) -> str:
        if self.args.precision != "auto":
            return self.args.precision
        # On the CPU PyTorch's bf16 gradients of strided convolutions are now and then not finite.
        return "bf16" if self.device.type == "cuda" or job.model.startswith("zhuang") else "float32"

    def _train(self, job: Job, data: Any) -> None:
        import dataclasses

        from zoo_loop import run_job

        if self.args.epochs:
            job = dataclasses.replace(job, epochs=min(job.epochs, self.args.epochs))
        if self.args.short and job.trained:
            job = job.short(self.args.short)
        if self.args.learning_rate:
            job = dataclasses.replace(job, learning_rate=self.args.learning_rate)
        started = time.monotonic()
        out = self.args.work / "jobs" / job.name
        # A failed launch leaves the device unusable: the process ends, and another one takes its place.
        status = run_job(
            job,
            data,
            self.device,
            out,
            budget=self._budget(job),
            deadline=self.deadline,
            precision=self._precision(job),
            batch=self.args.batch,
            steps=PASS if self.args.short else None,
            last_call=self.args.last,
        )
        told = ""
        if (out / "result.json").is_file():
            result = json.loads((out / "result.json").read_text(encoding="utf-8"))
            times = ", ".join(f"{name} {value:.1f}" for name, value in result.get("seconds", {}).items())
            told = f" ({times} s; {result.get('sweeps_per_second', 0):,.0f} sweeps/s)"
        _log.info("%s: %s after %.0f s%s", job.name, status, time.monotonic() - started, told)


def _end_with(parent: int) -> None:
    """End this process when the one that started it is gone."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def chosen_jobs(args: argparse.Namespace) -> list[Job]:
    """Return the jobs of this call."""
    return [job for job in all_jobs(args.ablation) if not args.only or args.only in job.name][: args.jobs]


def score(folder: Path) -> None:
    """Score a job's network on the demo recordings; without a job, only make the stimuli."""
    from brainbench.core.files import read_json, write_text
    from brainbench.scoring.scores import score_record

    if (folder / "record.json").is_file():
        return
    if not (folder / "result.json").is_file():
        score_record("zhuang-small")
        return
    job = Job(**read_json(folder / "result.json")["job"])
    if job.objective == "untrained":
        record = score_record(job.model, weights_seed=job.seed)
    else:
        # Named alike in all seeds, and wherever the folders lie.
        link = folder.parent.parent / f"seed{job.seed}" / job.title
        link.parent.mkdir(exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(folder / "best")
        os.chdir(link.parent)
        name = f"local-dir:{job.title}"
        record = score_record(name, command=f"brainbench score {name}")
    write_text(folder / "record.json", record.to_json() + "\n")


def pack(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Write what comes back, the most valuable first; return the results."""
    from brainbench.core.files import read_json, write_text

    work = args.work
    args.out.mkdir(parents=True, exist_ok=True)
    results, curves = [], []
    order = {job.name: index for index, job in enumerate(all_jobs(args.ablation))}
    folders = sorted((work / "jobs").glob("*"), key=lambda path: order.get(path.name, len(order)))
    for folder in folders:
        if (folder / "log.jsonl").is_file():
            curves.append((folder / "log.jsonl").read_text(encoding="utf-8"))
        if (folder / "result.json").is_file():
            result = read_json(folder / "result.json")
            if (folder / "record.json").is_file():
                result["score"] = read_json(folder / "record.json")["score"]
            results.append(result)
    write_text(work / "results.jsonl", "".join(json.dumps(result) + "\n" for result in results))
    write_text(work / "curves.jsonl", "".join(curves))
    told = [work / "results.jsonl", work / "curves.jsonl"]
    ship = {job.name for job in all_jobs(args.ablation) if job.ship}
    ended = [folder for folder in folders if (folder / "result.json").is_file()]
    shipped = [path for folder in ended if folder.name in ship for path in sorted((folder / "best").glob("*"))]
    records = [path for folder in folders for path in (folder / "record.json", folder / "result.json")]
    states = [folder / "state.safetensors" for folder in folders]
    others = [path for folder in ended if folder.name not in ship for path in sorted((folder / "best").glob("*"))]
    fill(args, [path for path in (*told, *records, *shipped, *states, *others) if path.is_file()])
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


def fill(args: argparse.Namespace, paths: list[Path]) -> None:
    """Put files into tar files of limited size, as many as fit, in order."""
    from brainbench.core.files import atomic_path

    out, work = args.out, args.work
    room = [TAR_BYTES] * args.tars
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
        if not chosen:  # an older file would bring back what has ended since
            (out / f"zoo-{index}.tar").unlink(missing_ok=True)
        else:
            with atomic_path(out / f"zoo-{index}.tar") as temporary, tarfile.open(temporary, "w") as file:
                for path in chosen:
                    file.add(path, str(path.relative_to(work)))
    _log.info("%d files packed, %d left out", sum(map(len, inside)), left)


def unpack(folder: Path, work: Path) -> None:
    """Put the files of an earlier call where this one looks for them."""
    for path in sorted(folder.glob("zoo-*.tar")):
        with tarfile.open(path) as file:
            file.extractall(work, filter="data")


def install(folder: Path, *, weights: bool = True) -> None:
    """Put the trained networks that are to be shipped into the package, each with its untrained twin in its card.

    Where the one that is there was evaluated on the same sweeps, the better one in validation stays. Records of all
    other trained networks go to the leaderboard.
    """
    from brainbench.core.files import read_json, write_json, write_text
    from brainbench.core.records import ResultRecord
    from brainbench.models.training.card import model_card
    from brainbench.models.training.config import TrainingConfig
    from leaderboards.store import write_record

    work = folder / "unpacked"
    unpack(folder, work)
    target, installed = ROOT / "brainbench" / "models" / "weights", set()
    for job in all_jobs():
        ended = work / "jobs" / job.name
        if not (weights and job.ship and (ended / "result.json").is_file()):
            continue
        if read_json(ended / "result.json")["status"] != "finished":
            _log.warning("%s diverged and is not installed", job.name)
            continue
        before = work / "jobs" / f"{job.model}.{job.objective}.shipped.seed0" / "result.json"
        if before.is_file():
            old, new = read_json(before)["validation"], read_json(ended / "result.json")["validation"]
            _log.info("%s: validation %.3f, of the one that is there %.3f", job.name, new, old)
            if new <= old:
                continue
        place = target / f"{job.model}.{job.objective}"
        shutil.rmtree(place, ignore_errors=True)
        shutil.copytree(ended / "best", place)
        info = read_json(place / "config.json")
        twin = work / "jobs" / f"{job.model}.untrained.seed{job.seed}" / "result.json"
        if twin.is_file():
            info["twin_evaluation"] = read_json(twin)["evaluation"]
        write_json(place / "config.json", info)
        write_text(place / "README.md", model_card(TrainingConfig.from_mapping(info["training"]), info))
        installed.add(job.name)
        size = sum(path.stat().st_size for path in place.iterdir())
        _log.info("%s: %.2f MB", place.relative_to(ROOT), size / 1e6)
    for path in sorted((work / "jobs").glob("*/record.json")):
        job = Job(**read_json(path.parent / "result.json")["job"])
        if job.trained and job.name not in installed:
            record = ResultRecord.from_json(path.read_text(encoding="utf-8"))
            _log.info("%s", write_record(record, ROOT / "leaderboards" / "results"))


if __name__ == "__main__":
    main()
