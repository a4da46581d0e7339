"""Sweeps per second that users get: ``brainbench stimuli sweep --device cuda`` itself, beside the rate of its kernels.

python -m benchmarks.whiskers.public_rate [--objects procedural-24:2] [--gpus 1,2] [--cold]
    [--parts command,kernels,stages] [--write]

``command`` runs the command in a process of its own, timed from its start to its end: Python's start, objects, kernels,
whiskers that are simulated again, hashing and writing; with ``--cold`` also with an empty cache of kernels. ``kernels``
launches the same sweeps at once. ``stages`` runs the command in a process that tells when each shard was where.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import json
import multiprocessing
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.report import script_parser, table, write_section
from brainbench.stimuli.objects.collections import resolve_objects

if TYPE_CHECKING:
    from brainbench.stimuli.objects.collections import NamedObject
    from brainbench.stimuli.objects.solid import Solid

STARTED = time.time()
PARTS = ("kernels", "stages")
TITLE = "Sweeps on {}, by the public command"


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--recipe", default="thesis-high")
    parser.add_argument("--objects", default="procedural-24:2", help="208 sweeps of thesis-high each")
    parser.add_argument("--fidelity", action="append", help="can be repeated")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--limit", type=int, help="only the first sweeps of each object")
    parser.add_argument("--gpus", default="1", help="numbers of GPUs, by commas")
    parser.add_argument("--cold", action="store_true", help="first with an empty cache of kernels")
    parser.add_argument("--parts", default="command", help=f"of {', '.join(('command', *PARTS))}, by commas")
    parser.add_argument("--side-by-side", type=int, help="most shards at once on a GPU, of the stages")
    parser.add_argument("--whole", action="store_true", help="of the kernels: few whiskers without slices as well")
    parser.add_argument(
        "--ahead",
        help="of kernels and stages: tries ahead as '1:24' (a digit a try); for the kernels several, by commas",
    )
    parser.add_argument("--inside", choices=PARTS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    args.fidelity = args.fidelity or ["fast,links=12,time_step=1e-3"]
    if args.inside:
        {"kernels": kernels, "stages": stages}[args.inside](args)
        return
    body = ""
    for part in args.parts.split(","):
        if part == "command":
            body += commands(args)
            continue
        words = [sys.executable, "-m", "benchmarks.whiskers.public_rate", *sys.argv[1:], "--inside", part]
        told = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False).stdout
        print(told, flush=True)
        body += f"\n\n{part.capitalize()} (`{args.fidelity[0]}`):\n\n```\n{told.strip()}\n```"
    if args.write:
        kind = "processor" if args.device == "cpu" else "GPU" if args.gpus == "1" else "several GPUs"
        title = TITLE.format(kind if kind.startswith("several") else f"a {kind}")
        about = f"`brainbench stimuli sweep {' '.join(options(args, 'FIDELITY', Path('DIR')))}`\n\n"
        command = "python -m benchmarks.whiskers.public_rate " + " ".join(sys.argv[1:])
        where = "" if args.device == "cpu" else machine()
        write_section(title, command, about + body, subject="whiskers", where=where)


def commands(args: argparse.Namespace) -> str:
    """Return the table of the command's runs: with every fidelity, cold, then warm on each number of GPUs."""
    counts, rows = [int(word) for word in args.gpus.split(",")], []
    runs = [(counts[0], True)] * args.cold + [(count, False) for count in counts]
    with tempfile.TemporaryDirectory() as cache:
        # The runs after a cold one are warm because of it.
        environment = {**os.environ, **({"WARP_CACHE_PATH": cache} if args.cold else {})}
        for fidelity, (gpus, cold) in [(each, pair) for each in args.fidelity for pair in runs]:
            rows.append(row := run(args, fidelity, gpus, cold, environment))
            print(" | ".join(row), flush=True)
    names = ["fidelity", "run", "sweeps", "s", "sweeps/s", "processor s", "steps computed", "in full", "unstable"]
    return table([*names, "hash"], rows)


def options(args: argparse.Namespace, fidelity: str, out: Path) -> list[str]:
    """Return the arguments of the command."""
    limit = [] if args.limit is None else ["--limit", str(args.limit)]
    return [
        args.recipe, "--objects", args.objects, "--device", args.device, "--fidelity", fidelity, *limit,
        "--out", str(out),
    ]  # fmt: skip


def run(args: argparse.Namespace, fidelity: str, gpus: int, cold: bool, environment: dict[str, str]) -> list[str]:
    """Return a row of the table for one run of the command on so many GPUs."""
    folder = Path(tempfile.mkdtemp())
    if args.device != "cpu":
        # This process may itself see only some of the GPUs.
        seen = os.environ.get("CUDA_VISIBLE_DEVICES", ",".join(map(str, range(gpus)))).split(",")[:gpus]
        environment = {**environment, "CUDA_VISIBLE_DEVICES": ",".join(seen)}
    started, busy = time.perf_counter(), processor_seconds()
    made = subprocess.run(
        [sys.executable, "-m", "brainbench", "stimuli", "sweep", *options(args, fidelity, folder / "set"), "--json"],
        env=environment, stdout=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    seconds, busy = time.perf_counter() - started, processor_seconds() - busy
    shutil.rmtree(folder)
    where = "" if args.device == "cpu" else f", {gpus} GPU{'s' * (gpus > 1)}"
    row = [f"`{fidelity}`", f"{'cold' if cold else 'warm'}{where}"]
    if made.returncode:
        return [*row, f"failed with {made.returncode}", f"{seconds:.1f}", *[""] * 6]
    data = json.loads(made.stdout)
    return [
        *row, f"{data['sweeps']:,}", f"{seconds:.1f}", f"{data['sweeps'] / seconds:,.1f}", f"{busy:.1f}",
        f"{data['steps']:,}", f"{data['steps_in_full']:,}", str(data["unstable"]), data["content_hash"],
    ]  # fmt: skip


def processor_seconds() -> float:
    """Return the processor time (s) of all processes that ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def load_objects(words: list[str]) -> dict[str, Solid]:
    """Make objects, many of them on all processors as data generation does."""
    objects = resolve_objects(words, surfaces=True)
    processors = len(os.sched_getaffinity(0))
    if len(objects) < 64 or processors < 4:
        return {name: source.load() for name, source in objects.items()}
    with ProcessPoolExecutor(processors, mp_context=multiprocessing.get_context("spawn")) as pool:
        return dict(zip(objects, pool.map(_load, objects.values(), chunksize=4), strict=True))


def _load(source: NamedObject) -> Solid:
    return source.load()


def kernels(args: argparse.Namespace) -> None:
    """Print the rate of the kernels: all sweeps in one launch, then those that are simulated again."""
    from brainbench.core.files import content_hash
    from brainbench.stimuli import Fidelity
    from brainbench.stimuli.engines.rod.sweeps import SweepLauncher
    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes

    scenes = SweepScenes(GRIDS[args.recipe], load_objects([args.objects]))
    fidelity = Fidelity.parse(args.fidelity[0]).resolved(twist=True)
    launcher = SweepLauncher(scenes, fidelity, args.device)
    groups = [(name, scenes.grid.sweeps(name)[: args.limit]) for name in scenes.objects]
    launcher.launch(groups[:1])
    seen, count = _timed_launches(), sum(len(some) for _, some in groups)
    aheads = [_tries(word) for word in args.ahead.split(",")] if args.ahead else [launcher.ahead()]
    for ahead in aheads:
        launcher.ahead = lambda ahead=ahead: ahead
        print(f"ahead {ahead}")
        seen.clear()
        started = time.perf_counter()
        batch = launcher.trusted(groups, 5)
        seconds = time.perf_counter() - started
        for steps, whiskers, slices, spent in seen:
            print(
                f"{count:,} sweeps, steps / {steps}: {whiskers:,} whiskers, {slices:,} slices"
                f" of {1e3 * spent['kernel'] / max(slices, 1):.3f} ms, "
                + ", ".join(f"{name} {each:.2f} s" for name, each in spent.items()),
                flush=True,
            )
        first = seen[0][-1]["kernel"]
        every = sum(spent["kernel"] for *_, spent in seen)
        print(
            f"kernels {count / first:,.0f} sweeps/s; with whiskers again {count / every:,.0f}; "
            f"all {count / seconds:,.0f}; hash {content_hash(batch.wrench, batch.reasons, batch.steps)}",
            flush=True,
        )
    if args.whole:
        _few_at_once(launcher, groups, fidelity, args.device)


def _tries(word: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    first, then = word.split(":")
    return tuple(map(int, first)), tuple(map(int, then))


def _few_at_once(sliced: Any, groups: Any, fidelity: Any, device: str) -> None:
    """Print the time of whiskers that are simulated again in slices, and in one kernel of a warp for each."""
    from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

    which = sliced.launch(groups).verdict.retryable
    one = which & (which.cumsum().reshape(which.shape) == 1)
    whole = SweepLauncher(sliced.scenes, fidelity, device, sliced=False)
    for block in (1, 64):
        whole.solver.block = {"block_dim": block}
        started = time.perf_counter()
        whole.launch(groups, [(one, 5)])
        seconds = time.perf_counter() - started
        print(f"one kernel, blocks of {block}: first whisker {seconds:.1f} s, with compiling", flush=True)
        whole.launch(groups, [(one, 5)])
        print(f"  again {whole.seconds['kernel']:.2f} s, in slices ", end="")
        sliced.launch(groups, [(one, 5)])
        print(f"{sliced.seconds['kernel']:.2f} s", flush=True)
        found = whole.launch(groups, [(which, 5)])
        print(f"  all {which.sum():,} whiskers {whole.seconds['kernel']:.2f} s, in slices ", end="", flush=True)
        other = sliced.launch(groups, [(which, 5)])
        same = (found.wrench == other.wrench).all()
        print(f"{sliced.seconds['kernel']:.2f} s; same to the last digit: {same}", flush=True)


def _timed_launches() -> list[tuple[str, int, int, dict[str, float]]]:
    """Return a list to which every launch from now on adds its divisors, whiskers, slices and seconds by stage."""
    from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

    seen: list[tuple[str, int, int, dict[str, float]]] = []
    launch = SweepLauncher.launch

    def timed(self: Any, objects: Any, tries: Any = ()) -> Any:
        started = time.perf_counter()
        result = launch(self, objects, launch)
        spent = {**self.seconds, "all": time.perf_counter() - started}
        steps = " and ".join(str(finer) for _, finer in launch) or "1"
        seen.append((steps, result.verdict.until.size, self.solver.slices, spent))
        return result

    SweepLauncher.launch = timed  # type: ignore[method-assign]
    return seen


def stages(args: argparse.Namespace) -> None:
    """Run the command in this process, and print when each shard was where and what its stages took."""
    from brainbench.cli import app
    from brainbench.stimuli.engines.rod import launch
    from brainbench.stimuli.sweeps import generation

    seen, moments, lock = _timed_launches(), [], threading.Lock()
    if args.ahead:
        launch.ON_AN_IDLE_GPU = _tries(args.ahead)
    if args.side_by_side:
        generation.SIDE_BY_SIDE = args.side_by_side
    totals: dict[str, float] = {}

    def timed(what: str, name: str) -> None:
        real = getattr(generation, name)

        def call(first: Any, *rest: Any) -> Any:
            begun = time.time()
            result = real(first, *rest)
            with lock:
                totals[what] = totals.get(what, 0.0) + time.time() - begun
                task = getattr(first, "task", first)
                moments.append((what, task.name, begun - STARTED, time.time() - STARTED))
            return result

        setattr(generation, name, call)

    timed("load kernels", "warm_up")
    timed("simulate", "simulate_shard")
    timed("hash and write", "write_shard")
    signal.signal(signal.SIGTERM, _tell_and_stop)
    folder, told = Path(tempfile.mkdtemp()), io.StringIO()
    words = ["stimuli", "sweep", *options(args, args.fidelity[0], folder / "set"), "--json"]
    try:
        with redirect_stdout(told):
            app(words, standalone_mode=False)
        made, total = json.loads(told.getvalue()), time.time() - STARTED
        print(
            f"{made['sweeps']:,} sweeps in {total:.1f} s, {made['sweeps'] / total:,.0f} sweeps/s, at most "
            f"{generation.SIDE_BY_SIDE} shards at once on a GPU, {made['unstable']} unstable, "
            f"hash {made['content_hash']}"
        )
    except BaseException as error:  # noqa: BLE001 - what was measured until then is worth seeing
        print(f"ended after {time.time() - STARTED:.1f} s by {error!r}")
    finally:
        shutil.rmtree(folder)
    for what, name, begun, ended in sorted(moments, key=lambda moment: moment[2]):
        print(f"  {what:15s} {name:16s} {begun:7.2f} to {ended:7.2f} s")
    for steps in dict.fromkeys(steps for steps, *_ in seen):
        some = [item for item in seen if item[0] == steps]
        spent = sum((Counter(item[-1]) for item in some), Counter())
        print(
            f"  steps / {steps}: {len(some)} launches, {sum(item[1] for item in some):,} whiskers, "
            f"{sum(item[2] for item in some):,} slices; thread seconds: "
            + ", ".join(f"{name} {seconds:.2f}" for name, seconds in spent.items())
        )
    print("  thread seconds: " + ", ".join(f"{name} {seconds:.2f}" for name, seconds in totals.items()), flush=True)


def _tell_and_stop(*_: Any) -> None:
    """Show where every thread is, then stop as by Ctrl-C."""
    faulthandler.dump_traceback(all_threads=True)
    raise KeyboardInterrupt


def machine() -> str:
    """Return the GPU and how many processors there are."""
    from brainbench.core.devices import usable_processors, warp

    names = [device.name for device in warp().get_cuda_devices()] or ["no GPU"]
    return f"{len(names)} × {names[0]}, {usable_processors()} processors"


if __name__ == "__main__":
    main()
