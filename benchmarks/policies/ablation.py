"""Does a policy use the touch that it has? The same episodes with its touch, with that of another hand, and with none.

    python -m benchmarks.policies.ablation in_palm_rotate.student RUN … [--episodes 102] [--notes FILE] [--write]

Touch of another hand is that of the next environment at the same time: a possible touch, which tells nothing of this
hand's object. None is that nothing touches anything, at any time.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from benchmarks.report import publish, script_parser, table
from brainbench.cli.policy.options import World, agent_of, touch_of
from brainbench.core.statistics import newcombe_interval
from robotics_bridge.policies.evaluate import Policy, evaluate

TOUCH = "tactile"
"""Group that holds what is felt."""
CHANGES = {"its own": lambda x: x, "another hand's": lambda x: x.roll(1, 0), "none": torch.zeros_like}


class Changed:
    """A policy whose touch is changed on the way."""

    def __init__(self, policy: Policy, change: str) -> None:
        self.policy, self.change, self.reset = policy, CHANGES[change], policy.reset

    def __call__(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        return self.policy({**observations, TOUCH: self.change(observations[TOUCH])})


def measure(name: str, task: str, config: str, episodes: int) -> list[list[str]]:
    """Return a row for each change: success, its difference from that with the policy's own touch, turns and drops."""
    world = World(task, config=config)
    world.check([name])
    env = world.make([name], num_envs=34, **touch_of([name]))
    rows, own = [], None
    for change in CHANGES:
        found = evaluate(env, Changed(agent_of(name, env), change), episodes=episodes, name=name)
        own, facts = own or found, found.summary()
        count, share = facts["episodes"], facts["success_rate"]
        told = "{:.3f} [{:.3f}, {:.3f}]".format(share, *facts["success_interval"])
        lost = newcombe_interval(share * count, count, own.success_rate * count, count, over="episodes")
        less = "–" if found is own else f"{share - own.success_rate:+.3f} [{lost.low:+.3f}, {lost.high:+.3f}]"
        rows.append(
            [Path(name).name, change, str(count), told, less, f"{facts['goals']:.2f}", f"{facts['dropped']:.2f}"]
        )
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = script_parser(__doc__, notes=True)
    parser.add_argument("agents", nargs="+", help="shipped students, or runs whose policy feels")
    parser.add_argument("--task", default="in_palm_rotate")
    parser.add_argument("--config", default="careful")
    parser.add_argument("--episodes", type=int, default=102, help="for each of three seeds")
    options = parser.parse_args()
    rows = [row for name in options.agents for row in measure(name, options.task, options.config, options.episodes)]
    columns = ["policy", "touch", "episodes", "success", "difference", "goals", "dropped"]
    words = " ".join(Path(name).name for name in options.agents) + f" --episodes {options.episodes}"
    publish(options, "Policies without their touch", table(columns, rows), words)


if __name__ == "__main__":
    main()
