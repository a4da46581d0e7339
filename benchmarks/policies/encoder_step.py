"""The batched streaming step of encoders as front ends of policies: time per control step of all environments.

On a GPU: python -m benchmarks.policies.encoder_step --device cuda
On a processor: PYTHONPATH=. OMP_NUM_THREADS=1 python -m benchmarks.policies.encoder_step --batches 1 64 --write
Rows: eager or one recorded CUDA graph, state flat ([B, S], as policies keep it), float32 or bf16. Each row is printed
when it is measured, small sizes first.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report import publish, script_parser, table
from benchmarks.timing import seconds
from brainbench import load_model
from brainbench.models.export import StreamingStep

MODELS = ("zhuang-small", "zhuang-intersection-ln-small", "zhuang-intersection-ln")
GOALS = {"zhuang-intersection-ln-small": 3.0, "zhuang-intersection-ln": 40.0}
"""ms for 8,192 environments in bf16 on one H200 (issue 9)."""


def make(name: str, batch: int, device: str, kind: torch.dtype) -> Callable[[], torch.Tensor]:
    """Return a function that advances all environments by one step, in place."""
    layout = torch.channels_last if device == "cuda" else torch.contiguous_format
    model = load_model(name).to(device, kind).to(memory_format=layout).eval()
    x = (torch.randn(batch, 30, 5, 7, device=device) * 1e-4).to(kind).contiguous(memory_format=layout)
    step = StreamingStep(model)
    h = step.init_state(batch)

    def run() -> torch.Tensor:
        features, after = step(x, h)
        h.copy_(after)
        return features

    return run


def timed(run: Callable[[], object], device: str, graph: bool, repeats: int) -> NDArray[np.float64]:
    """Return median and 90th percentile of a step in ms."""
    wait = torch.cuda.synchronize if device == "cuda" else None
    with torch.inference_mode():
        if graph:
            seconds(run, 0, warm=3)
            recorded = torch.cuda.CUDAGraph()
            torch.cuda.synchronize()
            with torch.cuda.graph(recorded):
                run()
            run = recorded.replay
        return 1e3 * np.quantile(seconds(run, repeats, warm=3, wait=wait), (0.5, 0.9))


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--batches", nargs="+", type=int, default=[1024, 8192])
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    cuda = options.device == "cuda"
    kinds = {"bf16": torch.bfloat16, "float32": torch.float32} if cuda else {"float32": torch.float32}
    rows = []
    for batch, name, kind in itertools.product(options.batches, options.models, kinds):
        for graph in (False, True) if cuda else (False,):
            run = make(name, batch, options.device, kinds[kind])
            median, late = timed(run, options.device, graph, options.repeats)
            rate = 2 * load_model(name).multiply_adds() * batch / median / 1e9
            figures = [f"{value:.3g}" for value in (median, late, rate)]
            goal = f"{GOALS[name]:g}" if name in GOALS and batch == 8192 else ""
            rows.append([name, f"{batch:,}", kind, "graph" if graph else "eager", *figures, goal])
            print(*rows[-1], flush=True)
    columns = ["model", "environments", "precision", "way", "ms per step", "90th percentile", "TFLOP/s", "goal ms"]
    publish(options, "Streaming step of encoders", table(columns, rows), f"--device {options.device} --batches …")


if __name__ == "__main__":
    main()
