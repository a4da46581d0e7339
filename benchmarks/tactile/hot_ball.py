"""The sixteen cells of thesis figure 4.8 by a hand that touches the hot ball and holds on.

    python -m benchmarks.tactile.hot_ball --envs 6 --write
    python -m benchmarks.tactile.hot_ball --envs 24 --config default --agent hot_ball.teacher --write

The hand is scripted, or a trained teacher's. Both know which ball is hot, so this asks only what the materials decide:
does the latch fire, when, and for how long is the ball then held (S, equation 4.42). All cells feel the same physics,
with both laws of contact conduction.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks.report import publish, script_parser, table
from robotics_bridge import tasks
from robotics_bridge.envs import Env
from robotics_bridge.policies.training.teacher import load_teacher
from robotics_bridge.tasks.hot_ball import DIAMETER
from robotics_bridge.tasks.task import Success
from robotics_bridge.tasks.thermometers import ThermalSettings, Thermometers

CELLS = tuple(
    (conductivity, emissivity, heat)
    for conductivity in (1.0, 10.0, 100.0, 150.0)
    for emissivity in (0.5, 0.85)
    for heat in (500.0, 5000.0)
)
"""Conductivity, emissivity and heat generation of the sixteen cells of figure 4.8."""
PUBLISHED = {(150.0, 0.5, 500.0), (150.0, 0.5, 5000.0)}
"""Cells with a check mark in figure 4.8."""
NAMES = {1.0: "glass", 10.0: "steel", 100.0: "aluminium alloy", 150.0: "aluminium"}
IMAGE = Path(__file__).parents[2] / "docs" / "images" / "policy-heat.png"


class TouchAndHold:
    """Waits until the balls lie still, goes above the hot one, and presses on it with the middle finger.

    Where other fingers meet other balls first, it presses harder until the hot one is touched.
    """

    def __init__(self, env: Env, felt: torch.Tensor, press: float = 0.002) -> None:
        self.env, self.felt = env, felt
        self._press = torch.full((env.num_envs,), press)
        self._columns = [env.action_names.index(f"carriage_{axis}") for axis in "xyz"]
        scales = env.action_map.scale
        self._scale = torch.as_tensor(scales[self._columns], dtype=torch.float32)
        self._tip = env.simulation.engine.scene.link_index("right_hand_mid_link2")
        self._end = torch.tensor([0.0015, 0.0, 0.0336])
        self._step = 0

    def __call__(self, _: Any) -> torch.Tensor:
        from brainbench.core.rotations import rotate

        env = self.env
        rows = torch.arange(env.num_envs)
        ball = env.object_pose[rows, env.state.episode.target, :3]
        pose = env.simulation.state.pose_torch[:, self._tip]
        quat = torch.cat((pose[:, 6:], pose[:, 3:6]), dim=1)
        tip = pose[:, :3] + rotate(quat, self._end)
        slides = env.simulation.qpos[
            :, [env.state.actuators.qpos_columns[env.joint_names.index(f"carriage_{a}")] for a in "xyz"]
        ]
        goal = ball.clone()
        goal[:, 2] += 0.04 + 0.0088
        away = (goal - tip)[:, :2].norm(dim=1)
        over = away < 0.02
        self._press += (over & ~self.felt & (tip[:, 2] < goal[:, 2] + 0.02)) * 0.02 * env.step_dt
        self._press.clamp_(max=0.03)
        goal[:, 2] += torch.where(over, -self._press - (0.04 - (0.04**2 - away.clamp(max=0.03) ** 2).sqrt()), 0.06)
        self._step += 1
        action = torch.zeros(env.num_envs, env.num_actions)
        if self._step * env.step_dt < 1.5:
            return action
        move = (goal - tip).clamp(-0.05, 0.05)
        # Pressing goes on from the commanded height, not from the measured one.
        action[:, self._columns] = (slides + move) / self._scale
        return action


def run(envs: int, seconds: float, seed: int, config: str, agent: str | None) -> list[dict[str, Any]]:
    """Return one record per cell and conduction law, under the script or a teacher."""
    torch.set_num_threads(1)
    task = replace(tasks.load("hot_ball", config), episode=1e4)
    radius = DIAMETER / 2 if config == "default" else ThermalSettings().contact_radius
    if agent is None:
        bare = {"task_state": None, "actuators": None, "groups": {}, "rewards": {}, "success": Success(metric="goals")}
        task = replace(task, **bare)
    env = tasks.make(task, num_envs=envs, seed=seed)
    env.state.episode.target.copy_(torch.arange(envs) % task.copies)
    grids = {
        (law, *cell): Thermometers(
            env.state,
            ThermalSettings(
                conductivity=cell[0], emissivity=cell[1], heat=cell[2], conduction=law, contact_radius=radius
            ),
            chooses=False,
        )
        for law in ("thesis", "physical")
        for cell in CELLS
    }
    env.reset()
    for grid in grids.values():
        grid.reset(torch.ones(envs, dtype=torch.bool))
    felt = next(iter(grids.values())).touching
    act = load_teacher(agent, env) if agent else TouchAndHold(env, felt)
    warmest = {key: torch.full((envs,), -1e9) for key in grids}
    touched = torch.zeros(envs)
    trace: dict[Any, list[float]] = {key: [] for key in grids}
    steps = round(seconds / env.step_dt)
    for step in range(steps):
        env.step(act(env.observations))
        for key, grid in grids.items():
            grid.after_physics_step(env.step_dt)
            grid.update_latch(env.step_dt)
            value = grid.temperature().amax(dim=1)
            warmest[key] = torch.maximum(warmest[key], value)
            trace[key].append(float(value.median()))
        touched += env.step_dt * felt
        if (step + 1) % 100 == 0:
            print(f"{(step + 1) * env.step_dt:.1f} s, touching {int(felt.sum())}/{envs}", flush=True)
    records = []
    for key, grid in grids.items():
        law, conductivity, emissivity, heat = key
        held = grid.contact > 0
        times = grid.latch_time[grid.latched]
        records.append({
            "law": law, "conductivity": conductivity, "emissivity": emissivity, "heat": heat,
            "latched": float(grid.latched.float().mean()), "latch_s": float(times.median()) if len(times) else None,
            "S": float(grid.contact.median()), "success": float(held.float().mean()),
            "warmest": float(warmest[key].median()), "touched_s": float(touched.median()), "trace": trace[key],
        })  # fmt: skip
    return records


def draw(records: list[dict[str, Any]], step: float) -> None:
    """Draw the warmest cell of the fingers over time, per law."""
    from brainbench.cli.tactile.figures import panels, save_figure

    figure, axes = panels(2, (9, 3.8), sharey=True)
    shades = {1.0: "#b9c4d6", 10.0: "#7f9cc4", 100.0: "#3f6ea8", 150.0: "#16365f"}
    for ax, law in zip(axes, ("thesis", "physical"), strict=True):
        for r in records:
            if r["law"] == law and r["emissivity"] == 0.5:
                times = [step * (i + 1) for i in range(len(r["trace"]))]
                style = "-" if r["heat"] == 500.0 else ":"
                label = f"{r['conductivity']:g} W/(m·K), {r['heat']:g} W/m²"
                ax.plot(times, r["trace"], style, color=shades[r["conductivity"]], label=label, lw=1.6)
        ax.axhline(42.24, color="#c0392b", lw=1)
        ax.set_title(f"{law} conduction, emissivity 0.5", fontsize=10)
        ax.set_xlabel("time (s)")
    axes[0].set_ylabel("warmest cell of the fingers (°C)")
    axes[0].annotate("latch", (0.2, 42.6), color="#c0392b", fontsize=8)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    save_figure(figure, IMAGE, dpi=110)


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--envs", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--config", choices=("published", "default"), default="published")
    parser.add_argument("--agent", help="a shipped teacher or the folder of a run, in place of the script")
    options = parser.parse_args()
    records = run(options.envs, options.seconds, options.seed, options.config, options.agent)
    rows = []
    for r in records:
        cell = (r["conductivity"], r["emissivity"], r["heat"])
        rows.append([
            r["law"], f"{r['conductivity']:g} ({NAMES[r['conductivity']]})", f"{r['emissivity']:g}", f"{r['heat']:g}",
            "✓" if cell in PUBLISHED else "–", f"{r['warmest']:.1f}", f"{r['latched']:.2f}",
            "–" if r["latch_s"] is None else f"{r['latch_s']:.1f}", f"{r['S']:.1f}", "✓" if r["success"] > 0.5 else "–",
        ])  # fmt: skip
    columns = ["conduction", "k (W/(m·K))", "ε", "heat (W/m²)", "published"]
    columns += ["warmest (°C)", "latched", "after (s)", "S (s)", "ours"]
    own = ["--config default"] if options.config == "default" else []
    own += [f"--agent {options.agent}"] if options.agent else []
    if options.write and not own:
        draw(records, 0.025)
    body = (
        f"Medians over {options.envs} episodes of {options.seconds:g} s by {options.agent or 'a script'}, which "
        f"knows the hot ball and touches it for {records[0]['touched_s']:.1f} s, in the {options.config} task; "
        "thermometers step with the control (25 ms). A finger whose warmest cell reaches 42.24 °C latches; S "
        "counts seconds of contact after that. Density, heat capacity, cells, the radius of contacts and the "
        f"balls' material are not published (aluminium throughout).\n\n{table(columns, rows)}"
    )
    by = f" ({options.agent or 'script'}, {options.config} task)" if own else ""
    title = f"hot_ball: the cells of figure 4.8 by touch and hold{by}"
    publish(options, title, body, " ".join([f"--envs {options.envs}", *own]))


if __name__ == "__main__":
    main()
