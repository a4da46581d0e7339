"""MuJoCo Warp: all environments on one device, read without copies to the host."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from brainbench.core.devices import mujoco_module, pick_device, record_launches, warp
from brainbench.core.errors import UsageError, needing, unknown_name
from brainbench.core.reading.ranges import check_number
from robotics_bridge.physics.kernels.state import fill_contacts, fill_links
from robotics_bridge.physics.scene import TouchScene, check_model_fields, differing_fields
from robotics_bridge.physics.state import MOST_ENVS, EnvIds, HandState, select_envs

mujoco = mujoco_module()

_DERIVED = ("dof_length",)
"""Fields that the compiler derives for the thresholds of sleeping bodies; the first variant's serve all."""
_MASSES = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "qpos0", "dof_armature")


class MujocoWarpEngine:
    """MuJoCo Warp that fills a :class:`HandState` on its own device; the sequel of a step is as in ``MujocoEngine``.

    On CUDA the step and the filling of the state are one recorded graph.

    Args:
        model: as of ``MujocoEngine``; so are ``num_envs``, ``assignment`` and ``fields``, which MuJoCo Warp must batch.
        device: ``cuda``, ``cuda:1`` or ``cpu`` (slow; for tests).
        contacts: room for contacts per environment, on average; by default sixteen, and nine per moving link.
    """

    def __init__(
        self,
        model: Any | Sequence[Any],
        num_envs: int,
        *,
        device: str = "cuda",
        fields: Mapping[str, ArrayLike] | None = None,
        assignment: Sequence[int] = (),
        contacts: int | None = None,
    ) -> None:
        self._engine = _mujoco_warp()
        check_number("environments of an engine", num_envs, least=1, most=MOST_ENVS, whole=True)
        wp = warp()
        self._device = pick_device(device)
        models = list(model) if isinstance(model, (list, tuple)) else [model]
        self.model: Any = models[0]
        self.num_envs = num_envs
        self.scene: TouchScene = TouchScene.from_mujoco(models[0], models[1:], assignment)
        order = list(assignment) or list(range(len(models)))
        varied = differing_fields(models, order, num_envs) if len(models) > 1 else {}
        varied |= check_model_fields(self.model, fields or {}, num_envs)
        self._varied = tuple(varied)
        with wp.ScopedDevice(self._device):
            self._m = _put_model(self._engine, self.model, varied, num_envs)
            contacts = contacts or 16 + 9 * int(np.count_nonzero(self.model.body_weldid))
            # Room for constraint rows: four per contact (two tangents in a pyramid), limits, equalities, tendons,
            # friction of joints.
            rows = 4 * contacts + 2 * self.model.njnt + 6 * self.model.neq + 2 * self.model.ntendon + self.model.nv
            room = {"nconmax": contacts, "njmax": rows}
            self.data: Any = self._engine.make_data(self.model, nworld=num_envs, **room)
            """The ``mujoco_warp.Data`` behind the state."""
            if set(varied) & set(_MASSES):
                self._engine.set_const(self._m, self.data)
            self._root = wp.array(np.asarray(self.model.body_rootid, dtype=np.int32), dtype=wp.int32)
        contact = self.data.contact
        blank = HandState.empty(num_envs, self.model.nbody, contact.worldid.shape[0], self._device)
        # The engine's own arrays serve where they have the form of the state's.
        self.state: HandState = replace(
            blank, contact_geom=contact.geom, contact_env=contact.worldid, contact_distance=contact.dist,
            contact_position=contact.pos, contact_count=self.data.nacon, time=self.data.time,
        )  # fmt: skip
        self._replay: Callable[[], None] | None = None
        self.forward()

    @property
    def timestep(self) -> float:
        """Seconds of one step."""
        return float(self.model.opt.timestep)

    @property
    def qpos(self) -> torch.Tensor:
        """Positions [B, nq], a view."""
        return warp().to_torch(self.data.qpos)

    @property
    def qvel(self) -> torch.Tensor:
        """Velocities [B, nv], a view."""
        return warp().to_torch(self.data.qvel)

    @property
    def ctrl(self) -> torch.Tensor:
        """Controls [B, nu], a view."""
        return warp().to_torch(self.data.ctrl)

    def field(self, name: str) -> torch.Tensor:
        """Return a model field [B, ...], a view to write to; derived constants are the caller's business."""
        array = getattr(self._m, name, None)
        if array is None or array.shape[0] != self.num_envs or (self.num_envs == 1 and name not in self._varied):
            raise unknown_name("field that differs between environments", name, self._varied)
        return warp().to_torch(array)

    def kinematics(self) -> None:
        """Refresh poses and velocities of the state at the current positions; contacts stay those of the last step."""
        wp = warp()
        with wp.ScopedDevice(self._device):
            for stage in (self._engine.kinematics, self._engine.com_pos, self._engine.com_vel):
                stage(self._m, self.data)
            self._fill_links()

    def set(self, **values: ArrayLike | torch.Tensor) -> None:
        """Write ``qpos``, ``qvel``, ``ctrl``, … of every environment [B, n] (or one row [n] for all)."""
        wp = warp()
        for name, value in values.items():
            if not isinstance(field := getattr(self.data, name, None), wp.array):
                arrays = [key for key, item in vars(self.data).items() if isinstance(item, wp.array)]
                raise unknown_name("array of the simulation", name, arrays)
            view = wp.to_torch(field)
            rows = value if isinstance(value, torch.Tensor) else torch.as_tensor(np.array(value))
            try:
                view.copy_(rows.to(view.dtype).expand_as(view))
            except RuntimeError:
                shapes = f"has the shape {tuple(view.shape)} here; received {tuple(rows.shape)}"
                raise UsageError(f"{name} {shapes}.") from None

    def step(self, steps: int = 1) -> None:
        """Advance every environment by so many steps and refresh the state."""
        check_number("steps of an engine", steps, least=1, whole=True)
        with warp().ScopedDevice(self._device):
            for _ in range(steps):
                if self._replay:
                    self._replay()
                    continue
                # The first step compiles; recording must not.
                self._step()
                if self._device.is_cuda:
                    self._replay = record_launches(self._step, self._device)

    def forward(self) -> None:
        """Refresh the state at the current positions and velocities, without advancing."""
        with warp().ScopedDevice(self._device):
            self._engine.forward(self._m, self.data)
            self._fill()

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Put environments (all by default), given by numbers or a mask, back to the model's start."""
        wp = warp()
        with wp.ScopedDevice(self._device):
            mask = None
            if env_ids is not None:
                mask = wp.from_torch(select_envs(env_ids, self.num_envs, wp.device_to_torch(self._device)))
            self._engine.reset_data(self._m, self.data, mask)
        self.forward()

    def _step(self) -> None:
        self._engine.step(self._m, self.data)
        self._fill()

    def _fill_links(self) -> None:
        wp, d, state = warp(), self.data, self.state
        # MuJoCo's quaternions are (w, x, y, z); the kernel stores them as Warp's (x, y, z, w).
        poses = [d.xpos, d.xquat, d.cvel, d.subtree_com, self._root, state.pose, state.velocity]
        wp.launch(fill_links, dim=(self.num_envs, self.model.nbody), inputs=poses, device=self._device)

    def _fill(self) -> None:
        wp, d, state = warp(), self.data, self.state
        self._fill_links()
        pyramidal = int(self.model.opt.cone == 0)
        c = d.contact
        inputs = [d.nacon, c.worldid, c.frame, c.dim, c.efc_address, d.efc.force, c.friction, pyramidal]
        inputs += [state.contact_normal, state.contact_force, state.contact_friction]
        wp.launch(fill_contacts, dim=c.worldid.shape[0], inputs=inputs, device=self._device)


def _mujoco_warp() -> Any:
    warp()
    with needing("mujoco-warp", extra="gpu", purpose="Simulation on a GPU"):
        import mujoco_warp
    return mujoco_warp


def _put_model(engine: Any, model: Any, varied: Mapping[str, np.ndarray], num_envs: int) -> Any:
    wp = warp()
    fields = engine.Model.__dataclass_fields__
    shapes = {name: getattr(field.type, "shape", ()) for name, field in fields.items()}
    usable = {name: value for name, value in varied.items() if shapes.get(name, ("",))[:1] == ("*",)}
    # What the compiler derived for collision trees on the host plays no part on the device.
    fixed = sorted(name for name in varied if name not in usable and name in fields and name not in _DERIVED)
    if fixed:
        raise UsageError(
            f"MuJoCo Warp keeps {', '.join(fixed)} equal in all environments; use MujocoEngine, or variants that "
            "differ in sizes, masses, meshes and other numbers only."
        )
    model = copy.copy(model)
    # MuJoCo Warp never puts an environment back to its start, and refuses to be told so.
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    device_model = engine.put_model(model, batch_sizes=dict.fromkeys(usable, num_envs))
    for name, value in usable.items():
        target = getattr(device_model, name)
        rows = np.ascontiguousarray(value).reshape(*target.shape, *getattr(target.dtype, "_shape_", ()))
        target.assign(wp.array(rows, dtype=target.dtype, device=target.device))
    return device_model
