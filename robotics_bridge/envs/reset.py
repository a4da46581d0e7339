"""Beginnings of episodes: where hand and object start, and what the object weighs. Letters: B environment, J joint."""

from __future__ import annotations

import numpy as np
import torch

from brainbench.core.rotations import about, constant, multiply
from robotics_bridge.envs.grasps import grasps_for
from robotics_bridge.envs.state import EnvState


class EpisodeReset:
    """Starts new episodes of an environment batch, without looking at which from the host."""

    def __init__(self, state: EnvState) -> None:
        self._nominal = {name: value.clone() for name, value in state.simulation.fields.items()}
        bodies = state.object_bodies.cpu().numpy()
        geoms = np.flatnonzero(np.isin(np.asarray(state.simulation.model.geom_bodyid), bodies))
        self._geoms = torch.as_tensor(geoms, device=state.device)

        def floats(values: object) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=state.device)

        self._bottom = floats([shape.bottom for shape in state.model.shapes])[state.shape_of]
        self._grasps = None
        if state.task.starts == "grasps":
            self._grasps = {k: floats(v) for k, v in grasps_for(state.task, state.hand, state.model).items()}
            # Grasps belong to a shape: each environment takes one of its own.
            self._grasp_rows = self._grasps["rows"][state.shape_of].long()
        sites = state.task.placement.sites
        self._sites = floats(sites) if sites else None

    def __call__(self, state: EnvState, mask: torch.Tensor) -> None:
        """Start new episodes where the mask [B] bool is set."""
        column, episode, simulation = mask.unsqueeze(1), state.episode, state.simulation
        qpos, targets = self._starts(state)
        episode.rest_targets.copy_(torch.where(column, targets, episode.rest_targets))
        self._randomise_objects(state, mask)
        simulation.reset(mask, qpos)
        state.actuators.reset(mask, state.draw)
        if state.task_state is not None:
            state.task_state.reset(mask)
        for buffer in (episode.action, episode.last_action, episode.reward_sums):
            buffer.masked_fill_(column, 0.0)
        for buffer in (episode.age, episode.steps, episode.returns, episode.metric):
            buffer.masked_fill_(mask, 0)
        joints, pose = simulation.qpos[:, state.actuators.qpos_columns], state.target_pose
        episode.start_joints.copy_(torch.where(column, joints, episode.start_joints))
        episode.start_position.copy_(torch.where(column, pose[:, :3], episode.start_position))
        if state.task.push is not None:
            fresh = state.draw(1, *state.task.push.interval)[:, 0]
            episode.push_left.copy_(torch.where(mask, fresh, episode.push_left))
        state.goals.reset(mask, pose[:, 3:], state.draw)
        if state.touch is not None:
            state.touch.reset(mask)
        state.contacts.reset(mask)
        simulation.refresh()
        state.contacts.refresh(mask)
        state.started = True

    def _starts(self, state: EnvState) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions [B, nq] for new episodes, and the actuators' targets [B, J] without action."""
        place, count, joints = state.task.placement, len(state.model.objects), state.actuators.qpos_columns
        qpos = state.simulation.start.clone()
        if self._grasps is not None:
            size = self._grasp_rows.shape[1]
            pick = (state.draw(1, 0.0, 1.0)[:, 0] * size).long().clamp(max=size - 1)
            row = self._grasp_rows.gather(1, pick.unsqueeze(1))[:, 0]
            qpos[:, joints] = self._grasps["joints"][row]
            qpos[:, state.object_qpos] = self._grasps["object"][row]
            return qpos, self._grasps["target"][row]
        qpos[:, joints] = state.rest
        poses = torch.zeros(state.num_envs, count, 7, device=state.device)
        upright = constant(place.quaternion, poses).expand(state.num_envs, -1)
        up = constant((0.0, 0.0, 1.0), poses)
        if self._sites is not None:
            # Sorting random numbers gives a random order of the sites: objects never share one.
            order = state.draw(len(self._sites), 0.0, 1.0).argsort(dim=1)[:, :count]
            poses[..., :3] = self._sites[order]
        for index in range(count):
            x, y, yaw = (state.draw(1, *span)[:, 0] for span in (place.x, place.y, place.yaw))
            poses[:, index, 0] += x
            poses[:, index, 1] += y
            poses[:, index, 2] += place.height + self._bottom
            poses[:, index, 3:] = multiply(about(up, yaw), upright)
        qpos[:, state.object_qpos] = poses.flatten(1)
        return qpos, state.rest.expand_as(state.episode.rest_targets)

    def _randomise_objects(self, state: EnvState, mask: torch.Tensor) -> None:
        """Draw friction and mass of the objects anew where the mask [B] is set."""
        nominal, changes, fields = self._nominal, state.task.object_changes, state.simulation.fields
        if state.started and not changes.each_reset:
            return
        ratio, offset = state.draw(1, *changes.friction), state.draw(1, *changes.mass_offset)
        bodies, geoms, column = state.object_bodies, self._geoms, mask.unsqueeze(1)
        mass = (nominal["body_mass"][:, bodies] + offset).clamp(min=1e-6)
        # Inertia grows with the mass as for a body of other density and the same shape.
        growth = (mass / nominal["body_mass"][:, bodies]).unsqueeze(2)
        inertia = nominal["body_inertia"][:, bodies] * growth
        # What MuJoCo's mj_setConst derives for a body that moves freely.
        weights = torch.stack((1 / mass, (1 / inertia).mean(dim=2)), dim=2)
        values = {
            "body_mass": (bodies, mass), "body_subtreemass": (bodies, mass), "body_inertia": (bodies, inertia),
            "body_invweight0": (bodies, weights),
            "geom_friction": (geoms, nominal["geom_friction"][:, geoms] * ratio.unsqueeze(2)),
        }  # fmt: skip
        for name, (where, value) in values.items():
            chosen = column if value.ndim == 2 else column.unsqueeze(2)
            fields[name][:, where] = torch.where(chosen, value, fields[name][:, where])
        state.episode.friction.copy_(torch.where(mask, ratio[:, 0], state.episode.friction))
        state.episode.mass.copy_(torch.where(mask, mass[:, 0], state.episode.mass))
