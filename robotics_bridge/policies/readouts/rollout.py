"""One rollout of a policy, which serves every arm of a probe.

Letters: T control step, B environment, S sub-step, N taxel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from brainbench.core.errors import UsageError
from robotics_bridge.envs.env import Env
from robotics_bridge.policies.encoders.calibration import HandCalibration
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.evaluate import Acting, forget
from robotics_bridge.sensors.noise.model import PRESETS

TARGETS = ("position", "velocity", "spin", "contact")
"""Object (m, m/s, rad/s), and the centre of the contact forces on it (m), [3] each, world axes."""
CALIBRATION_SECONDS = 2.0
"""Length of the episodes of a calibration."""
_SETTLING = 10
"""Control steps after an episode's start that are left out: the object falls onto the palm."""


@dataclass(frozen=True, eq=False)
class TouchRollout:
    """What a policy did and felt."""

    proprio: torch.Tensor
    """[T, B, n]."""
    taxels: torch.Tensor
    """[T, B, S, N, 6] (N, N·m)."""
    begun: torch.Tensor
    """[T, B] bool: first step of an episode."""
    targets: Mapping[str, torch.Tensor]
    """Name → [T, B, 3]; NaN where undefined."""
    valid: torch.Tensor
    """[T, B] bool: past the settling of its episode."""
    link_pose: torch.Tensor
    """[T, B, L, 7] of the tactile links in the palm's frame (m, quaternion)."""
    floor: float = 0.0
    """Largest reading of a taxel that touches nothing (N, N·m)."""

    @property
    def wanted(self) -> torch.Tensor:
        """All targets side by side [T, B, D], in the order of :data:`TARGETS`."""
        return torch.cat([self.targets[name] for name in TARGETS], -1)


@torch.no_grad()
def collect(env: Env, policy: Acting, seconds: float) -> TouchRollout:
    """Run a policy and return what it felt, and what is to be read from it."""
    if env.options.observe != "force_torque" or env.touch is None:
        raise UsageError("A probe reads force and torque: make the environment with observe='force_torque'.")
    observations = env.reset()
    age = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
    # A policy may remember what it did before this rollout.
    forget(policy, age == 0)
    kept: dict[str, list[torch.Tensor]] = {}
    for _ in range(round(seconds / env.step_dt)):
        velocity, spin = env.state.target_velocity
        row = {"proprio": observations["proprio"], "taxels": observations["tactile"], "begun": age == 0}
        row["link_pose"] = env.link_pose
        row |= {"position": env.state.target_pose[:, :3], "velocity": velocity, "spin": spin}
        row |= {"contact": _centre(env, age), "valid": age >= _SETTLING}
        for name, value in row.items():
            kept.setdefault(name, []).append(value.clone())
        observations, _, terminated, truncated, _ = env.step(policy(observations))
        done = terminated | truncated
        forget(policy, done)
        age = torch.where(done, 0, age + 1)
    stacked = {name: torch.stack(rows) for name, rows in kept.items()}
    targets = {name: stacked.pop(name) for name in TARGETS}
    # Six standard deviations of white noise, which is 0 where taxels have none.
    floor = 6 * PRESETS["published-force_torque"].white * env.options.noisy
    return TouchRollout(targets=targets, floor=floor, **stacked)


@torch.no_grad()
def calibrate(env: Env, policy: Acting, grid: TaxelGrid, seed: int) -> HandCalibration:
    """Return the unit of force and moment of episodes of another seed, in which nothing is read; then begin anew.

    As students, encoders know their unit before the episodes in which they are tried.
    """
    env.seed(seed + 1)
    felt = collect(env, policy, CALIBRATION_SECONDS).taxels
    env.seed(seed)
    return HandCalibration.fit(grid(felt.flatten(0, 1)).cpu())


def _centre(env: Env, age: torch.Tensor) -> torch.Tensor:
    """Return the centre [B, 3] of the contact forces on the object in the last physics step, NaN without contact."""
    state, scene = env.simulation.state, env.simulation.engine.scene
    count = min(int(state.contact_count.numpy()[0]), state.contact_env.shape[0])
    names = ("env", "geom", "position", "force")
    row, geometries, position, force = (getattr(state, f"contact_{name}").numpy()[:count] for name in names)
    link = scene.link_index(env.state.model.objects[0])
    mine = (np.asarray(scene.link_of)[geometries] == link).any(axis=1) & (force > 0)
    sums, total = np.zeros((env.num_envs, 3)), np.zeros(env.num_envs)
    np.add.at(sums, row[mine], position[mine] * force[mine, None])
    np.add.at(total, row[mine], force[mine])
    with np.errstate(invalid="ignore"):
        centre = torch.as_tensor(sums / np.where(total > 0, total, np.nan)[:, None], dtype=torch.float32)
    # What an ended episode touched last is no contact of the next one.
    return torch.where((age == 0)[:, None], torch.nan, centre.to(age.device))
