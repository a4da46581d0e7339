"""The one state that engines fill and sensors read: batched link poses, velocities and contact pairs.

Letters: B environment, L link, C contact. Metres, seconds, newtons, world axes. Poses are Warp's own transforms,
whose quaternions are (x, y, z, w): views of them copy nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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


class HandState:
    """Buffers with fixed addresses, on one device; engines write them, sensors only read them.

    Every array of :class:`~robotics_bridge.physics.kernels.state.StateArrays` is an attribute: ``state.pose``,
    ``state.contact_force``, …
    """

    def __init__(self, arrays: Any) -> None:
        self.arrays = arrays
        """The Warp structure of the buffers that kernels take."""

    def __getattr__(self, name: str) -> Any:
        if name in StateArrays.vars:
            return getattr(self.arrays, name)
        raise AttributeError(f"A HandState has no {name!r}.")

    @classmethod
    def empty(cls, num_envs: int, num_links: int, contacts: int = 0, device: Any = "cpu") -> HandState:
        """Return a state of B environments: L links at rest at the origin, and room C for all contacts together."""
        check_number("environments of a state", num_envs, least=1, most=MOST_ENVS, whole=True)
        check_number("links of a state", num_links, least=1, whole=True)
        check_number("contacts of a state", contacts, least=0, whole=True)
        wp, device, arrays = warp(), pick_device(device), StateArrays()
        links = (num_envs, num_links)
        sizes = {"pose": links, "velocity": links, "time": num_envs, "contact_count": 1}
        for name, field in StateArrays.vars.items():
            shape = sizes.get(name, max(contacts, 1))
            setattr(arrays, name, wp.zeros(shape, dtype=field.type.dtype, device=device))
        # Unit quaternions in Warp's order (x, y, z, w).
        arrays.pose.fill_(wp.transformf(*[0.0] * 6, 1.0))
        arrays.contact_force.fill_(math.nan)
        return cls(arrays)

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
