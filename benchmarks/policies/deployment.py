"""A student as it is evaluated and as it is deployed, in the same episodes of its task, on C MuJoCo.

    python -m benchmarks.policies.deployment [--student in_palm_rotate.student] [--envs 102] [--seeds 3] [--write]

Deployed: exported to ONNX, and run by the control loop of ``policy deploy`` with its contract, checks and limits, one
loop a hand. The hands are those of the task: their reports hold joints and finger forces, and touch is that of their
taxels. Nothing else reaches the policy. The starts are those of the evaluation. The loop limits how fast a target may
move, as the environment does (``rated_speed``); both also run without.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Barrier
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report import publish, script_parser, table
from brainbench.core.statistics import wilson_interval
from robotics_bridge import tasks
from robotics_bridge.deploy.controller import Clock, Report
from robotics_bridge.deploy.driver import HandReading, LinkCounters
from robotics_bridge.deploy.session import DeployedPolicy, PressureCalibration, read_deployed
from robotics_bridge.envs.env import Env
from robotics_bridge.envs.step import VELOCITY
from robotics_bridge.policies.evaluate import Policy, evaluate, mean_of_episodes
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.fit import with_contacts_of
from robotics_bridge.policies.training.student_files import load_student
from robotics_bridge.tasks.task import Task


class Hands(Clock):
    """The hands of a batch of environments, and the time of their control loops.

    A loop that sleeps waits for the others; then all environments advance by one control step.
    """

    def __init__(self, env: Env) -> None:
        self.env, self.steps = env, 0
        self.actions = torch.zeros(env.num_envs, env.num_actions)
        self.open = torch.ones(env.num_envs, dtype=torch.bool)
        """[B] environments in their first episode."""
        self.found = {name: torch.zeros(env.num_envs) for name in ("metric", "goals", "dropped")}
        self._barrier = Barrier(env.num_envs, action=self._advance)

    def __call__(self) -> float:
        return self.steps * self.env.step_dt

    def sleep(self, seconds: float) -> None:
        self._barrier.wait()

    def _advance(self) -> None:
        _, _, terminated, truncated, info = self.env.step(self.actions)
        self.steps += 1
        ended = (terminated | truncated) & self.open
        for name in ("metric", "goals", "dropped"):
            self.found[name][ended] = info[name][ended].float()
        self.open &= ~ended


class HandOfTask:
    """One of them, as a driver: what a control loop is given, and where its targets go."""

    def __init__(self, hands: Hands, row: int) -> None:
        env = hands.env
        self.hands, self.row, self.counters = hands, row, LinkCounters()
        self.joints, self.fingers = env.joint_names, tuple(env.hand.fingers)
        self._columns = [self.joints.index(name) for name in env.action_names]
        self._map, self._calibration = env.action_map, PressureCalibration()

    def read(self) -> HandReading:
        env, count, now = self.hands.env, len(self.joints), self.hands()
        proprio = env.observations["proprio"][self.row].double().numpy()
        force = env.state.contacts.tip_force[self.row].double().numpy()
        return HandReading(
            sequence=self.hands.steps, time=now, arrived=now, position=proprio[:count].copy(),
            velocity=proprio[count : 2 * count] / VELOCITY, pressure=self._calibration.pressure(self.fingers, force),
        )  # fmt: skip

    def send(self, targets: NDArray[np.float64]) -> None:
        self.hands.actions[self.row] = torch.as_tensor((targets[self._columns] - self._map.default) / self._map.scale)

    def stop(self) -> None:
        self.send(self.read().position)

    def close(self) -> None:
        """Close nothing."""

    def touch(self, reading: HandReading) -> NDArray[np.floating]:
        """Return the tactile group [S, N, C] of its taxels."""
        return self.hands.env.observations["tactile"][self.row].numpy()


def deploy(
    deployed: DeployedPolicy, env: Env, seed: int, *, limited: bool
) -> tuple[dict[str, torch.Tensor], list[Report]]:
    """Return what became of the first episode of each environment, and the report of each loop.

    Args:
        deployed: the exported student.
        env: its environment.
        seed: of the starts.
        limited: keep the limit on the speed of targets, as ``policy deploy`` does.
    """
    env.seed(seed)
    env.reset()
    hands = Hands(env)
    steps = env.max_episode_length

    def control(row: int) -> Report:
        hand = HandOfTask(hands, row)
        loop = deployed.controller(hand, fallback=hand.touch, clock=hands)
        if not limited:
            loop.limits = replace(loop.limits, speed=np.full(len(hand.joints), 1e3))
        report = loop.run((steps - 0.5) * env.step_dt)
        while hands.steps < steps:
            hands.sleep(0.0)  # a hand that was stopped holds while the others go on
        return report

    with ThreadPoolExecutor(env.num_envs) as pool:
        reports = list(pool.map(control, range(env.num_envs)))
    return hands.found, reports


def main() -> None:
    parser = script_parser(__doc__, notes=True)
    parser.add_argument("--student", default="in_palm_rotate.student")
    parser.add_argument("--envs", type=int, default=102)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    student, described = load_student(options.student)
    config = described["distill"]
    task = with_contacts_of(tasks.load(config["task"], config["variant"]), [options.student])
    make = partial(
        tasks.make, num_envs=options.envs, hand=config["hand"], observe=config["observe"],
        placement=config["placement"], resolution=config["resolution"],
    )  # fmt: skip
    seeds = range(options.seeds)
    ways: dict[str, dict[str, Any]] = {}
    for name, limited in (("evaluated", True), ("evaluated, speed of targets not limited", False)):
        env = make(replace(task, rated_speed=limited))
        found = evaluate(env, Policy(student), episodes=options.envs, seed=seeds)
        ways[name] = {"metric": found.metric, "goals": found.goals, "dropped": found.dropped}
    env = make(task)
    reports: list[Report] = []
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "policy.onnx"
        deployed = read_deployed(export_policy(student, target, deployment=described["deployment"]).path)
        for name, limited in (("deployed", True), ("deployed, speed of targets not limited", False)):
            runs = [deploy(deployed, env, seed, limited=limited) for seed in seeds]
            ways[name] = {key: torch.cat([found[key] for found, _ in runs]).tolist() for key in runs[0][0]}
            reports += [report for _, own in runs for report in own] if limited else []
    text = (
        body(options.student, task, ways, reports) + f" What the policy reads: {', '.join(deployed.contract.inputs)}."
    )
    publish(options, "Evaluation and deployment of a student", text)


def body(student: str, task: Task, ways: dict[str, dict[str, Any]], reports: list[Report]) -> str:
    """Return the table, and what the loops did."""
    won = {name: np.array(found["metric"]) >= task.success.threshold for name, found in ways.items()}
    rows = []
    for name, found in ways.items():
        count, of = int(won[name].sum()), len(won[name])
        span = wilson_interval(count, of)
        change, half = mean_of_episodes(won[name].astype(float) - won["evaluated"])
        turns, spread = mean_of_episodes(found["goals"])
        rows.append(
            [
                name, str(of), f"{count / of:.3f} [{span.low:.3f}, {span.high:.3f}]",
                "–" if name == "evaluated" else f"{change:+.3f} ± {half:.3f}", f"{turns:.2f} ± {spread:.2f}",
                f"{np.mean(found['dropped']):.3f}",
            ]
        )  # fmt: skip
    stopped = sum(report.status == "stopped" for report in reports)
    limited = sum(report.limited for report in reports) / sum(report.ticks for report in reports)
    columns = ["way", "episodes", "success", "less evaluated, by pairs", "quarter turns", "dropped"]
    return (
        f"`{student}` in {task.name}, the same starts; success: a quarter turn or more in {task.episode:g} s.\n\n"
        f"{table(columns, rows)}\n\nDeployed: exported to ONNX and run by the control loop of `policy deploy`, with "
        "the contract's command, safety checks and limits, without the network and its faults. Safe stops: "
        f"{stopped} of {len(reports)} loops; targets limited in {limited:.0%} of the ticks."
    )


if __name__ == "__main__":
    main()
