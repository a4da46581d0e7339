"""Environment steps per second of the dexterous tasks with random actions, on one GPU or on processors.

    python -m benchmarks.policies.tasks --device cuda [--senses none force_torque encoder] [--write]

Every row is printed when it is measured; small sizes come first.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.report import publish, script_parser, table
from robotics_bridge import tasks
from robotics_bridge.envs import Env

SENSES = ("none", "force_torque", "encoder-small", "encoder")
ENCODERS = {"encoder-small": "zhuang-intersection-ln-small", "encoder": "zhuang-intersection-ln"}


def wait(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def per_call(work: Callable[[], Any], device: torch.device, *, repeats: int, warm: int = 3) -> float:
    """Return the mean seconds of a call."""
    for _ in range(warm):
        work()
    start = wait(device)
    for _ in range(repeats):
        work()
    return (wait(device) - start) / repeats


def speed(task: str, sense: str, envs: int, options: argparse.Namespace) -> tuple[bool, float]:
    """Return whether a step is recorded as CUDA graphs, and its seconds."""
    observe = "none" if sense == "none" else "force_torque"
    env = tasks.make(
        task, num_envs=envs, device=options.device, observe=observe, placement="hand", resolution="med",
        graphs=False if options.eager else None,
    )  # fmt: skip
    actions = torch.randn(8, envs, env.num_actions, device=env.device)
    look = front_end(sense, env)
    count = 0

    def step() -> None:
        nonlocal count
        observations, *_ = env.step(actions[count % 8])
        count += 1
        if look is not None:
            look(observations["tactile"])

    with torch.inference_mode():
        step()
        return env.recorded, per_call(step, env.device, repeats=options.repeats)


def front_end(sense: str, env: Env) -> Callable[[torch.Tensor], None] | None:
    """Return one streaming step of an encoder on the group ``tactile``."""
    if sense not in ENCODERS:
        return None
    from robotics_bridge.policies.encoders.taxel_grid import FrontEnd, TaxelGrid

    assert env.touch is not None
    module = FrontEnd(ENCODERS[sense], TaxelGrid(env.hand, placement="hand", resolution="med")).to(env.device).eval()
    state = module.init_state(env.num_envs).to(env.device)

    def look(reading: torch.Tensor) -> None:
        nonlocal state
        with torch.autocast(env.device.type, dtype=torch.bfloat16):
            _, state = module(reading, state)

    return look


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--tasks", nargs="+", default=["in_palm_rotate", "in_hand_repose", "screwdriver"])
    parser.add_argument("--senses", nargs="+", default=["none", "force_torque"], choices=SENSES)
    parser.add_argument("--envs", nargs="+", type=int, default=None)
    parser.add_argument("--eager", action="store_true", help="without CUDA graphs")
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    if options.device == "cpu":
        torch.set_num_threads(1)
    rows, alone = [], {}
    for envs in options.envs or ([16, 64] if options.device == "cpu" else [1024, 8192]):
        for task, sense in itertools.product(options.tasks, options.senses):
            if task == "hot_ball" and envs > 2048:
                continue
            recorded, seconds = speed(task, sense, envs, options)
            alone.setdefault((task, envs), seconds)
            cells = ["yes" if recorded else "no", f"{envs / seconds:,.0f}", f"{1e3 * seconds:.2f}"]
            rows.append([task, sense, f"{envs:,}", *cells, f"{1 - alone[task, envs] / seconds:.0%}"])
            print(*rows[-1], flush=True)
            if options.device != "cpu":
                torch.cuda.empty_cache()
    head = ["task", "sense", "environments", "recorded", "control steps/s", "ms", f"slower than {options.senses[0]}"]
    publish(options, f"Dexterous tasks: speed ({options.device})", table(head, rows), f"--device {options.device}")


if __name__ == "__main__":
    main()
