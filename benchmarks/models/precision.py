"""What lower precision, another unrolling and fewer steps cost a network: error, latency, size, score and accuracy.

python -m benchmarks.models.precision NAME … [--precisions float32,bf16,int8] [--steps 11,22] [--score] [--data SWEEPS]

Every setting is compared with the same network in float32, unrolled biologically over all steps of the demo's sweeps.
``bf16`` computes in mixed precision; ``int8`` stores weights in 8 bits, one scale per output channel, and computes in
float32.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

import brainbench
from benchmarks.report import publish, script_parser, table
from benchmarks.timing import seconds
from brainbench.datasets import WhiskingDataset
from brainbench.models.registry import load_model
from brainbench.models.training.evaluation import evaluate
from brainbench.stimuli import load_stimuli

BYTES = {"float32": 4, "bf16": 2, "int8": 1}
REPEATS = 5  # sweeps that are timed, after one that is not


class Reduced(nn.Module):
    """A network run in one setting; it can be scored and extracted from like the network itself."""

    def __init__(self, name: str, precision: str, unroll: str, steps: int) -> None:
        super().__init__()
        options: dict[str, Any] = {} if unroll == "biological" else {"unroll": unroll}
        self.model: Any = load_model(name, **options)
        self.precision, self.steps = precision, steps
        if precision == "int8":
            round_weights(self.model)
        self.layers: tuple[str, ...] = self.model.layers
        self.spec = self.model.spec

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the answer [B, classes] to the sweep's last steps."""
        with self._autocast(x):
            return self.model(x[:, -self.steps :]).float()

    def activations(self, x: torch.Tensor, layers: Collection[str] | None = None) -> dict[str, torch.Tensor]:
        """Return ``{layer: [B, steps, ...]}`` of the sweep's last steps."""
        with self._autocast(x):
            return self.model.activations(x[:, -self.steps :], layers)

    def stored_bytes(self) -> int:
        """Return the size of the weights as they would be stored."""
        return sum(p.numel() * (BYTES[self.precision] if p.ndim > 1 else 4) for p in self.model.parameters())

    def _autocast(self, x: torch.Tensor) -> Any:
        return torch.autocast(x.device.type, torch.bfloat16, enabled=self.precision == "bf16")


@torch.no_grad()
def round_weights(model: nn.Module) -> None:
    """Round every weight of more than one axis to 8 bits, symmetrically, with one scale per output channel."""
    for weight in model.parameters():
        if weight.ndim > 1:
            scale = weight.flatten(1).abs().amax(1).clamp_min(1e-30).view(-1, *(1,) * (weight.ndim - 1)) / 127
            weight.copy_((weight / scale).round() * scale)


def main() -> None:
    """Measure every combination and print a table."""
    parser = script_parser(__doc__)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--precisions", default="float32,bf16,int8")
    parser.add_argument("--unrolls", default="biological")
    parser.add_argument("--steps", default="22")
    parser.add_argument("--score", action="store_true", help="also score every setting on the demo recordings")
    parser.add_argument("--data", type=Path, help="folder of sweeps: also measure test accuracy")
    args = parser.parse_args()
    x = torch.as_tensor(load_stimuli("rodgers", whiskers="all", fidelity=None).input, dtype=torch.float32)
    settings = product(args.names, args.precisions.split(","), args.unrolls.split(","), map(int, args.steps.split(",")))
    rows = []
    for name, precision, unroll, steps in settings:
        network = Reduced(name, precision, unroll, steps)
        with torch.no_grad():
            expected, answers = load_model(name)(x), network(x)
            times = 1e3 * seconds(lambda network=network: network(x[:1]), REPEATS)
        error = float((answers - expected).norm() / expected.norm().clamp_min(1e-30))
        p50, p99 = np.percentile(times, [50, 99])
        score = f"{brainbench.score(network).value:.3f}" if args.score else ""
        accuracy = evaluate(network, WhiskingDataset(args.data, split="test", shuffle=False)) if args.data else None
        top1 = "" if accuracy is None else f"{accuracy.top1:.3f}"
        size = f"{network.stored_bytes() / 1e6:.2f}"
        rows.append(
            [name, precision, unroll, str(steps), f"{error:.2%}", f"{p50:.2f}", f"{p99:.2f}", size, score, top1]
        )
    columns = ["network", "precision", "unrolling", "steps", "error", "ms / sweep", "p99 ms", "MB", "score", "top-1"]
    publish(args, "What less precision costs a network", table(columns, rows), " ".join(args.names))


if __name__ == "__main__":
    main()
