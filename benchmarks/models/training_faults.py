"""What goes wrong in training, and what becomes of it: silence under layer norm, and kills.

    python -m benchmarks.models.training_faults silence SWEEPS [--write]
    python -m benchmarks.models.training_faults kills SWEEPS [--write]

``SWEEPS`` is a folder of ``brainbench stimuli sweep``.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import patch

import torch
from safetensors.torch import load_file

from benchmarks.report import table, write_section
from brainbench.datasets import WhiskingDataset
from brainbench.models.ops.seeding import seeded
from brainbench.models.registry import load_model
from brainbench.models.training.objectives import make_learner

BATCH = 24
MODEL = "resnet18-small"
SMALL = (
    "zhuang-intersection-ln-small", "zhuang-small", "resnet18-small", "s4-small+gpt", "zhuang-small+mamba",
    "resnet18-small+gpt",
)  # fmt: skip
"""Encoders with memory of three kinds and none; attenders GPT, Mamba and none."""
MOMENTS = (0.15, 0.85)
"""Kills fall between these shares of what an unbroken run takes."""


def first_gradient(name: str, objective: str, x: torch.Tensor, labels: torch.Tensor, *, drawn: bool) -> float:
    """Return the norm of the first gradient of training."""
    with nullcontext() if drawn else patch("brainbench.models.ops.layers.draw_silent_biases"):
        model = load_model(name, classes=int(labels.max()) + 1)
    with seeded(0):
        learner = make_learner(objective, model.train())
    loss = learner((x, 1.1 * x)[: learner.views], labels)
    loss.backward()
    return float(torch.stack([p.grad.norm() for p in model.parameters() if p.grad is not None]).norm())


def silence(folder: Path) -> str:
    """First gradients with biases of zero and as untrained networks draw them."""
    x, labels = next(iter(WhiskingDataset(folder, split="train", batch_size=BATCH, shuffle=True, seed=0)))
    silent = float((x == 0).flatten(2).all(2).float().mean())
    rows = []
    for name in SMALL:
        ways = [(objective, drawn) for objective in ("supervised", "simclr") for drawn in (False, True)]
        norms = [first_gradient(name, objective, x, labels, drawn=drawn) for objective, drawn in ways]
        rows.append([name, *(f"{norm:.3g}" for norm in norms)])
        print(rows[-1], flush=True)
    head = ["network", "supervised, zero biases", "drawn", "SimCLR, zero biases", "drawn"]
    return (
        f"Norm of the gradient at the first step, {BATCH} sweeps, {silent:.0%} of whose time steps are exactly zero. "
        f"Networks without layer norm are not changed.\n\n{table(head, rows)}"
    )


def run(folder: Path, out: Path, kill_after: float | None) -> bool:
    """Start training; kill it after some seconds. Return whether it came to its end."""
    words = [sys.executable, "-m", "brainbench", "train", MODEL, "--data", str(folder), "--out", str(out), "--epochs"]
    words += ["3", "--batch-size", "32", "--device", "cpu", "--json"]
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        return process.wait(kill_after) == 0
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return False


def kills(folder: Path, count: int) -> str:
    """The same run unbroken, and killed at random moments and started again."""
    rows = []
    with tempfile.TemporaryDirectory() as place:
        whole, broken = Path(place) / "whole", Path(place) / "broken"
        started = time.perf_counter()
        if not run(folder, whole, None):
            raise SystemExit("The unbroken run failed.")
        seconds = time.perf_counter() - started
        moments = random.Random(0)
        for _ in range(count):
            after = seconds * moments.uniform(*MOMENTS)
            rows.append([f"{after:.1f} s", "ended before" if run(folder, broken, after) else "killed"])
            print(rows[-1], flush=True)
        if not run(folder, broken, None):
            raise SystemExit("The killed run cannot be gone on with.")
        first, second = (load_file(path / "best" / "model.safetensors") for path in (whole, broken))
        apart = max(float((first[name] - second[name]).abs().max()) for name in first)
        equal = all(torch.equal(first[name], second[name]) for name in first)
    return (
        f"`brainbench train {MODEL}` (3 epochs, batch 32, CPU), {seconds:.0f} s unbroken; killed with SIGKILL after\n\n"
        f"{table(['after start', ''], rows)}\n\nand started once more: weights "
        f"{'equal to the bit' if equal else 'differ'} (largest difference {apart:g})."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("part", choices=("silence", "kills"))
    parser.add_argument("sweeps", type=Path)
    parser.add_argument("--count", type=int, default=3, help="kills")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    text = silence(args.sweeps) if args.part == "silence" else kills(args.sweeps, args.count)
    print(text)
    if args.write:
        title = "First gradients and silence" if args.part == "silence" else "Training killed and resumed"
        write_section(
            title, f"python -m benchmarks.models.training_faults {args.part} SWEEPS --write", text, subject="models"
        )


if __name__ == "__main__":
    main()
