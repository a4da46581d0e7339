"""Largest memory and duration of common jobs, each in a process of its own.

python -m benchmarks.scores.memory --out memory [--write]
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import measure_once, publish, script_parser, table
from tests.factories.recordings import LABELS

TITLE = "Memory per job"
UNITS, TRIALS, BIN = 1000, 600, 0.01
SIZES = (40, 80, 160, 320, 1280)  # stimuli


def write_big(path: Path, *, seconds: float = 1.0, least: float = 1.0) -> None:
    """Write a recording of 1,000 units and 600 trials; trials last between ``least`` and 1 of ``seconds``."""
    from brainbench.datasets import write_recordings
    from brainbench.datasets.sessions import make_session

    draw = np.random.default_rng(0)
    label, start = np.arange(TRIALS) % len(LABELS), 2 * seconds * np.arange(TRIALS)
    rates = draw.gamma(2.0, 4.0, (len(LABELS), UNITS))
    spikes = []
    for unit in range(UNITS):
        counts = draw.poisson(seconds * rates[label, unit])
        times = np.repeat(start, counts) + draw.uniform(0, seconds, counts.sum())
        spikes.append(np.sort(np.r_[0.0, times, 2 * seconds * TRIALS]))
    ends = start + seconds * draw.uniform(least, 1.0, TRIALS)
    table = {"start_time": start, "stop_time": ends, "stimulus": np.array(LABELS)[label]}
    write_recordings(path, make_session("m", "1", spikes, {"trials": table}))


def score_big(folder: Path, *, seconds: float = 1.0, least: float = 1.0, **options: Any) -> None:
    """Score features against the recording, in bins of 10 ms."""
    import brainbench

    path = folder / "big.h5"
    subprocess.run(
        [sys.executable, "-m", "benchmarks.scores.memory", "--prepare", str(path), str(seconds), str(least)], check=True
    )
    features = {"layer": np.random.default_rng(1).normal(size=(len(LABELS), 110, 50))}
    how: dict[str, Any] = {"stimuli": "rodgers", "bin": BIN, **options}
    found = brainbench.score(features, recordings=str(path), conditions="trials:stimulus", **how)
    assert np.isfinite(found.value), found


def score_demo(folder: Path, **options: Any) -> None:
    import brainbench

    brainbench.score("zhuang-intersection-ln-small", recordings="demo-rodgers", fidelity="fast", **options)


def train_small(folder: Path) -> None:
    from brainbench.models.training.config import TrainingConfig
    from brainbench.models.training.trainer import train
    from tests.factories.training_sweeps import tiny

    config = TrainingConfig.published("zhuang-small+gpt", "supervised", epochs=1, batch_size=64, precision="float32")
    train(config, tiny(train=256, validation=64, test=64), out=folder / "run", device="cpu")


def generate_sweeps(folder: Path) -> None:
    from brainbench.stimuli.sweeps.generation import generate
    from tests.factories.sweep_batches import small_plan

    generate(small_plan(("brick:24", "cone:24"), whiskers="C2,C3,D1", shard_size=32), folder / "set", workers=1)


def score_many(folder: Path, stimuli: int) -> dict[str, float]:
    """Score a network and its baselines by RSA against four animals of 50 units and 8 trials of each stimulus."""
    import h5py
    import torch
    from torch import nn

    from brainbench.datasets import write_recordings
    from brainbench.datasets.sessions import make_session
    from brainbench.scoring.scores import score_record

    draw, names = np.random.default_rng(0), [f"s{index:04d}" for index in range(stimuli)]
    frames = draw.normal(size=(stimuli, 3, 2, 2, 2)).astype(np.float32)
    with h5py.File(folder / "stimuli.h5", "w") as file:
        file["stimuli"], file["labels"] = frames, np.array(names, dtype=h5py.string_dtype())
    for animal in range(4):
        codes = draw.permutation(np.repeat(np.arange(stimuli), 8))
        drive = np.maximum(frames.reshape(stimuli, -1) @ draw.normal(size=(24, 20)) / 5, 0) @ draw.random((20, 50))
        counts, start = draw.poisson(drive[codes]), np.arange(len(codes)) * 1.0
        times = [np.repeat(start, unit) + draw.uniform(0.05, 0.4, unit.sum()) for unit in counts.T]
        spikes = [np.sort(np.r_[0.0, unit, float(len(codes))]) for unit in times]
        trials = {"start_time": start, "stop_time": start + 0.5, "stimulus": np.array(names)[codes]}
        session = make_session(f"m{animal}", "1", spikes, {"trials": trials})
        write_recordings(folder / "data" / f"m{animal}.h5", session)
    torch.manual_seed(0)
    network = nn.Sequential(nn.Flatten(), *(nn.Sequential(nn.Linear(24, 24), nn.ReLU()) for _ in range(4)))
    files: dict[str, Any] = {"recordings": str(folder / "data"), "stimuli": str(folder / "stimuli.h5")}
    begin = time.process_time()
    score_record(network, conditions="trials:stimulus", **files)
    return {"processor": time.process_time() - begin}


def prove(folder: Path, kind: str, features: int = 128) -> dict[str, float]:
    """Read layers for 40 stimuli of 10 steps; say how much longer than the pass that reads them it took."""
    import torch
    from torch import nn

    from brainbench.models import activations

    parts: dict[str, list[nn.Module]] = {
        "small": [nn.Flatten(1), nn.Linear(3000, 64), nn.ReLU(), nn.Linear(64, 64)],
        "wide": [nn.Flatten(1, 2), *(nn.Conv2d(size, 256, 3, padding=1) for size in (60, 256, 256))],
        "recurrent": [nn.Flatten(2), nn.LSTM(300, 512, 2, batch_first=True)],
        "attention": [nn.Flatten(2), nn.Linear(300, 128), nn.TransformerEncoderLayer(128, 4, batch_first=True)],
        "8 layers": [nn.Flatten(2), nn.Linear(300, features, bias=False), *(nn.Tanh() for _ in range(7))],
    }
    stimuli = torch.randn(40, 10, 6, 10, 5, generator=torch.Generator().manual_seed(0))
    network, once, spent, whole = nn.Sequential(*parts[kind]), activations._HookedReader._run_all, [], []

    def timed(spent: list[float], function: Any, *args: Any, **options: Any) -> None:
        begin = time.process_time()
        function(*args, **options)
        spent.append(time.process_time() - begin)

    activations._HookedReader._run_all = lambda *args: timed(spent, once, *args)  # type: ignore[method-assign]
    for _ in range(1 if features > 128 else 7):
        timed(whole, activations.extract, network, stimuli, reduce=lambda rows: rows.mean(axis=1, keepdims=True))
    return {"processor": whole[-1], "proof": float(np.median(np.divide(whole, spent)))}


JOBS: dict[str, Callable[[Path], dict[str, float] | None]] = {
    "score (demo, small network)": score_demo,
    "score, time averaged": score_big,
    "score, every time step kept": lambda folder: score_big(folder, time="concatenate"),
    "score, every time step kept, crossnobis": partial(score_big, time="concatenate", metric="rsa-crossnobis"),
    "score, every time step kept, trials of unequal length": partial(score_big, time="concatenate", least=0.7),
    "score, every time step kept, windows of 2 s": lambda folder: score_big(folder, time="concatenate", seconds=2.0),
    "score over time": lambda folder: score_big(folder, over_time=True),
    **{f"score and baselines, {count:,} stimuli": partial(score_many, stimuli=count) for count in SIZES},
    **{f"read layers, {kind}": partial(prove, kind=kind) for kind in ("small", "wide", "recurrent", "attention")},
    "read 8 layers of a million features": partial(prove, kind="8 layers", features=1_000_000),
    "explain": partial(score_demo, metric="rsa-correlation", explain=True),
    "stimuli sweep (192 sweeps)": generate_sweeps,
    "train (small, 256 sweeps)": train_small,
}


COLUMNS = {"largest memory [GB]": ("gigabytes", ".2f"), "duration [s]": ("seconds", ".0f"),
           "processor time [s]": ("processor", ".3g"), "× the pass that reads": ("proof", ".2f")}  # fmt: skip


def measure(name: str) -> dict[str, Any]:
    """Run a job in a process and return its largest memory [GB], which that process tells."""
    words = [sys.executable, "-m", "benchmarks.scores.memory", "--job", name]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    begin = time.monotonic()
    found = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return json.loads(found.stdout.splitlines()[-1]) | {"seconds": time.monotonic() - begin}


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("memory"), help="Folder; jobs measured there are kept.")
    parser.add_argument("--job", help="Run one job here and print its memory.")
    parser.add_argument("--prepare", nargs=3, help="Write a recording: file, seconds, least share of them.")
    parser.add_argument("--known", action="store_true", help="Measure nothing that does not stand in --out.")
    chosen = parser.parse_args()
    if chosen.prepare:
        path, seconds, least = chosen.prepare
        write_big(Path(path), seconds=float(seconds), least=float(least))
        return
    if chosen.job:
        with tempfile.TemporaryDirectory() as folder:
            more = JOBS[chosen.job](Path(folder)) or {}
        print(json.dumps({"gigabytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9} | more))
        return
    found = measure_once(chosen.out, JOBS, measure, known=chosen.known)
    rows = [
        [name, *(f"{item.get(key, math.nan):{form}}" for key, form in COLUMNS.values())] for name, item in found.items()
    ]
    text = f"{NOTE}\n\n{table(['job', *COLUMNS], [[cell.replace('nan', '–') for cell in row] for row in rows])}"
    publish(chosen, TITLE, text, "--out memory", subject="commands")


NOTE = (
    "Largest resident memory of a process that does one job (PyTorch, NumPy and the rest of the program, .4 to .7 GB, "
    f"are in it). Where nothing else is said, scores are of one session of {UNITS:,} units × {TRIALS} trials × 1 s in "
    f"bins of {BIN:g} s. Durations are with other work on the machine. Lines without a processor "
    "time are of 2026-11-22. Layers are read of 40 stimuli × 10 steps; the last column has what the proof adds."
)


if __name__ == "__main__":
    main()
