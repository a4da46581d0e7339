"""Estimated errors of whiskers beside their true ones, in scenes that no table was measured on, by the public command.

``python -m benchmarks.whiskers.errors [--seed 1] [--settings fast,auto=0.1] [--groups hard] [--rounds 3] [--write]``

The scenes are those of :mod:`tests.factories.contact_scenes`, one of each kind, and whiskers at rest that
objects strike, each a scene file of its own. ``brainbench stimuli simulate`` runs them: status, error and remark are
what it prints and writes. The truth is the converged simulation of the trade-off, for blows with steps of 1 µs.
Whiskers for which twice its step and two thirds of its links give other forces have no known truth, and stand in a
group of their own. The promise is that of ``Fidelity.auto(error=…)``: kept where the true error is no larger, or where
a remark says so.
"""

from __future__ import annotations

import io
import json
import math
import os
import tempfile
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.tradeoffs.whiskers import REFERENCE
from benchmarks.whiskers.scene_tables import write_scene
from brainbench.cli import app
from brainbench.core.statistics import wilson_interval
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.error_estimates import difference
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle, Trace
from brainbench.stimuli.motion.trajectories import Translation
from brainbench.stimuli.objects.solid import PlacedObject, box, capsule, sphere
from brainbench.stimuli.scenes.scene_files import load_scene
from brainbench.stimuli.stimulus_set import read_stimulus_set
from brainbench.stimuli.whiskers.array import SPECIES, WhiskerArray
from tests.factories.contact_scenes import HARD_OBJECTS, OBJECTS, contact_jobs

SPEEDS = (0.2, 0.7, 1.5, 2.9)
"""Speeds of the objects that strike [m/s]."""
LARGE = 0.2  # error that no whisker in good order may have
UNSETTLED = 0.05  # change of the truth with its step and links beyond which there is none
TIMED = 4  # each so many-th scene of a group is simulated again, for its cost
NO_LIMIT = "no limit"  # group of those whiskers


def struck_jobs(seed: int, count: int) -> list[Job]:
    """Return whiskers at rest that a post, a ball or a box strikes from a random side, with and without friction."""
    rng, jobs = np.random.default_rng(seed), []
    arrays = [WhiskerArray.of(species).mounts for species in SPECIES]
    for k in range(count):
        whisker, speed = arrays[k % 2][rng.integers(len(arrays[k % 2]))].whisker, SPEEDS[k % len(SPEEDS)]
        size = whisker.arc_length / 0.02 * rng.uniform(1, 2)
        kinds = capsule(4e-4 * size, 0.03), sphere(2e-3 * size), box((3e-3 * size, 3e-3 * size, 3e-3 * size))
        which = rng.integers(3)
        solid, half = kinds[which], (4e-4, 2e-3, 2.7e-3)[which] * size
        tilt = rng.uniform(-0.4, 0.4)
        way = np.array([math.sin(tilt) / 2, rng.choice([-1, 1]) * math.cos(tilt), rng.uniform(-0.5, 0.5)])
        way = speed * way / np.linalg.norm(way)
        place = np.append(whisker.centre_line(rng.uniform(0.4, 0.85) * whisker.arc_length), 0.0)
        # It is there after 2.3 ms.
        start, motion = place - way * ((half + whisker.base_radius) / speed + 2.3e-3), Translation(tuple(way), 0)
        struck = PlacedObject(solid, tuple(start), motion=motion, friction=float(rng.choice([0.0, 0.4])))
        times = np.arange(1e-3, max(0.03, 0.01 / speed), 1e-3)
        jobs.append(Job(whisker, StillFollicle(), (struck.obstacle(),), times))
    return jobs


@dataclass(frozen=True, eq=False)
class SceneRun:
    """A scene file, its job, and the finest simulation of that."""

    path: Path
    job: Job
    finest: Trace


def converged(jobs: Sequence[Job], fidelity: Fidelity, folder: Path) -> dict[bool, list[SceneRun]]:
    """Return the scenes whose finest simulation can be trusted and touches something, by whether it is the truth.

    Each is written into a folder of its own, and read from there.
    """
    paths = [write_scene(job, folder / str(index)) for index, job in enumerate(jobs)]
    jobs = [load_scene(path).scenes[0].jobs()[0] for path in paths]
    coarser = replace(fidelity, links=round(fidelity.links / 1.5), time_step=2 * fidelity.time_step)
    engine = get_engine("rod")
    traces, others = (engine.run(jobs, setting.resolved(True)) for setting in (fidelity, coarser))
    scenes: dict[bool, list[SceneRun]] = {True: [], False: []}
    for path, job, trace, coarse in zip(paths, jobs, traces, others, strict=True):
        if trace.status == "ok" and trace.contact.any():
            settled = coarse.status == "ok" and true_error(job, coarse, trace) <= UNSETTLED
            scenes[settled].append(SceneRun(path, job, trace))
    return scenes


def simulate(scene: Path, setting: str, backend: str) -> tuple[Trace, float]:
    """Run ``brainbench stimuli simulate``; return what it wrote and said of the whisker, and its processor time (s)."""
    out, said, before = scene.with_name("set.h5"), io.StringIO(), os.times()
    words = ["stimuli", "simulate", str(scene), "--fidelity", setting, "--backend", backend, "--out", str(out)]
    with redirect_stdout(said), redirect_stderr(io.StringIO()):
        app([*words, "--no-cache", "--explain", "--json"], standalone_mode=False)
    spent = sum(os.times()[:2]) - sum(before[:2])
    report, written = json.loads(said.getvalue()), read_stimulus_set(out).isel(stimulus=0, whisker=0)
    trace = Trace(
        written["wrench"].values.astype(float),
        written["contact"].values,
        written["contact_arc"].values,
        status="unstable" if report["unstable"] else "ok",
        remark="".join(entry["remark"] for entry in report["inexact"]),
        error=float(written["error"]),
        seconds=report["explanation"]["seconds"]["processor"],
    )
    return trace, spent


def measure(backend: str, setting: str, group: str, scenes: Sequence[SceneRun], rounds: int) -> list[str]:
    """Return a row of the table: true errors, how many estimates cover them, and the cost over some rounds."""
    promise, timed = Fidelity.parse(setting).error, scenes[::TIMED]
    first = [simulate(scene.path, setting, backend) for scene in scenes]
    repeated = [[simulate(scene.path, setting, backend) for scene in timed] for _ in range(rounds - 1)]
    repeated.append(first[::TIMED])
    whisker_time = sum(scene.job.times[-1] for scene in timed)
    costs = sorted(sum(trace.seconds for trace, _ in runs) / whisker_time for runs in repeated)
    whole = min(sum(spent for _, spent in runs) for runs in repeated) / len(timed)
    trusted = [
        (trace, true_error(scene.job, trace, scene.finest))
        for scene, (trace, _) in zip(scenes, first, strict=True)
        if trace.status == "ok"
    ]
    errors, estimates = np.array([(error, trace.error) for trace, error in trusted]).T
    silent = np.array([not trace.remark for trace, _ in trusted])
    covered = int((estimates >= errors).sum())
    interval = wilson_interval(covered, len(errors))
    return [
        setting, group, f"{len(errors)} of {len(scenes)}",
        *(f"{100 * np.quantile(errors, share):.3g}" for share in (0.5, 0.9, 1.0)),
        f"{covered / len(errors):.1%} [{interval.low:.1%}, {interval.high:.1%}]",
        *(f"{np.quantile(estimates / errors, share, method='higher'):.2g}" for share in (0.5, 0.9)),
        str(int((silent & (errors > LARGE)).sum())),
        str(int((silent & (errors > promise)).sum())) if promise else "–",
        str(int((~silent).sum())),
        f"{costs[len(costs) // 2]:.2g} [{costs[0]:.2g}, {costs[-1]:.2g}]",
        f"{whole:.2g}",
    ]  # fmt: skip


def true_error(job: Job, trace: Trace, reference: Trace) -> float:
    """Return the larger of the errors of base force and moment, as the estimate defines them."""
    touching = (trace.contact | reference.contact)[None]
    pair = difference(trace.wrench[None], reference.wrench[None], touching, np.array([job.whisker.arc_length]))
    return float(pair[0].max())


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--settings", default="fast,balanced,accurate,auto=0.2,auto=0.1,auto=0.05")
    parser.add_argument("--groups", default="one-side,hard,struck", help="slip-off: 72 of those alone")
    parser.add_argument("--rounds", type=int, default=3, help="times that scenes are simulated for their cost")
    parser.add_argument("--backend", default="rod")
    args = parser.parse_args()
    drawn = {
        "one-side": (contact_jobs(args.seed, each=1), REFERENCE),
        "hard": (contact_jobs(args.seed, each=1, objects=HARD_OBJECTS), REFERENCE),
        "struck": (struck_jobs(args.seed, 72), replace(REFERENCE, time_step=1e-6)),
        "slip-off": (contact_jobs(args.seed, each=4, objects=("slip-off",)), REFERENCE),
    }
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scenes_of = {name: converged(*drawn[name], Path(folder, name)) for name in args.groups.split(",")}
        groups = {name: scenes[True] for name, scenes in scenes_of.items()}
        groups[NO_LIMIT] = [scene for scenes in scenes_of.values() for scene in scenes[False]]
        for setting in args.settings.split(","):
            for group, scenes in groups.items():
                if scenes:
                    rows.append(measure(args.backend, setting, group, scenes, args.rounds))
                    print(rows[-1], flush=True)
    text = (
        f"`brainbench stimuli simulate SCENE --fidelity SETTING --backend {args.backend} --no-cache --explain --json "
        f"--out SET`, seed {args.seed}. One side: {', '.join(OBJECTS)}. Hard: {', '.join(HARD_OBJECTS)}. "
        f"Struck: at {', '.join(f'{speed:g}' for speed in SPEEDS)} m/s. Left out: what touches nothing or cannot be "
        "trusted at the finest setting. True error, in %, of base force or moment (root mean square over the "
        f"readings in contact, the larger) against `{REFERENCE}`, for blows with steps of 1 µs. Covered: the "
        "estimate is no smaller. In silence: without a remark. No limit: whiskers of all groups whose truth changes by "
        f"more than {UNSETTLED:.0%} with twice its step and two thirds of its links ("
        + ", ".join(f"{len(scenes[False])} {name}" for name, scenes in scenes_of.items())
        + "); their error is the difference from it. Cost: processor seconds of the simulation per whisker-second, as "
        f"`--explain` tells, with estimates: median and range of {args.rounds} rounds over one in {TIMED} scenes. "
        "Command: processor seconds of all that it does for one of them in a process that has run it before, least of "
        "the rounds.\n\n"
    )
    head = ["setting", "scenes", "trusted", "error %, median", "90 %", "worst", "covered", "estimate/error, median"]
    head += ["90 %", f"above {LARGE:.0%} in silence", "above the promise in silence", "remarks", "cost", "command s"]
    given = {name: value for name, value in vars(args).items() if value != parser.get_default(name)}
    words = " ".join(f"--{name} {value}" for name, value in given.items() if name != "write")
    title = "Errors of whiskers and their estimates" + (f": {args.groups}" if "groups" in given else "")
    publish(args, title, text + table(head, rows), words)


if __name__ == "__main__":
    main()
