"""Speed of a training step, of a forward pass, of streaming and of long sweeps; peers measured in the same run.

    python -m benchmarks.models.training_step --part train --model zhuang-intersection-ln+gpt --batch 256
    python -m benchmarks.models.training_step --part stream --model zhuang-intersection-ln-small
    python -m benchmarks.models.training_step --part length

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
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from benchmarks.report import publish, script_parser, table
from brainbench.core.devices import record_step
from brainbench.models.activations import evaluating
from brainbench.models.export import StreamingStep, export_model, read_onnx
from brainbench.models.ops import dispatch
from brainbench.models.ops.layers import packed
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
    for _ in range(warm):
        work()
    times = []
    for _ in range(repeats):
        if device.type == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def ceiling(device: torch.device, dtype: torch.dtype) -> float:
    """Return the best measured matrix rate [FLOP/s]."""
    best = 0.0
    for size in (1024, 2048) if device.type == "cpu" else (4096, 8192, 16384):
        a = torch.randn(size, size, device=device).to(dtype)
        best = max(best, 2 * size**3 / clock(device, lambda a=a: a @ a, 3))
    return best


def sweeps(batch: int, device: torch.device, steps: int = STEPS) -> torch.Tensor:
    scale = torch.tensor(([1e-4] * 3 + [1e-6] * 3) * 5)[:, None, None]
    generator = torch.Generator().manual_seed(0)
    return (torch.randn(batch, steps, 30, 5, 7, generator=generator) * scale).to(device)


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


def train_part(options: argparse.Namespace, device: torch.device) -> str:
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
    head = [
        "who",
        "precision",
        "compiled",
        "first step s",
        "step ms",
        "sweeps/s",
        "of ceiling",
        "forward sweeps/s",
        "of ceiling",
        "memory GB",
    ]
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


def forward_part(options: argparse.Namespace, device: torch.device) -> str:
    x = sweeps(options.batch, device)
    model = load_model(options.model).to(device)
    operations = 2 * describe_model(options.model).multiply_adds * STEPS * options.batch
    rows = []
    for precision, dtype in (("float32", torch.float32), ("bf16", torch.bfloat16)):
        with torch.no_grad(), torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bf16"):
            model(x[:8])
            pairs = []
            for _ in range(options.repeats):
                # Taken in turns, since others use the machine too.
                before = ceiling(device, dtype)
                seconds = clock(device, lambda: model(x), 1, warm=0)
                pairs.append((operations / seconds, max(before, ceiling(device, dtype))))
        rate, most = sorted(pairs)[len(pairs) // 2]
        cells = [f"{options.batch * rate / operations:.2f}", f"{rate / 1e9:.0f}", f"{most / 1e9:.0f}"]
        rows.append([precision, *cells, f"{rate / most:.0%}"])
        print(rows[-1], flush=True)
    head = ["precision", "sweeps/s", "GFLOP/s", "matrix ceiling GFLOP/s", "of ceiling"]
    return f"Forward pass of {options.model}, batch {options.batch} × {STEPS} steps.\n\n{table(head, rows)}"


def bandwidth() -> float:
    """Return the rate at which one thread reads memory [bytes/s]."""
    a = torch.ones(64 * 2**20)
    return 4 * a.numel() / clock(torch.device("cpu"), a.sum, 5)


def stream_part(options: argparse.Namespace, device: torch.device) -> str:
    torch.set_num_threads(1)
    rows = []
    speed = bandwidth() if device.type == "cpu" else float("nan")
    for name in options.model.split(","):
        model = load_model(name).to(device)
        weights = 4 * sum(p.numel() for p in model.parameters())
        bound = weights / speed * 1e3
        for what, stream in streams(model, name, device):
            times = stream(options.repeats * 20)
            least, p50, p99 = np.percentile(times[10:], [0, 50, 99])
            cells = [f"{least:.2f}", f"{p50:.2f}", f"{p99:.2f}", f"{weights / 1e6:.1f}", f"{bound:.2f}"]
            rows.append([name, what, *cells, f"{p50 / bound:.1f}"])
            print(rows[-1], flush=True)
    head = ["model", "way", "least ms", "p50 ms", "p99 ms", "float32 weights MB", "ms to read them once", "p50 of that"]
    rate = ceiling(device, torch.float32), ceiling(device, torch.bfloat16)
    text = f"Batch 1, one thread; memory read at {speed / 1e9:.1f} GB/s by a plain sum; matrix products at "
    text += f"{rate[0] / 1e9:.0f} GFLOP/s in float32 and {rate[1] / 1e9:.0f} in bf16."
    return f"{text}\n\n{table(head, rows)}"


def streams(model: Any, name: str, device: torch.device) -> Iterator[tuple[str, Callable[[int], list[float]]]]:
    """Yield ways to stream a network: by name, a function that takes steps and returns how long each took [ms]."""
    x = sweeps(1, device)[:, 0]
    limit = model.spec.max_steps or 10**9

    def timed(call: Callable[[Any], Any], start: Callable[[], Any]) -> Callable[[int], list[float]]:
        def run(count: int) -> list[float]:
            times, state = [], start()
            with torch.no_grad():
                for index in range(count):
                    state = start() if index % limit == 0 else state
                    began = time.perf_counter()
                    state = call(state)
                    if device.type == "cuda":
                        torch.cuda.synchronize()
                    times.append((time.perf_counter() - began) * 1e3)
            return times

        return run

    yield "step", timed(lambda state: model.step(x, state)[1], lambda: model.init_state(1))
    flat = StreamingStep(model)
    yield "flat state", timed(lambda state: flat(x, state)[1], lambda: flat.init_state(1))
    if device.type == "cpu":
        for precision in ("float32", "bf16"):
            fast: Any = packed(model, precision=precision)
            yield (
                f"packed {precision}",
                timed(lambda state, fast=fast: fast.step(x, state)[1], lambda fast=fast: fast.init_state(1)),
            )
        with tempfile.TemporaryDirectory() as folder:
            run = read_onnx(export_model(model, Path(folder) / "step.onnx", name=name).path, threads=1)
            yield "ONNX Runtime", timed(lambda state: run(x.numpy(), state)[1], lambda: flat.init_state(1).numpy())


def length_part(options: argparse.Namespace, device: torch.device) -> str:
    rows = []
    for name in ("s4-small", "resnet18-small+mamba"):
        model = load_model(name).to(device)
        for steps in (100, 1000, 10_000):
            x = sweeps(1, device, steps)
            with torch.no_grad():
                seconds = clock(device, lambda model=model, x=x: model(x), 2, warm=1)
            rows.append([name, f"{steps:,}", f"{seconds:.3f}", f"{seconds / steps * 1e6:.0f}"])
            print(rows[-1], flush=True)
    return table(["model", "steps", "s", "µs per step"], rows)


PARTS = {"train": train_part, "forward": forward_part, "stream": stream_part, "length": length_part}
TITLES = {"train": "Training step", "forward": "Forward pass", "stream": "Streaming step", "length": "Long sweeps"}


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--part", choices=PARTS, default="train")
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
    body = f"{name}. " + PARTS[options.part](options, device)
    words = f"--part {options.part} --model {options.model}"
    words += f" --batch {options.batch}" if options.part in ("train", "forward") else ""
    publish(options, f"{TITLES[options.part]} ({options.model}, {device.type})", body, words)


if __name__ == "__main__":
    main()
