"""The batched streaming step of encoders as front ends of policies: time per control step of all environments.

On a GPU: python -m benchmarks.policies.encoder_step --device cuda --out $OUT/policy_encoder.jsonl
On a processor: PYTHONPATH=. OMP_NUM_THREADS=1 python -m benchmarks.policies.encoder_step --batches 1 64 --write
Rows: eager or one recorded CUDA graph, state flat ([B, S], as policies keep it) or native, float32 or bf16. Each row is
printed and written when it is measured, small sizes first.
"""

from __future__ import annotations

import json
import statistics
import time
from pathlib import Path
from typing import Any

import torch

from benchmarks.report import publish, script_parser, table
from brainbench import load_model
from brainbench.models.export import StreamingStep

MODELS = ("zhuang-small", "zhuang-intersection-ln-small", "zhuang-intersection-ln")
GOALS = {"zhuang-intersection-ln-small": 3.0, "zhuang-intersection-ln": 40.0}
"""ms for 8,192 environments in bf16 on one H200 (issue 9)."""


def cast(value: Any, kind: torch.dtype, layout: torch.memory_format) -> Any:
    """Return a state in another precision and, for maps, memory layout."""
    if isinstance(value, torch.Tensor):
        value = value.to(kind)
        return value.contiguous(memory_format=layout) if value.ndim == 4 else value
    if isinstance(value, dict):
        return {key: cast(item, kind, layout) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return type(value)(cast(item, kind, layout) for item in value)
    if hasattr(value, "__dataclass_fields__"):
        return type(value)(**{name: cast(getattr(value, name), kind, layout) for name in value.__dataclass_fields__})
    return value


def copy_into(target: Any, source: Any) -> None:
    """Copy a state into fixed memory, for a graph to find it there again."""
    if isinstance(target, torch.Tensor):
        target.copy_(source)
    elif isinstance(target, dict):
        for key, item in target.items():
            copy_into(item, source[key])
    elif isinstance(target, (tuple, list)):
        for item, other in zip(target, source, strict=True):
            copy_into(item, other)
    elif hasattr(target, "__dataclass_fields__"):
        for name in target.__dataclass_fields__:
            copy_into(getattr(target, name), getattr(source, name))


def make(name: str, batch: int, device: str, kind: torch.dtype, state: str, compiled: bool) -> Any:
    """Return a function that advances all environments by one step, in place."""
    layout = torch.channels_last if device == "cuda" else torch.contiguous_format
    model = load_model(name).to(device, kind).to(memory_format=layout).eval()
    x = (torch.randn(batch, 30, 5, 7, device=device) * 1e-4).to(kind).contiguous(memory_format=layout)
    if state == "flat":
        step: Any = StreamingStep(model)
        h = step.init_state(batch)
        advance = torch.compile(step, dynamic=False) if compiled else step

        def run() -> torch.Tensor:
            features, after = advance(x, h)
            h.copy_(after)
            return features

        return run
    own = cast(model.init_state(batch), kind, layout)
    advance = torch.compile(model.encode_step, dynamic=False) if compiled else model.encode_step

    def run_native() -> torch.Tensor:
        features, after = advance(x, own)
        copy_into(own, after)
        return features

    return run_native


def timed(run: Any, device: str, graph: bool, repeats: int) -> dict[str, float]:
    """Return median and 90th percentile of a step in ms."""
    cuda = device == "cuda"
    with torch.inference_mode():
        for _ in range(3):
            run()
        if graph:
            recorded = torch.cuda.CUDAGraph()
            torch.cuda.synchronize()
            with torch.cuda.graph(recorded):
                run()
            run = recorded.replay
        found = []
        for _ in range(repeats):
            if cuda:
                torch.cuda.synchronize()
            start = time.perf_counter()
            run()
            if cuda:
                torch.cuda.synchronize()
            found.append(1e3 * (time.perf_counter() - start))
    found.sort()
    return {"ms": statistics.median(found), "p90": found[int(0.9 * (len(found) - 1))]}


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--batches", nargs="+", type=int, default=[1024, 8192])
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--compile", action="store_true", help="Also with torch.compile; takes minutes.")
    options = parser.parse_args()
    cuda = options.device == "cuda"
    kinds = ("float32", "bf16") if not cuda else ("bf16", "float32")
    rows = []
    print("model | batch | precision | state | way | ms | p90 | TFLOP/s | goal ms", flush=True)
    for batch in options.batches:
        for name in options.models:
            work = 2 * load_model(name).multiply_adds() * batch
            ways = [("eager", False), ("graph", False)] if cuda else [("eager", False)]
            ways += [("compiled graph", True)] if cuda and options.compile else []
            for kind in kinds[:1] if not cuda else kinds:
                for state in ("native", "flat"):
                    for way, compiled in ways:
                        row = {"model": name, "batch": batch, "precision": kind, "state": state, "way": way}
                        try:
                            run = make(
                                name, batch, options.device, torch.bfloat16 if kind == "bf16" else torch.float32, state,
                                compiled,
                            )  # fmt: skip
                            row |= timed(run, options.device, way.endswith("graph"), options.repeats)
                            row["tflops"] = work / row["ms"] / 1e9
                        except RuntimeError as error:
                            row["error"] = str(error).splitlines()[0][:200]
                        row["goal"] = GOALS.get(name) if batch == 8192 else None
                        rows.append(row)
                        shown = [row.get(key) for key in ("ms", "p90", "tflops")]
                        figures = " | ".join("–" if value is None else f"{value:.3g}" for value in shown)
                        print(
                            f"{name} | {batch} | {kind} | {state} | {way} | {figures} | {row['goal']} "
                            f"{row.get('error', '')}",
                            flush=True,
                        )
                        if options.out is not None:
                            with options.out.open("a", encoding="utf-8") as stream:
                                stream.write(json.dumps(row) + "\n")
    lines = [
        [
            row["model"], str(row["batch"]), row["precision"], row["state"], row["way"],
            f"{row.get('ms', float('nan')):.3g}", f"{row.get('p90', float('nan')):.3g}",
        ]
        for row in rows
    ]  # fmt: skip
    columns = ["model", "environments", "precision", "state", "way", "ms per step", "90th percentile"]
    publish(options, "Streaming step of encoders", table(columns, lines), f"--device {options.device} --batches …")


if __name__ == "__main__":
    main()
