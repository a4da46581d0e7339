"""The one state that engines fill and sensors read: batched link poses, velocities and contact pairs.

Letters: B environment, L link, C contact. Metres, seconds, newtons, world axes. Poses are Warp's own transforms,
whose quaternions are (x, y, z, w): views of them copy nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from brainbench.core.devices import pick_device, warp
from brainbench.core.errors import UsageError, check_each, check_number
from robotics_bridge.physics.kernels.state import StateArrays

_CONTACT = {"distance": 0.0, "force": float("nan"), "position": 0.0, "normal": 0.0, "friction": 0.0, "couple": 0.0}
"""Quantities of a contact, and their values where nobody tells them."""
MOST_ENVS = 1_000_000  # most environments at once; more is a slip of the keys that would fill the memory


@dataclass(eq=False)
class HandState:
    """Buffers with fixed addresses, on one device; engines write them, sensors only read them."""

    pose: Any
    """Warp array [B, L] of transforms: world pose of every link frame (x, y, z, qx, qy, qz, qw)."""
    velocity: Any
    """Warp array [B, L] of spatial vectors: velocity of the link's origin (m/s) and angular velocity (rad/s)."""
    contact_geom: Any
    """Warp array [C] of vec2i: geometry numbers of every contact, of all environments mixed."""
    contact_env: Any
    """Warp array [C] int32: environment of every contact."""
    contact_distance: Any
    """Warp array [C] float32: gap of every contact, negative for overlap (m)."""
    contact_position: Any
    """Warp array [C] of vec3 (m)."""
    contact_normal: Any
    """Warp array [C] of vec3, from the first geometry to the second."""
    contact_force: Any
    """Warp array [C] float32: normal force (N); NaN where the engine does not tell."""
    contact_friction: Any
    """Warp array [C] of vec3: tangential force on the second geometry (N), world axes; 0 where the engine does not
    tell."""
    contact_couple: Any
    """Warp array [C] of vec3: torque on the second geometry about the point (N·m), world axes, of what resists turning
    and rolling; 0 where the engine does not tell."""
    contact_count: Any
    """Warp array [1] int32: contacts found, which may exceed the room C."""
    time: Any
    """Warp array [B] float32 (s)."""

    @classmethod
    def empty(cls, num_envs: int, num_links: int, contacts: int = 0, device: Any = "cpu") -> HandState:
        """Return a state of B environments: L links at rest at the origin, and room C for all contacts together."""
        check_number("environments of a state", num_envs, least=1, most=MOST_ENVS, whole=True)
        check_number("links of a state", num_links, least=1, whole=True)
        check_number("contacts of a state", contacts, least=0, whole=True)
        wp, device = warp(), pick_device(device)
        pose = np.zeros((num_envs, num_links, 7), dtype=np.float32)
        # Unit quaternion in Warp's order (x, y, z, w).
        pose[..., 6] = 1
        room = max(contacts, 1)
        sizes = {
            "velocity": ((num_envs, num_links), wp.spatial_vectorf), "time": (num_envs, wp.float32),
            "contact_count": (1, wp.int32), "contact_env": (room, wp.int32),
            "contact_geom": (room, wp.vec2i), "contact_distance": (room, wp.float32),
            **{f"contact_{name}": (room, wp.vec3f) for name in ("position", "normal", "friction", "couple")},
        }  # fmt: skip
        return cls(
            pose=wp.array(pose, dtype=wp.transformf, device=device),
            contact_force=wp.full(room, float("nan"), dtype=wp.float32, device=device),
            **{name: wp.zeros(size, dtype=kind, device=device) for name, (size, kind) in sizes.items()},
        )

    @cached_property
    def arrays(self) -> Any:
        """The Warp structure of the buffers that kernels take."""
        struct = StateArrays()
        for name in StateArrays.vars:
            setattr(struct, name, getattr(self, name))
        return struct

    @property
    def device(self) -> Any:
        """The Warp device of the buffers."""
        return self.pose.device

    @property
    def num_envs(self) -> int:
        """Number of environments B."""
        return self.pose.shape[0]

    @property
    def num_links(self) -> int:
        """Number of links L."""
        return self.pose.shape[1]

    @property
    def pose_torch(self) -> torch.Tensor:
        """World poses [B, L, 7] as Warp stores them (x, y, z, qx, qy, qz, qw), a view of the same memory.

        What is written here is not normalised: an environment with a quaternion whose length differs from 1 by more
        than .001 counts as diverged.
        """
        return warp().to_torch(self.pose)

    @property
    def velocity_torch(self) -> torch.Tensor:
        """Velocities [B, L, 6] (linear of the origin, angular), a view of the same memory."""
        return warp().to_torch(self.velocity)

    def set_pose(self, pose: ArrayLike | torch.Tensor) -> None:
        """Write world poses [B, L, 7] (or one [L, 7] for all) as (x, y, z, qw, qx, qy, qz), quaternions normalised."""
        self._check_shape(self.pose_torch, pose, "poses")
        values = _tensor(pose)
        length = values[..., 3:].norm(dim=-1, keepdim=True)
        if not values.is_cuda and bool((length == 0).any()):
            where = tuple((length[..., 0] == 0).nonzero()[0].tolist())
            raise UsageError(f"The quaternion of the pose {where} is zero, which is no orientation; use (1, 0, 0, 0).")
        # A unit quaternion stays as it is but for rounding, so that a state that was kept comes back to the bit.
        length = torch.where((length - 1).abs() < 1e-6, torch.ones_like(length), length)
        self.pose_torch.copy_(torch.cat([values[..., :3], values[..., [4, 5, 6, 3]] / length], dim=-1))

    def set_velocity(self, velocity: ArrayLike | torch.Tensor) -> None:
        """Write velocities [B, L, 6] (or one [L, 6] for all) as (linear of the origin, angular)."""
        self._check_shape(self.velocity_torch, velocity, "velocities")
        self.velocity_torch.copy_(_tensor(velocity))

    def set_contacts(self, env: ArrayLike, geometries: ArrayLike, **optional: ArrayLike) -> None:
        """Replace all contacts.

        Args:
            env: environment [n] of each contact.
            geometries: pairs [n, 2] of geometry numbers.
            **optional: ``distance``, ``force`` [n], ``position``, ``normal``, ``friction``, ``couple`` [n, 3]. What is
                not given is set to 0, and forces to NaN: nothing is left of earlier contacts.
        """
        wp = warp()
        environments, pairs = (np.asarray(values, dtype=np.float64).reshape(-1) for values in (env, geometries))
        count, room = len(environments), self.contact_env.shape[0]
        if count > room:
            raise UsageError(
                f"The state has room for {room} contacts; received {count}: make it with contacts={count}."
            )
        if len(pairs) != 2 * count:
            raise UsageError(f"Every contact needs one pair of geometries; received {count} and {len(pairs) / 2:g}.")
        for environment in (environments.min(initial=0), environments.max(initial=0)):
            check_number("environment of a contact", environment, least=0, below=self.num_envs)
        numbers = np.concatenate([environments, pairs])
        if not (numbers == np.rint(numbers)).all():
            raise UsageError("Environments and geometries of contacts are whole numbers; others came.")
        check_each("quantity of a contact", optional, _CONTACT)
        for name, values in {"env": environments, "geom": pairs, **_CONTACT, **optional}.items():
            view = wp.to_torch(getattr(self, f"contact_{name}"))[:count]
            if isinstance(values, float):
                view.fill_(values)
            else:
                rows = np.asarray(values, dtype=np.float32 if view.dtype.is_floating_point else np.int32)
                if rows.size != view.numel():
                    raise UsageError(f"{name} of contacts has the shape {tuple(view.shape)}; received {rows.shape}.")
                view.copy_(_tensor(rows.reshape(tuple(view.shape))))
        self.contact_count.fill_(count)

    def _check_shape(self, view: torch.Tensor, values: Any, what: str) -> None:
        shape, given = tuple(view.shape), tuple(np.shape(values))
        if given not in (shape, shape[1:]):
            raise UsageError(f"The {what} of this state have the shape {shape}; received {given}.")


def _tensor(values: Any) -> torch.Tensor:
    return values if isinstance(values, torch.Tensor) else torch.from_numpy(np.array(values, dtype=np.float32))


EnvIds = Sequence[int] | np.ndarray | torch.Tensor  # numbers of environments, or a mask [B] bool


def select_envs(env_ids: EnvIds | None, num_envs: int, device: torch.device | str) -> torch.Tensor:
    """Return a mask [B] bool of the chosen environments, a new one; None chooses all."""
    device = torch.device(device)
    if env_ids is None:
        return torch.ones(num_envs, dtype=torch.bool, device=device)
    chosen = torch.zeros(num_envs, dtype=torch.bool, device=device)
    numbers = torch.as_tensor(env_ids, device=device)
    if numbers.dtype == torch.bool:
        if numbers.shape != chosen.shape:
            raise UsageError(f"A mask has one bool per environment ({num_envs}); received {tuple(numbers.shape)}.")
        return chosen | numbers
    if numbers.numel():
        if numbers.is_floating_point() or numbers.is_complex():
            first = numbers.flatten()[0].item()
            raise UsageError(f"Environments to reset are whole numbers or a mask; received {first}.")
        if device.type == "cpu" and (outside := numbers[(numbers < 0) | (numbers >= num_envs)]).numel():
            raise UsageError(f"Environments to reset are 0 to {num_envs - 1}; received {outside[0].item()}.")
        chosen[numbers.long()] = True
    return chosen
