"""A student as it is evaluated and as it is deployed, in the same episodes of its task, on C MuJoCo.

    python -m benchmarks.policies.deployment [--student in_palm_rotate.student] [--envs 102] [--seeds 3] [--write]
    python -m benchmarks.policies.deployment --student FOLDER … --faulty --write    # hands that lag, drop and drift

Deployed: exported to ONNX, and run by the control loop of ``policy deploy`` with its contract, checks and limits, one
loop a hand. The hands are those of the task: their reports hold joints and finger forces, and touch is that of their
taxels. Nothing else reaches the policy. The starts are those of the evaluation. The loop limits how fast a target may
move, as the environment does (``rated_speed``); both also run without.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
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
from robotics_bridge.deploy.controller import REAL_TYPES, DeployedPolicy, PressureCalibration, Report, read_deployed
from robotics_bridge.deploy.driver import Clock, HandReading, LinkCounters
from robotics_bridge.envs.env import Env
from robotics_bridge.envs.step import VELOCITY
from robotics_bridge.policies.contract import with_contacts_of
from robotics_bridge.policies.evaluate import Policy, evaluate, mean_of_episodes
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.training.distill import load_student
from robotics_bridge.tasks.task import Task


@dataclass(frozen=True)
class Faults:
    """What is wrong with the reports of a hand."""

    lag: int = 0
    """Control steps by which a report is late."""
    drop: float = 0.0
    """Share of reports that are lost; the last one stands."""
    drift: float = 0.0
    """How far readings have drifted at the end of an episode, either way: joints (rad), pressures (thresholds)."""


TITLE = "Evaluation and deployment of a student"
FAULTY = {
    "deployed": Faults(), "one step late": Faults(lag=1), "two steps late": Faults(lag=2),
    "a fifth of the reports lost": Faults(drop=0.2), "drift to ±.1 rad and thresholds": Faults(drift=0.1),
    "one late, a fifth lost, drift": Faults(1, 0.2, 0.1),
}  # fmt: skip


class Hands(Clock):
    """The hands of a batch of environments, and the time of their control loops.

    A loop that sleeps waits for the others; then all environments advance by one control step.
    """

    def __init__(self, env: Env, faults: Faults = Faults(), seed: int = 0) -> None:
        self.env, self.steps, self.faults = env, 0, faults
        self.random = np.random.default_rng(seed)
        self.reports: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]] = []
        """Joint positions, velocities and finger pressures of all environments, of the first step and those since."""
        joints, fingers = len(env.joint_names), len(env.hand.fingers)
        self._calibration = PressureCalibration()
        self._touched = [env.hand.tips.index(link) for link in env.touch.links if link in env.hand.tips]
        self.drift = [self.random.uniform(-1, 1, (env.num_envs, *shape)) for shape in ((joints,), (fingers, 3))]
        self.lost = self.random.random((env.max_episode_length + 1, env.num_envs)) < faults.drop
        self.lost[0] = False
        self.actions = torch.zeros(env.num_envs, env.num_actions)
        self.open = torch.ones(env.num_envs, dtype=torch.bool)
        """[B] environments in their first episode."""
        self.found = {name: torch.zeros(env.num_envs) for name in ("metric", "goals", "dropped")}
        self._barrier = Barrier(env.num_envs, action=self._advance)
        self._report()

    def _report(self) -> None:
        proprio, count = self.env.observations["proprio"].double().numpy(), len(self.env.joint_names)
        fingers, pressure = tuple(self.env.hand.fingers), np.zeros_like(self.drift[1])
        if self.env.options.observe in REAL_TYPES:
            # What the skin of the tips gives in the last physics step; a bit is a pressure of twice the threshold.
            felt = self.env.observations["tactile"][:, -1].double().numpy()[:, : len(self._touched)]
            scale = self._calibration.pressure(fingers, np.ones((len(fingers), 3)))[self._touched]
            pressure[:, self._touched] = felt * (scale if felt.shape[2] == 3 else 2 * self._calibration.threshold)
        amount = self.faults.drift * self.steps / self.env.max_episode_length
        position = proprio[:, :count] + amount * self.drift[0]
        pressure += amount * self._calibration.threshold * self.drift[1]
        self.reports.append((position, proprio[:, count : 2 * count] / VELOCITY, pressure))

    def __call__(self) -> float:
        return self.steps * self.env.step_dt

    def sleep(self, seconds: float) -> None:
        self._barrier.wait()

    def _advance(self) -> None:
        _, _, terminated, truncated, info = self.env.step(self.actions)
        self.steps += 1
        self._report()
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
        self._map = env.action_map

    def read(self) -> HandReading:
        hands, row = self.hands, self.row
        arrived = hands.steps
        while hands.lost[arrived, row]:
            arrived -= 1
        number = max(arrived - hands.faults.lag, 0)
        position, velocity, pressure = (values[row] for values in hands.reports[number])
        step = hands.env.step_dt
        return HandReading(
            sequence=arrived, time=number * step, arrived=arrived * step, position=position.copy(), velocity=velocity,
            pressure=pressure,
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
    deployed: DeployedPolicy, env: Env, seed: int, *, limited: bool = True, faults: Faults = Faults()
) -> tuple[dict[str, torch.Tensor], list[Report]]:
    """Return what became of the first episode of each environment, and the report of each loop.

    Args:
        deployed: the exported student.
        env: its environment.
        seed: of the starts.
        limited: keep the limit on the speed of targets, as ``policy deploy`` does.
        faults: of the hands' reports.
    """
    env.seed(seed)
    env.reset()
    hands = Hands(env, faults, seed)
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
    parser = script_parser(__doc__)
    parser.add_argument("--student", nargs="+", default=["in_palm_rotate.student"])
    parser.add_argument("--faulty", action="store_true", help="hands that lag, drop and drift")
    parser.add_argument("--envs", type=int, default=102)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    texts = []
    for name in options.student:
        student, described = load_student(name)
        config, seeds = described["distill"], range(options.seeds)
        task = with_contacts_of(tasks.load(config["task"], config["variant"]), [name])
        make = partial(
            tasks.make, num_envs=options.envs, hand=config["hand"], observe=config["observe"],
            placement=config["placement"], resolution=config["resolution"],
        )  # fmt: skip
        ways: dict[str, dict[str, Any]] = {}
        free = "" if options.faulty else ", speed of targets not limited"
        for limited in (True, False) if free else (True,):
            env = make(replace(task, rated_speed=limited))
            found = evaluate(env, Policy(student), episodes=options.envs, seed=seeds)
            ways["evaluated" + (free if not limited else "")] = {
                "metric": found.metric, "goals": found.goals, "dropped": found.dropped,
            }  # fmt: skip
        env = make(task)
        reports: list[Report] = []
        cases: list[tuple[str, dict[str, Any]]] = [(way, {"faults": faults}) for way, faults in FAULTY.items()]
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / "policy.onnx"
            deployed = read_deployed(export_policy(student, target, deployment=described["deployment"]).path)
            for way, settings in cases if options.faulty else [cases[0], (f"deployed{free}", {"limited": False})]:
                runs = [deploy(deployed, env, seed, **settings) for seed in seeds]
                ways[way] = {key: torch.cat([found[key] for found, _ in runs]).tolist() for key in runs[0][0]}
                reports += [report for _, own in runs for report in own] if way == "deployed" else []
        label = f"{config['observe']} at the {config['placement']}" if options.faulty else name
        text = body(label, task, ways, reports)
        texts.append(f"{text} What the policy reads: {', '.join(deployed.contract.inputs)}.")
    title = "Deployed students on hands that lag, drop and drift" if options.faulty else TITLE
    publish(options, title, "\n\n".join(texts))


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
