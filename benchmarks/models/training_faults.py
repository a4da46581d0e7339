"""First gradients of training on sweeps that are silent for a time, under layer norm and without it.

    python -m benchmarks.models.training_faults silence SWEEPS [--write]

``SWEEPS`` is a folder of ``brainbench stimuli sweep``.
"""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from unittest.mock import patch

import torch

from benchmarks.report import publish, script_parser, table
from brainbench.datasets import WhiskingDataset
from brainbench.models.ops.seeding import seeded
from brainbench.models.registry import load_model
from brainbench.models.training.objectives import make_learner

BATCH = 24
SMALL = (
    "zhuang-intersection-ln-small", "zhuang-small", "resnet18-small", "s4-small+gpt", "zhuang-small+mamba",
    "resnet18-small+gpt",
)  # fmt: skip
"""Encoders with memory of three kinds and none; attenders GPT, Mamba and none."""


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


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("part", choices=("silence",))
    parser.add_argument("sweeps", type=Path)
    args = parser.parse_args()
    text = silence(args.sweeps)
    publish(args, "First gradients and silence", text, "silence SWEEPS")


if __name__ == "__main__":
    main()
