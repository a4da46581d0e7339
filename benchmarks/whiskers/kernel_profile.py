"""Where the time of a training step and of a batched streaming step goes on a GPU, kernel by kernel; and whether they
compute what PyTorch's own operations compute.

    python -m benchmarks.whiskers.kernel_profile --parts check train stream front
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.models.training_step import clock, plain, sweeps, training_step
from benchmarks.policies.encoder_step import cast, copy_into
from brainbench.core.cuda_graphs import record_step
from brainbench.models.activations import evaluating
from brainbench.models.registry import load_model

DEVICE = torch.device("cuda")


def autocast() -> Any:
    return torch.autocast("cuda", dtype=torch.bfloat16)


def show(title: str, work: Callable[[], Any], rows: int) -> None:
    """Print the kernels of one call of ``work``, the longest first."""
    work()
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        work()
        torch.cuda.synchronize()
    found = sorted(profile.key_averages(), key=lambda event: -event.device_time_total)
    total, count = sum(event.device_time_total for event in found), sum(event.count for event in found)
    print(f"== {title}: {total / 1e3:.2f} ms in {count} kernels", flush=True)
    for event in found[:rows]:
        share = event.device_time_total / total
        average = event.device_time_total / event.count
        figures = f"{event.device_time_total / 1e3:8.3f} ms {share:5.1%} {event.count:6d} × {average:8.1f} µs"
        print(f"  {figures}  {event.key[:150]}", flush=True)


def gradients(model: Any, x: torch.Tensor, labels: torch.Tensor) -> list[torch.Tensor]:
    """Return loss, answer and gradients."""
    model.zero_grad()
    y = model(x).float()
    loss = torch.nn.functional.cross_entropy(y, labels)
    loss.backward()
    return [loss.detach(), y.detach(), *(p.grad.clone().float() for p in model.parameters() if p.grad is not None)]


def check(options: argparse.Namespace) -> None:
    for name in ("zhuang-intersection-ln-small", "zhuang-intersection-ln+gpt"):
        torch.manual_seed(0)
        # Dropout draws anew in every pass, and would be compared with itself.
        model = load_model(name).to(DEVICE).eval()
        x, labels = sweeps(16, DEVICE), torch.randint(117, (16,), device=DEVICE)
        start = time.perf_counter()
        with plain():
            exact = gradients(model, x, labels)
            with autocast():
                theirs = gradients(model, x, labels)
        before = time.perf_counter()
        with autocast():
            ours = gradients(model, x, labels)
        torch.cuda.synchronize()
        took = time.perf_counter() - before
        worst = [
            max(((a - e).norm() / e.norm().clamp(min=1e-12)).item() for a, e in zip(found[2:], exact[2:], strict=True))
            for found in (ours, theirs)
        ]
        whole = [
            (sum((a - e).square().sum() for a, e in zip(found[2:], exact[2:], strict=True)).sqrt()
            / sum(e.square().sum() for e in exact[2:]).sqrt()).item()
            for found in (ours, theirs)
        ]  # fmt: skip
        answer = [((found[1] - exact[1]).norm() / exact[1].norm()).item() for found in (ours, theirs)]
        print(
            f"{name}: error against float32, ours and PyTorch's bf16: answer {answer[0]:.2e} {answer[1]:.2e}, gradient "
            f"{whole[0]:.2e} {whole[1]:.2e}, worst parameter {worst[0]:.2e} {worst[1]:.2e}; loss {ours[0]:.6f} "
            f"{theirs[0]:.6f} {exact[0]:.6f}; first pass {took:.1f} s after {before - start:.1f} s",
            flush=True,
        )
        with torch.no_grad(), evaluating(model), autocast():
            swept = model.encode(x)
            state, streamed = model.init_state(16), []
            for t in range(x.shape[1]):
                y, state = model.encode_step(x[:, t], state)
                streamed.append(y)
        error = (torch.stack(streamed, 1).float() - swept.float()).norm() / swept.float().norm()
        print(f"  streamed against swept in bf16: {error:.2e}", flush=True)


def train(options: argparse.Namespace) -> None:
    torch.backends.cudnn.benchmark = True
    model = load_model(options.model).to(DEVICE).train().to(memory_format=torch.channels_last)
    x, labels = sweeps(options.batch, DEVICE), torch.randint(117, (options.batch,), device=DEVICE)
    step = training_step(model, model, x, labels, autocast)
    start = time.perf_counter()
    replay = record_step(step, DEVICE)
    torch.cuda.synchronize()
    print(f"recorded after {time.perf_counter() - start:.1f} s", flush=True)
    seconds = clock(DEVICE, replay, 5)
    memory = torch.cuda.max_memory_allocated() / 1e9
    print(
        f"{options.model} step {seconds * 1e3:.2f} ms, {options.batch / seconds:,.0f} sweeps/s, {memory:.1f} GB",
        flush=True,
    )
    del replay
    show("training step", step, options.rows)

    def forward() -> None:
        with autocast():
            model(x)

    with evaluating(model), torch.no_grad():
        seconds = clock(DEVICE, record_step(forward, DEVICE), 5)
        print(f"forward {seconds * 1e3:.2f} ms", flush=True)
        show("forward", forward, 12)


def stream(options: argparse.Namespace) -> None:
    model = load_model("zhuang-intersection-ln-small").to(DEVICE, torch.bfloat16).eval()
    x = (torch.randn(8192, 30, 5, 7, device=DEVICE) * 1e-4).bfloat16().contiguous(memory_format=torch.channels_last)
    own = cast(model.init_state(8192), torch.bfloat16, torch.channels_last)

    def run() -> None:
        _, after = model.encode_step(x, own)
        copy_into(own, after)

    with torch.inference_mode():
        run()
        print(f"streaming {clock(DEVICE, record_step(run, DEVICE), 10) * 1e3:.3f} ms for 8,192", flush=True)
        show("streaming step", run, options.rows)


def front(options: argparse.Namespace) -> None:
    from robotics_bridge.policies.encoders.front_end import FrontEnd
    from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid

    grid = TaxelGrid("xhand1")
    module = FrontEnd("zhuang-intersection-ln-small", grid).to(DEVICE).eval()
    taxels = 1e-4 * torch.randn(8192, module.sub_steps, grid.items, grid.channels, device=DEVICE)
    state = module.init_state(8192)

    def run() -> None:
        nonlocal state
        with autocast():
            _, state = module(taxels, state)

    with torch.inference_mode():
        run()
        print(f"front end {clock(DEVICE, run, 10) * 1e3:.3f} ms for 8,192, launch by launch", flush=True)
        show("front end", run, options.rows)


PARTS = {"check": check, "train": train, "stream": stream, "front": front}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--model", default="zhuang-intersection-ln+gpt")
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--rows", type=int, default=25)
    options = parser.parse_args()
    for part in options.parts:
        try:
            PARTS[part](options)
        except Exception as error:  # noqa: BLE001 - one part's failure should not cost the others' rows
            import traceback

            traceback.print_exc()
            print(f"{part} failed: {error}", flush=True)


if __name__ == "__main__":
    main()
