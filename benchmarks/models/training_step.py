"""Speed of a training step and of its forward pass; peers measured in the same run.

    python -m benchmarks.models.training_step --model zhuang-intersection-ln+gpt --batch 256

The peer is what a reader of the published description would write: a loop over time steps and, within it, over areas;
inputs concatenated, convolved, concatenated with the state and convolved again; every step's outputs kept; float32. It
computes the same function with the same weights (checked). ``ceiling`` is the fastest square matrix product of the
device in the same precision.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any
from unittest import mock

import numpy as np
import torch

from benchmarks.report import publish, script_parser, table
from benchmarks.timing import seconds
from brainbench.core.devices import record_step
from brainbench.models.activations import evaluating
from brainbench.models.ops import dispatch
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.objectives import compiled, fuse

STEPS = 22


def make_capturable(optimizer: torch.optim.Optimizer, rate: torch.Tensor) -> None:
    """Let an optimiser read its learning rate from a tensor [] on its device, and keep its counters there."""
    for group in optimizer.param_groups:
        group["lr"] = rate
        if "fused" in group:
            group["fused"], group["foreach"] = True, False
        if "capturable" in group:
            group["capturable"] = rate.is_cuda


def plain() -> Any:
    """A context that leaves everything to PyTorch's own operations, to compare with."""
    return mock.patch.object(dispatch, "TRITON", False)


class Loop(torch.nn.Module):
    """The peer: a model's graph unrolled over nodes and time steps, one after the other."""

    def __init__(self, model: Any) -> None:
        super().__init__()
        self.model = model

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        model, graph = self.model, self.model.encoder
        x = model.normaliser(x)
        outputs = {name: x.new_zeros(len(x), *graph.shapes[name]) for name in graph.layers}
        memories, features = {}, []
        for t in range(x.shape[1]):
            new = {}
            for name in graph.layers:
                node = graph.node(name)
                inputs = [x[:, t]] if name in graph.spec.inputs else []
                inputs += [outputs[edge.source] for edge in graph.spec.predecessors[name]]
                y = node.operate(inputs)
                if node.memory is not None:
                    y, memories[name] = node.memory(y, memories.get(name))
                new[name] = node.after(y)
            outputs = new
            features.append(outputs[graph.spec.output])
        features = torch.stack(features, 1)
        if model.attender is not None:
            features = model.attender(features)
        return model.decoder(features[:, -1])


def clock(device: torch.device, work: Callable[[], Any], repeats: int, warm: int = 2) -> float:
    """Return the median seconds of one call."""
    wait = torch.cuda.synchronize if device.type == "cuda" else None
    return float(np.median(seconds(work, repeats, warm=warm, wait=wait)))


def ceiling(device: torch.device, dtype: torch.dtype) -> float:
    """Return the best measured matrix rate [FLOP/s]."""
    best = 0.0
    for size in (1024, 2048) if device.type == "cpu" else (4096, 8192, 16384):
        a = torch.randn(size, size, device=device).to(dtype)
        best = max(best, 2 * size**3 / clock(device, lambda a=a: a @ a, 3))
    return best


def sweeps(batch: int, device: torch.device) -> torch.Tensor:
    scale = torch.tensor(([1e-4] * 3 + [1e-6] * 3) * 5)[:, None, None]
    generator = torch.Generator().manual_seed(0)
    return (torch.randn(batch, STEPS, 30, 5, 7, generator=generator) * scale).to(device)


def training_step(module: Any, model: Any, x: torch.Tensor, labels: torch.Tensor, autocast: Any) -> Callable[[], None]:
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-4, fused=x.is_cuda)
    if x.is_cuda:
        make_capturable(optimizer, torch.full((), 1e-4, device=x.device))

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        with autocast():
            loss = torch.nn.functional.cross_entropy(module(x).float(), labels)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()

    return step


def compare(options: argparse.Namespace, device: torch.device) -> str:
    """Return the table of all ways to compute a step."""
    x = sweeps(2, device)
    model = load_model(options.model).to(device).eval()
    with torch.no_grad():
        torch.testing.assert_close(Loop(model)(x), model(x), atol=1e-3, rtol=1e-3)
    operations = 2 * describe_model(options.model).multiply_adds * STEPS
    rows, rates, failed = [], {}, []
    ceilings = {"float32": ceiling(device, torch.float32), "bf16": ceiling(device, torch.bfloat16)}
    print("ceilings [TFLOP/s]", {key: round(value / 1e12, 3) for key, value in ceilings.items()}, flush=True)
    for who in options.who.split(","):
        peer, precision, how = who.split(":")
        timed = time_apart(options, who)
        if isinstance(timed, str):
            failed.append(f"{who}: {timed}")
            print(failed[-1], flush=True)
            continue
        first, seconds, forward, memory = timed
        rates[who] = options.batch / seconds
        share = 3 * operations * options.batch / seconds / ceilings[precision]
        share_forward = operations * options.batch / forward / ceilings[precision]
        cells = [f"{first:.1f}", f"{seconds * 1e3:,.1f}", f"{rates[who]:,.1f}", f"{share:.0%}"]
        rows.append(
            [peer, precision, how, *cells, f"{options.batch / forward:,.1f}", f"{share_forward:.0%}", f"{memory:.1f}"]
        )
        print(rows[-1], flush=True)
    head = ["who", "precision", "compiled", "first step s", "step ms", "sweeps/s", "of ceiling", "forward sweeps/s"]
    head += ["of ceiling", "memory GB"]
    reference = rates.get("loop:float32:off")
    if not rates:
        return "\n".join(failed)
    best = max(rates, key=lambda who: rates[who])
    text = (
        f"{options.model}, batch {options.batch} × {STEPS} steps. Ceiling: float32 {ceilings['float32'] / 1e12:.3g}, "
    )
    text += f"bf16 {ceilings['bf16'] / 1e12:.3g} TFLOP/s.\n\n{table(head, rows)}\n\nFastest: {best}"
    text += f", {rates[best] / reference:.2f} × the float32 loop" if reference else ""
    peers = [rate for who, rate in rates.items() if who.startswith("loop") and who != "loop:float32:off"]
    text += f", {rates[best] / max(peers):.2f} × the best other loop" if peers else ""
    hours = 100 * 100_000 / rates[best] / 60
    text += f". 100 epochs of 100,000 sweeps: {hours:,.0f} minutes."
    return text + "".join(f"\n\nNot measured: {reason}." for reason in failed)


def time_apart(options: argparse.Namespace, who: str) -> list[float] | str:
    """Return what :func:`time_one` finds in a process of its own, or why it found nothing."""
    words = [sys.executable, "-m", __spec__.name, "--one", who, "--model", options.model, "--batch", str(options.batch)]
    words += ["--repeats", str(options.repeats), "--device", options.device]
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=options.limit, check=False)
    except subprocess.TimeoutExpired:
        return f"not done after {options.limit:g} s"
    if done.returncode:
        print(done.stderr[-1500:], flush=True)
        return f"failed ({done.stderr.strip().splitlines()[-1][:200]})"
    return json.loads(done.stdout.strip().splitlines()[-1])


def time_one(options: argparse.Namespace, device: torch.device) -> tuple[float, float, float, float]:
    """Return seconds of the first step, of a step and of a forward pass, and the memory at most [GB]."""
    peer, precision, how = options.one.split(":")
    x, labels = sweeps(options.batch, device), torch.randint(117, (options.batch,), device=device)

    def autocast() -> Any:
        return torch.autocast(device.type, dtype=torch.bfloat16) if precision == "bf16" else nullcontext()

    if device.type == "cuda":
        torch.backends.cudnn.benchmark = True
    model = load_model(options.model).to(device).train()
    recorded = how in ("captured", "plain", "graphs") and device.type == "cuda" and peer == "ours"
    if device.type == "cuda" and peer == "ours":
        model = model.to(memory_format=torch.channels_last)
    fuse(model, how in ("fused", "graphs"))
    module = Loop(model) if peer == "loop" else model
    if how in ("parts", "default"):
        module = compiled(module, how)
    elif how == "graphs" and peer == "loop":
        module = torch.compile(module, mode="reduce-overhead")
    start = time.perf_counter()
    step = training_step(module, model, x, labels, autocast)
    if recorded:
        step = record_step(step, device)
    step()
    if device.type == "cuda":
        torch.cuda.synchronize()
    first = time.perf_counter() - start
    seconds = clock(device, step, options.repeats, warm=1)

    def forward() -> None:
        with autocast():
            module(x)

    with evaluating(model), torch.no_grad():
        answer = record_step(forward, device) if recorded else forward
        spent = clock(device, answer, options.repeats, warm=1)
    memory = torch.cuda.max_memory_allocated() / 1e9 if device.type == "cuda" else float("nan")
    return first, seconds, spent, memory


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--model", default="zhuang-intersection-ln-small")
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument(
        "--who",
        default="loop:float32:off,loop:bf16:off,ours:float32:off,ours:bf16:off",
        help="comma-separated PEER:PRECISION:COMPILED with loop|ours, float32|bf16, off|parts|default|graphs, for ours "
        "also captured (recorded), plain (recorded, without our kernels) and fused (cells compiled); graphs is both",
    )
    parser.add_argument("--limit", type=float, default=240.0, help="seconds that one row may take")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    device = torch.device(options.device)
    if options.one:
        peer, _, how = options.one.split(":")
        # A peer is what anybody would write with PyTorch.
        with plain() if peer == "loop" or how == "plain" else nullcontext():
            print(json.dumps(time_one(options, device)))
        return
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{torch.get_num_threads()} threads"
    words = f"--model {options.model} --batch {options.batch}"
    publish(options, f"Training step ({options.model}, {device.type})", f"{name}. {compare(options, device)}", words)


if __name__ == "__main__":
    main()
