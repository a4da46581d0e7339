"""Speed of the dexterous tasks and of their teachers, on one GPU or on processors.

    python -m benchmarks.policies.tasks --part speed --device cuda --out $OUT  # environment steps/s per task and sense
    python -m benchmarks.policies.tasks --part split --device cuda --out $OUT       # a PPO iteration in its parts
    python -m benchmarks.policies.tasks --part tables --out FOLDER --write          # lay out what was measured

Every row is printed and appended to ``$OUT/policy.jsonl`` when it is measured; small sizes come first. Needs torch,
warp, mujoco, mujoco_warp, rsl_rl, tensordict. Teachers: ``brainbench policy train``, laid out by teachers.py.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.report import publish, script_parser, table
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.policies.training import teacher

SENSES = ("none", "force_torque", "encoder-small", "encoder")
ENCODERS = {"encoder-small": "zhuang-intersection-ln-small", "encoder": "zhuang-intersection-ln"}


def put(out: Path, row: dict[str, Any]) -> None:
    """Print a row and keep it."""
    print(json.dumps(row), flush=True)
    with (out / "policy.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


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


def speed(options: argparse.Namespace, out: Path) -> None:
    """Environment steps per second with random actions."""
    for envs in options.envs:
        for task in options.tasks:
            for sense in options.senses:
                if task == "hot_ball" and envs > 2048:
                    continue
                try:
                    put(out, one_speed(task, sense, envs, options))
                except (RuntimeError, ValueError) as error:
                    put(out, {"part": "speed", "task": task, "sense": sense, "envs": envs, "error": str(error)[:300]})
                if options.device != "cpu":
                    torch.cuda.empty_cache()


def one_speed(task: str, sense: str, envs: int, options: argparse.Namespace) -> dict[str, Any]:
    start = time.perf_counter()
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
        made = wait(env.device) - start
        seconds = per_call(step, env.device, repeats=options.repeats)
    row = {"part": "speed", "task": task, "sense": sense, "envs": envs, "device": options.device, "made_s": made}
    row |= {"graphs": env.recorded, "step_ms": 1e3 * seconds, "env_steps_per_s": envs / seconds}
    if env.device.type == "cuda":
        row["memory_gb"] = torch.cuda.max_memory_allocated(env.device) / 2**30
    return row


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


def split(options: argparse.Namespace, out: Path) -> None:
    """A PPO iteration: physics, touch, the rest of the environment, acting, learning."""
    for envs in options.envs:
        task = tasks.load("in_palm_rotate")
        env = tasks.make(
            task, num_envs=envs, device=options.device, observe="force_torque", graphs=False if options.eager else None
        )
        trainer = teacher.Trainer(env, replace(task.teacher, num_envs=envs))
        rows = [trainer.iterate() for _ in range(3)][1:]
        steps = trainer.settings.steps_per_env
        actions = torch.randn(envs, env.num_actions, device=env.device)

        def physics(env: Env = env) -> None:
            for substep in range(env.decimation):
                env.state.actuators.launch(substep)
                env.simulation.step()

        def touch(env: Env = env) -> None:
            for substep in range(env.decimation):
                env.touch.update(env.simulation.state, env.simulation.timestep, substep)  # type: ignore[union-attr]

        observations = trainer.env.get_observations()
        with torch.inference_mode():
            whole = per_call(lambda env=env, a=actions: env.step(a), env.device, repeats=options.repeats)
            parts = {
                "physics_ms": per_call(physics, env.device, repeats=options.repeats),
                "touch_ms": per_call(touch, env.device, repeats=options.repeats),
                "policy_ms": per_call(
                    lambda t=trainer, o=observations: t.algorithm.actor(o, stochastic_output=True), env.device,
                    repeats=options.repeats,
                ),
            }  # fmt: skip
        row = {"part": "split", "envs": envs, "device": options.device, "graphs": env.recorded}
        row["env_step_ms"] = 1e3 * whole
        row |= {name: 1e3 * value for name, value in parts.items()}
        row["rest_ms"] = row["env_step_ms"] - row["physics_ms"] - row["touch_ms"]
        row |= {"iteration_s": sum(r["collect_s"] + r["learn_s"] for r in rows) / len(rows)}
        row |= {"update_s": sum(r["learn_s"] for r in rows) / len(rows), "steps_per_iteration": steps}
        put(out, row)


def tables(options: argparse.Namespace, out: Path) -> None:
    """Print tables of the rows in a folder; ``--write`` puts them into RESULTS.md."""
    rows = [json.loads(line) for line in (out / "policy.jsonl").read_text(encoding="utf-8").splitlines()]
    speeds = [r for r in rows if r["part"] == "speed" and "error" not in r]
    base = {(r["task"], r["envs"]): r["env_steps_per_s"] for r in speeds if r["sense"] == "none"}
    parts = []
    if speeds:
        lines = []
        for r in speeds:
            against = base.get((r["task"], r["envs"]))
            cost = "" if against is None else f"{100 * (1 - r['env_steps_per_s'] / against):.0f} %"
            rate, took = f"{r['env_steps_per_s']:,.0f}", f"{r['step_ms']:.2f}"
            lines.append([r["task"], r["sense"], str(r["envs"]), rate, took, cost])
        parts.append(table(["task", "sense", "environments", "control steps/s", "ms", "slower by"], lines))
    shown = ("envs", "physics_ms", "touch_ms", "rest_ms", "policy_ms", "update_s", "iteration_s")
    splits = [[f"{r[k]:.3g}" for k in shown] for r in rows if r["part"] == "split"]
    if splits:
        parts.append(table([name.replace("_", " ") for name in shown], splits))
    devices = sorted({r["device"] for r in rows if "device" in r})
    title = f"Dexterous tasks: speed ({', '.join(devices) or 'processors'})"
    publish(options, title, "\n\n".join(parts), f"--part tables --device {options.device}")


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--part", choices=["speed", "split", "tables"], required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, default=Path("policy-bench"))
    parser.add_argument("--tasks", nargs="+", default=["in_palm_rotate", "in_hand_repose", "screwdriver"])
    parser.add_argument("--senses", nargs="+", default=["none", "force_torque"], choices=SENSES)
    parser.add_argument("--envs", nargs="+", type=int, default=None)
    parser.add_argument("--eager", action="store_true", help="speed and split without CUDA graphs")
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    options.envs = options.envs or ([1024, 8192] if options.device != "cpu" else [16, 64])
    options.out.mkdir(parents=True, exist_ok=True)
    if options.device == "cpu":
        torch.set_num_threads(1)
    {"speed": speed, "split": split, "tables": tables}[options.part](options, options.out)


if __name__ == "__main__":
    main()
