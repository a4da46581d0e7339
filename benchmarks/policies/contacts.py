"""Overlap and force of the block under a policy, success and cost, for contact models of a task.

    python -m benchmarks.policies.contacts --out FOLDER [--policy in_palm_rotate.teacher] [--envs 96] [--write]

C MuJoCo on the processor. Contacts of the block are read once a control step, over whole episodes of three seeds; one
JSON file a model stands in the folder, and a model that stands there is not measured again. With ``--write`` a section
of RESULTS.md and ``docs/images/policy-contacts.png``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.report import measure_once, publish, script_parser, table
from brainbench.core.devices import mujoco_module
from brainbench.core.figures.style import COLORS, panels, save_figure
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.policies.evaluate import evaluate
from robotics_bridge.policies.training.teacher import load_teacher
from robotics_bridge.tasks.contact_model import CONTACTS, ContactModel

FIRM = CONTACTS["firm"]
MODELS: dict[str, tuple[ContactModel, str]] = {
    "published": (CONTACTS["published"], "mjINT_IMPLICITFAST"),
    "firm (6 ms, drives × 0.08)": (FIRM, "mjINT_IMPLICITFAST"),
    "6 ms": (replace(FIRM, drive_scale=1.0), "mjINT_IMPLICITFAST"),
    "published, drives × 0.1": (ContactModel(drive_scale=0.1), "mjINT_IMPLICITFAST"),
    "firm, discrete integrator": (FIRM, "mjINT_DISCRETE"),
    "6 ms, drives × 0.15": (replace(FIRM, drive_scale=0.15), "mjINT_IMPLICITFAST"),
    "10 ms": (ContactModel(time_constant=0.01), "mjINT_IMPLICITFAST"),
}
"""Name → contact model, and integrator of MuJoCo."""
_BINS = np.concatenate(([0.0], np.geomspace(0.01, 30.0, 60)))
"""Edges of the histogram of overlap [mm]."""
_PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-contacts.png"


class Recorder:
    """A policy that notes, before each of its actions, the contacts of the object in the last physics step."""

    def __init__(self, policy: Any, env: Any) -> None:
        self._policy, self._env, self._fresh = policy, env, True
        scene = env.simulation.engine.scene
        self._links = np.asarray(scene.link_of)
        self._object = scene.link_index(env.state.model.objects[0])
        self.overlap: list[np.ndarray] = []
        self.force: list[np.ndarray] = []

    def reset(self, mask: Any) -> None:
        self._fresh = bool(mask.all())
        self._policy.reset(mask)

    def __call__(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        if not self._fresh:
            self._note()
        self._fresh = False
        return self._policy(observations)

    def _note(self) -> None:
        state = self._env.simulation.state
        count = int(state.contact_count.numpy()[0])
        names = ("env", "geom", "distance", "normal", "force")
        env, geometries, distance, normal, force = (getattr(state, f"contact_{n}").numpy()[:count] for n in names)
        links = self._links[geometries]
        mine = (links == self._object).any(axis=1) & (force > 0)
        self.overlap.append(-1e3 * distance[mine])
        # Net normal force of each link on the object: contacts of one link push together.
        sign = np.where(links[mine, 1] == self._object, 1.0, -1.0)
        other = links[mine].sum(axis=1) - self._object
        key, place = np.unique(env[mine] * len(self._links) + other, return_inverse=True)
        sums = np.zeros((len(key), 3))
        np.add.at(sums, place, (sign * force[mine])[:, None] * normal[mine])
        self.force.append(np.linalg.norm(sums, axis=1))


def make(name: str, envs: int) -> Env:
    """Return the environments of a contact model."""
    contacts, integrator = MODELS[name]
    env = tasks.make(replace(tasks.load("in_palm_rotate", "careful"), contacts=contacts), num_envs=envs, threads=1)
    for number in range(envs):
        option = env.simulation.engine.models[number].opt
        option.integrator = getattr(mujoco_module().mjtIntegrator, integrator)
    return env


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return overlap [mm], forces [N] and success of one contact model."""
    env = make(name, options.envs)
    recorder = Recorder(load_teacher(options.policy, env), env)
    result = evaluate(env, recorder, episodes=options.envs, seed=(0, 1, 2), name=name).summary()
    overlap, force = np.concatenate(recorder.overlap), np.concatenate(recorder.force)
    return {
        **{key: result[key] for key in ("success_rate", "success_interval", "goals", "dropped", "episodes")},
        "overlap": [*np.percentile(overlap, (50, 95)), overlap.max()],
        "force": [*np.percentile(force, (50, 95, 99)), force.max()], "contacts": len(overlap),
        "histogram": np.histogram(overlap, _BINS)[0] / len(overlap),
    }  # fmt: skip


def cost(names: Iterable[str], rounds: int = 7) -> dict[str, float]:
    """Return milliseconds of processor time a control step of an environment: in turns, least of the rounds."""
    worlds = {name: make(name, 16) for name in names}
    best = dict.fromkeys(worlds, np.inf)
    for _ in range(rounds):
        for name, env in worlds.items():
            env.seed(0)
            env.reset()
            still = torch.zeros(env.num_envs, env.num_actions)
            begun = time.process_time()
            for _ in range(40):
                env.step(still)
            best[name] = min(best[name], 1e3 * (time.process_time() - begun) / 40 / env.num_envs)
    return best


def lay_out(rows: Mapping[str, dict[str, Any]], spent: Mapping[str, float]) -> str:
    """Return the table."""
    columns = ["contacts", "overlap: median, 95 %, largest [mm]", "force of a link: median, 95 %, 99 %, largest [N]"]
    columns += ["success", "goals an episode", "dropped", "ms a control step"]
    cells = []
    for name, row in rows.items():
        low, high = row["success_interval"]
        cells.append(
            [
                name, ", ".join(f"{value:.2f}" for value in row["overlap"]),
                ", ".join(f"{value:.1f}" for value in row["force"]),
                f"{row['success_rate']:.3f} [{low:.3f}, {high:.3f}]", f"{row['goals']:.2f}", f"{row['dropped']:.2f}",
                f"{spent[name]:.2f}",
            ]
        )  # fmt: skip
    return table(columns, cells)


def draw(rows: Mapping[str, dict[str, Any]]) -> None:
    """Draw how overlap is distributed, as published and firm."""
    figure, ((axes,),) = panels(1, 1, (7.5, 3.4))
    for color, (label, name) in zip(
        COLORS, (("as published", "published"), ("firm", "firm (6 ms, drives × 0.08)")), strict=False
    ):
        axes.stairs(rows[name]["histogram"], np.maximum(_BINS, 5e-3), color=color, label=label, linewidth=1.8)
    axes.axvline(1.0, color="#6c757d", linewidth=0.8, linestyle="--")
    axes.set(
        xscale="log", xlabel="overlap of block and hand (mm; up to 0.01 in the first bin)", ylabel="share of contacts"
    )
    axes.legend(frameon=False, fontsize=9)
    save_figure(figure, _PICTURE, dpi=120)


def main() -> None:
    parser = script_parser(__doc__, notes=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--policy", default="in_palm_rotate.teacher")
    parser.add_argument("--envs", type=int, default=96)
    options = parser.parse_args()
    rows = measure_once(options.out, MODELS, lambda name: measure(name, options), known=options.write)
    if options.write:
        draw(rows)
    body = f"Block of in_palm_rotate (13 g and more) under `{options.policy}`.\n\n{lay_out(rows, cost(rows))}"
    words = f"--policy {options.policy} --envs {options.envs} --out FOLDER"
    publish(options, "Contacts of a block in the hand", body, words)


if __name__ == "__main__":
    main()
