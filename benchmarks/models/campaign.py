"""Train the published networks at equal length, on every GPU there is, several at a time on each.

    python -m benchmarks.models.campaign --work /tmp/campaign --minutes 20 &    # makes the data, trains
    CUDA_VISIBLE_DEVICES=1 python -m benchmarks.models.campaign … --only 'simsiam|rate'   # some jobs on one of the GPUs
    python -m benchmarks.models.campaign --work /tmp/campaign --pack 0 --out $OUT   # the first 60 MB of what is done
    python -m benchmarks.models.campaign --install FOLDER   # here: results of its tars enter the repository
    python -m benchmarks.models.campaign --score FOLDER     # here: networks and twins are scored

Jobs are in ``campaign_jobs.py``, the most valuable first. Those that ``leaderboards/reproduction/trainings.jsonl``
lists are done; a session takes the next ones that it has time for. A few processes per GPU, each with all sweeps in the
GPU's memory, do one job after the other (``campaign_loop.py``); CUDA's multi-process service lets their kernels run
together.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import tarfile
import threading
import time
from itertools import product
from pathlib import Path
from typing import Any

from benchmarks.models.campaign_jobs import SHIPPED, Job, campaign

_log = logging.getLogger("campaign")
ROOT = Path(__file__).resolve().parents[2]
DONE = ROOT / "leaderboards" / "reproduction" / "trainings.jsonl"
CURVES = DONE.with_name("curves.jsonl")
WEIGHTS = ROOT / "brainbench" / "models" / "weights"
BASELINES = ("raw-input", "random-features")
BOARDS = (("demo", "rsa"), ("demo-rodgers", "rsa"), ("demo", "ridge"))
"""Recordings and metrics that every network is scored with."""
SOLVER = "c1a690c"
"""Commit with whose solver all sweeps are made, so that sessions train on the same."""
MEMBERS = 150
"""Objects of each of the 54 families: 16 sweeps each, eight tenths of them to train."""
MANIFEST = "manifest.json"
"""File that a finished data set has."""
TAR_BYTES, TARS = 15 * 2**20, 4
"""Sizes of what comes back in one call."""
MOST_FAULTS = 12


def parser() -> argparse.ArgumentParser:
    told = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    told.add_argument("--work", type=Path, default=Path("/tmp/campaign"), help="folder of the data and the jobs")
    told.add_argument("--minutes", type=float, default=20.0, help="from start to end")
    told.add_argument("--until", type=float, help="the same as seconds since 1970")
    told.add_argument("--places", type=int, default=3, help="processes on a GPU")
    told.add_argument("--members", type=int, default=MEMBERS, help="objects of each family")
    told.add_argument("--epochs", type=int, help="fewer epochs, for a trial")
    told.add_argument("--data", action="store_true", help="make the data and stop")
    told.add_argument("--only", help="pattern in the names of jobs to do")
    told.add_argument("--again", action="store_true", help="also jobs that are done, on sweeps of today's solver")
    told.add_argument("--device", help="cpu for a trial; all GPUs if not given")
    told.add_argument("--pack", type=int, help="write the n-th part of the results to --out")
    told.add_argument("--out", type=Path, default=Path("campaign-out"))
    told.add_argument("--install", type=Path, help="enter the results of tar files into the repository")
    told.add_argument("--score", type=Path, help="score the networks of a folder that --install unpacked")
    told.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    return told


def main() -> None:
    args = parser().parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    if args.install:
        install(args.install)
    elif args.score:
        score(args)
    elif args.pack is not None:
        pack(args)
    elif args.worker is not None:
        Worker(args).run()
    else:
        run(args)


def run(args: argparse.Namespace) -> None:
    """Make the data, keep a few processes per GPU at work until the end."""
    args.until = args.until or time.time() + 60 * args.minutes
    gpus = 0 if args.device == "cpu" else count_gpus()
    (args.work / "claims").mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    make_data(args, gpus)
    _log.info("data after %.0f s", time.monotonic() - began)
    if args.data:
        return
    places = [index for _ in range(args.places) for index in range(max(1, gpus))]
    workers = [start(args, gpu if gpus else None, worker=place) for place, gpu in enumerate(places)]
    faults = 0
    while time.time() < args.until and any(worker.poll() is None for worker in workers):
        for place, gpu in enumerate(places):
            if workers[place].poll() not in (None, 0) and faults < MOST_FAULTS:
                faults += 1
                _log.error("worker %d ended with %s; another one takes its place", place, workers[place].poll())
                release(args.work, place)
                workers[place] = start(args, gpu if gpus else None, worker=place)
        time.sleep(1.0)
    for worker in workers:
        worker.kill()
    _log.info("everything after %.0f s", time.monotonic() - began)


def release(work: Path, place: int) -> None:
    """Let others take the job of a worker that is gone, once: the second time the job itself may be to blame."""
    for claim in (work / "claims").iterdir():
        mine = claim.read_text(encoding="utf-8") == str(place)
        if mine and not (work / "jobs" / claim.name / "result.json").is_file():
            again = claim.with_name(f"again-{claim.name}")
            if not again.exists():
                claim.rename(again)


def count_gpus() -> int:
    """Return how many GPUs there are, without starting CUDA in this process."""
    asked = "import torch; print(torch.cuda.device_count())"
    return int(subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout)


def start(args: argparse.Namespace, gpu: int | None, **changes: Any) -> subprocess.Popen[bytes]:
    """Start a process of this campaign that sees one GPU, or none."""
    words = [sys.executable, "-m", "benchmarks.models.campaign"]
    for name, value in {**vars(args), **changes}.items():
        if value is not None and value is not False:
            words += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
    threads = str(max(1, (os.cpu_count() or 1) // 16))
    # This process may itself see only some of the GPUs.
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    seen = "" if gpu is None else visible.split(",")[gpu] if visible else str(gpu)
    return subprocess.Popen(words, env={**os.environ, "OMP_NUM_THREADS": threads, "CUDA_VISIBLE_DEVICES": seen})


def make_data(args: argparse.Namespace, gpus: int) -> None:
    """Generate the sweeps, on every GPU: the low-variation grid of the thesis on procedural objects."""
    from brainbench.stimuli import Fidelity
    from brainbench.stimuli.objects.collections import resolve_objects
    from brainbench.stimuli.sweeps.generation import generate
    from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings
    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS

    folder = args.work / "data"
    if (folder / MANIFEST).is_file():
        return
    settings = GenerationSettings(
        fidelity=Fidelity(links=12, time_step=1e-3), device="cuda" if gpus else "cpu", shard_size=3120 if gpus else None
    )
    objects = resolve_objects([f"procedural:{args.members}"], surfaces=True)
    plan = GenerationPlan("thesis-low", GRIDS["thesis-low"], objects, settings)
    manifest = generate(plan, folder)
    _log.info("%d sweeps, hash %s, %d unstable", manifest["sweeps"], manifest["content_hash"], manifest["unstable"])
    used = {line["data"]["hash"] for line in finished().values()} - {manifest["content_hash"]}
    if used and gpus and not args.again:
        raise SystemExit(
            f"These sweeps are not those of the trainings done so far ({', '.join(used)}): train with the code of the "
            f"commit {SOLVER}, whose solver made them."
        )


class Worker:
    """Does one job after the other on one GPU, or on the processor; others work beside it."""

    def __init__(self, args: argparse.Namespace) -> None:
        import torch

        self.args = args
        self.device = torch.device("cuda" if args.device != "cpu" and torch.cuda.is_available() else "cpu")
        self.slower = 0.7 * args.places
        """Time of a job over what it takes alone, as the last one had it."""
        self.done = finished()
        threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()

    def run(self) -> None:
        """Do jobs until none is left that there is time for."""
        import torch

        from benchmarks.models.campaign_loop import Resident, run_job

        torch.backends.cudnn.benchmark = True
        torch.set_float32_matmul_precision("high")
        data = Resident(self.args.work / "data", self.device)
        _log.info("worker %s: %s", self.args.worker, data.summary())
        while (job := self._next()) is not None:
            began = time.monotonic()
            if self.args.epochs:
                job = job.shortened(self.args.epochs)
            # A failed launch leaves the device unusable: the process ends, and another one takes its place.
            result = run_job(job, data, self.device, self.args.work / "jobs" / job.name, self._rate(job))
            seconds = time.monotonic() - began
            if job.trained:
                self.slower = seconds / job.seconds
            found = result.get("evaluation")
            told = "" if found is None else f"top-1 {found.top1:.3f}{' COLLAPSED' if found.collapsed else ''}"
            _log.info(
                "%s: %s %s, rate %s of %s, %.0f s (%.1f × alone), %.0f sweeps/s", job.name, result.get("status"), told,
                result.get("learning_rate"), result.get("search"), seconds, self.slower,
                result.get("sweeps_per_second", 0),
            )  # fmt: skip

    def _next(self) -> Job | None:
        """Claim the first job that nobody has done or claimed and that there is time for."""
        for job in campaign():
            known = job.name in self.done or job.model in self.done  # baselines are listed by what is read
            if (known and not self.args.again) or (self.args.only and not re.search(self.args.only, job.name)):
                continue
            if job.trained and job.seed and self._rate(job) is None:
                continue
            if not self.args.epochs and self.slower * job.seconds > self.args.until - time.time():
                continue
            try:
                with (self.args.work / "claims" / job.name).open("x", encoding="utf-8") as claim:
                    claim.write(str(self.args.worker))
            except FileExistsError:
                continue
            return job
        return None

    def _rate(self, job: Job) -> float | None:
        """Return the learning rate that is given, or that seed 0 found; None where it has to be searched."""
        if job.rate is not None:
            return job.rate
        if not (job.trained and job.seed):
            return None
        first = job.name.removesuffix(f"seed{job.seed}") + "seed0"
        path = self.args.work / "jobs" / first / "result.json"
        known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else self.done.get(first, {})
        return known.get("learning_rate")


def _end_with(parent: int) -> None:
    """End this process when the one that started it is gone."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def finished() -> dict[str, dict[str, Any]]:
    """Return the results of the jobs that earlier sessions did, by name."""
    if not DONE.is_file():
        return {}
    lines = map(json.loads, DONE.read_text(encoding="utf-8").splitlines())
    return {line["name"]: line for line in lines}


def pack(args: argparse.Namespace) -> None:
    """Write the n-th part of all results to tar files of limited size: first what is small, then checkpoints."""
    jobs = args.work / "jobs"
    small = sorted((*jobs.glob("*/result.json"), *jobs.glob("*/log.jsonl")))
    large = sorted(path for folder in jobs.glob("*/best") for path in folder.iterdir())
    bins: list[list[Path]] = [[]]
    room = TAR_BYTES
    for path in [*small, *large]:
        size = path.stat().st_size + 2048
        if size > TAR_BYTES:
            _log.warning("%s is too large to come back", path)
            continue
        if size > room:
            bins.append([])
            room = TAR_BYTES
        bins[-1].append(path)
        room -= size
    args.out.mkdir(parents=True, exist_ok=True)
    for number in range(args.pack * TARS, min((args.pack + 1) * TARS, len(bins))):
        with tarfile.open(args.out / f"campaign-{number}.tar", "w") as file:
            for path in bins[number]:
                file.add(path, str(path.relative_to(args.work)))
    _log.info("part %d of %d; %d jobs done", args.pack, -(-len(bins) // TARS), len(list(jobs.glob("*/result.json"))))


def install(folder: Path) -> None:
    """Unpack tar files beside themselves and add the results of finished jobs to the list in the repository."""
    from brainbench.core.files import write_text

    for path in sorted(folder.glob("**/campaign-*.tar")):
        with tarfile.open(path) as file:
            file.extractall(folder / "unpacked", filter="data")
    known = finished()
    for path in sorted((folder / "unpacked" / "jobs").glob("*/result.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        for line in lines_of(result):
            known[line["name"]] = line
    order = {job.name: index for index, job in enumerate(campaign())}
    lines = sorted(known.values(), key=lambda line: order.get(line["name"], -1))
    for line in lines:
        twin = known.get(f"{line.get('model')}.untrained.seed{line.get('seed')}")
        if twin is not None and line["objective"] != "untrained":
            line["twin_evaluation"] = twin["evaluation"]
    write_text(DONE, "".join(json.dumps(line) + "\n" for line in lines))
    _log.info("%s lists %d results", DONE.relative_to(ROOT), len(lines))
    new = {path.parent.name: path.read_text(encoding="utf-8") for path in folder.glob("unpacked/jobs/*/log.jsonl")}
    old = CURVES.read_text(encoding="utf-8").splitlines() if CURVES.is_file() else []
    kept = [line for line in old if json.loads(line)["job"] not in new]
    # A log whose job did not end is no curve.
    write_text(CURVES, "\n".join([*kept, *(text.strip() for name, text in new.items() if name in known)]) + "\n")
    for name in SHIPPED:
        source = folder / "unpacked" / "jobs" / f"{name}.seed0" / "best"
        if source.is_dir():
            ship(source, WEIGHTS / name, known)


def ship(source: Path, target: Path, known: dict[str, dict[str, Any]]) -> None:
    """Put a checkpoint into the package, with its controls in its configuration and its card."""
    from brainbench.core.files import read_json, write_json, write_text
    from brainbench.models.training.card import model_card
    from brainbench.models.training.config import TrainingConfig

    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)
    info = read_json(target / "config.json")
    info["baselines"] = {name: known[name]["evaluation"] for name in BASELINES}
    info["twin_evaluation"] = known[f"{info['twin']['name']}.untrained.seed{info['seed']}"]["evaluation"]
    write_json(target / "config.json", info)
    write_text(target / "README.md", model_card(TrainingConfig.from_mapping(info["training"]), info))


def score(args: argparse.Namespace) -> None:
    """Score networks and untrained twins on the boards of :data:`BOARDS`; what is scored already is left alone."""
    from brainbench.scoring.demo import DEMOS
    from brainbench.scoring.scores import score_record
    from leaderboards.store import write_record

    os.chdir(args.score / "unpacked" / "jobs")
    # Of trainings at a given rate the accuracy alone is asked for.
    asked = [job for job in campaign() if job.objective != "baseline" and job.rate is None]
    done = [job for job in asked if Path(job.name, "result.json").is_file()]
    chosen = [job for job in done if not args.only or re.search(args.only, job.name)]
    folder = DONE.parent / "records"
    known = {_subject(path) for path in folder.glob("*.json")}
    for (recordings, metric), job in product(BOARDS, chosen):
        name = f"local-dir:{job.name}/best" if job.trained else job.model
        if (name, DEMOS[recordings], metric, 0 if job.trained else job.seed) in known:
            continue
        record = score_record(name, recordings=recordings, metric=metric, weights_seed=0 if job.trained else job.seed)
        # The page draws no RDMs, which are nine tenths of a record.
        bare = {"model_rdm": (), "brain_rdm": ()}
        record = dataclasses.replace(
            record,
            score=dataclasses.replace(record.score, **bare),
            animal_to_animal=record.animal_to_animal and dataclasses.replace(record.animal_to_animal, **bare),
            baselines={name: dataclasses.replace(value, **bare) for name, value in record.baselines.items()},
        )
        write_record(record, folder)
        _log.info("%s on %s by %s: %.3f", job.name, recordings, metric, record.score.scaled)


def _subject(path: Path) -> tuple[str, str, str, int]:
    """Return what a record is of: the model's name, the recordings' stimuli, the metric and the seed of the weights."""
    found = json.loads(path.read_text(encoding="utf-8"))["score"]
    settings = found["provenance"]["settings"]
    return found["name"], str(settings["stimuli"]), str(settings["metric"]), int(settings["weights_seed"] or 0)


def lines_of(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a job's lines of the list: one, or one for each baseline."""
    found = result.pop("evaluations", None)
    if found is None:
        return [result]
    return [{**result, "name": name, "evaluation": value} for name, value in found.items()]


if __name__ == "__main__":
    main()
