"""How episodes begin: where hand and object start, and what the object weighs. Letters: B environment, J joint."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.rotations import about, constant, multiply

if TYPE_CHECKING:
    import torch

    from robotics_bridge.envs.env import Env


class Resets:
    """Starts new episodes of an environment batch, without looking at which from the host."""

    def __init__(self, env: Env) -> None:
        import torch

        self._nominal = {name: value.clone() for name, value in env.world.fields.items()}
        first = env.world.model
        bodies = [first.body(name).id for name in env.model.objects]
        geoms = np.flatnonzero(np.isin(np.asarray(first.geom_bodyid), bodies))
        self._geoms = torch.as_tensor(geoms, device=env.device)
        rows = torch.as_tensor(env.world.shape_of, device=env.device)

        def floats(values: object) -> torch.Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=env.device)

        self._bottom = floats([shape.bottom for shape in env.model.shapes])[rows]
        self._grasps = None
        if env.task.starts == "grasps":
            from robotics_bridge.envs.grasps import grasps_for

            self._grasps = {k: floats(v) for k, v in grasps_for(env.task, env.hand, env.model).items()}
            # Grasps belong to a shape: each environment takes one of its own.
            self._grasp_rows = self._grasps["rows"][rows].long()
        sites = env.task.placement.sites
        self._sites = floats(sites) if sites else None
        self.first = True
        """Whether no episode began yet: friction and mass are drawn then in any case."""

    def begin(self, env: Env, mask: torch.Tensor) -> None:
        """Start new episodes where the mask [B] bool is set."""
        import torch

        column = mask.unsqueeze(1)
        qpos, home = self._starts(env)
        env._home.copy_(torch.where(column, home, env._home))
        self._change_objects(env, mask)
        env.world.reset(mask, qpos)
        env.drives.reset(mask, env._draw)
        if env.watch is not None:
            env.watch.reset(mask)
        for buffer in (env.action, env.last_action, env._sums):
            buffer.masked_fill_(column, 0.0)
        for buffer in (env.episode_length_buf, env._steps, env._return, env.metric):
            buffer.masked_fill_(mask, 0)
        joints = env.world.qpos[:, env.drives.positions]
        env._start_joints.copy_(torch.where(column, joints, env._start_joints))
        place = env.object_pose[env.rows, env.target, :3]
        env._start_position.copy_(torch.where(column, place, env._start_position))
        if env.task.push is not None:
            fresh = env._draw(1, *env.task.push.interval)[:, 0]
            env._push_left.copy_(torch.where(mask, fresh, env._push_left))
        env.goals.reset(mask, env._object_quat(), env._draw)
        if env.touch is not None:
            env.touch.reset(mask)
        env.contacts.reset(mask)
        env.world.refresh()
        env.contacts.refresh(mask)
        self.first = False

    def _starts(self, env: Env) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions [B, nq] for new episodes, and the drives' targets [B, J] without action."""
        import torch

        place, count = env.task.placement, len(env.model.objects)
        qpos = env.world.start.clone()
        if self._grasps is not None:
            size = self._grasp_rows.shape[1]
            pick = (env._draw(1, 0.0, 1.0)[:, 0] * size).long().clamp(max=size - 1)
            row = self._grasp_rows.gather(1, pick.unsqueeze(1))[:, 0]
            qpos[:, env.drives.positions] = self._grasps["joints"][row]
            qpos[:, env._object_columns] = self._grasps["object"][row]
            return qpos, self._grasps["target"][row]
        qpos[:, env.drives.positions] = env._rest
        poses = torch.zeros(env.num_envs, count, 7, device=env.device)
        home = constant(place.quaternion, poses).expand(env.num_envs, -1)
        up = constant((0.0, 0.0, 1.0), poses)
        if self._sites is not None:
            order = env._draw(len(self._sites), 0.0, 1.0).argsort(dim=1)[:, :count]
            poses[..., :3] = self._sites[order]
        for index in range(count):
            x, y, yaw = (env._draw(1, *span)[:, 0] for span in (place.x, place.y, place.yaw))
            poses[:, index, 0] += x
            poses[:, index, 1] += y
            poses[:, index, 2] += place.height + self._bottom
            poses[:, index, 3:] = multiply(about(up, yaw), home)
        qpos[:, env._object_columns] = poses.flatten(1)
        return qpos, env._rest.expand_as(env._home)

    def _change_objects(self, env: Env, mask: torch.Tensor) -> None:
        """Draw friction and mass of the objects anew where the mask [B] is set."""
        import torch

        nominal, changes, fields = self._nominal, env.task.object_changes, env.world.fields
        if not (changes.each_reset or self.first):
            return
        ratio, offset = env._draw(1, *changes.friction), env._draw(1, *changes.mass_offset)
        bodies, geoms, column = env._bodies, self._geoms, mask.unsqueeze(1)
        mass = (nominal["body_mass"][:, bodies] + offset).clamp(min=1e-6)
        growth = (mass / nominal["body_mass"][:, bodies]).unsqueeze(2)
        inertia = nominal["body_inertia"][:, bodies] * growth
        weights = torch.stack((1 / mass, (1 / inertia).mean(dim=2)), dim=2)
        values = {
            "body_mass": (bodies, mass), "body_subtreemass": (bodies, mass), "body_inertia": (bodies, inertia),
            "body_invweight0": (bodies, weights),
            "geom_friction": (geoms, nominal["geom_friction"][:, geoms] * ratio.unsqueeze(2)),
        }  # fmt: skip
        for name, (where, value) in values.items():
            chosen = column if value.ndim == 2 else column.unsqueeze(2)
            fields[name][:, where] = torch.where(chosen, value, fields[name][:, where])
        env.friction.copy_(torch.where(mask, ratio[:, 0], env.friction))
        env.mass.copy_(torch.where(mask, mass[:, 0], env.mass))
