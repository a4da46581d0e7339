"""C MuJoCo on the processor, one simulation per environment, stepped by a pool of threads; MuJoCo Warp on one device.

The latter is read without copies to the host.
"""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import mujoco_module, pick_device, record_launches, warp
from brainbench.core.errors import UsageError, check_number, needing, unknown_name
from robotics_bridge.physics.kernels.state import fill_contacts, fill_links
from robotics_bridge.physics.scene import TouchScene, check_model_fields, differing_fields, model_fields
from robotics_bridge.physics.state import MOST_ENVS, EnvIds, HandState, select_envs

mujoco = mujoco_module()


class MujocoEngine:
    """Batched C MuJoCo that fills a :class:`HandState`.

    The state after :meth:`step` is the one from which MuJoCo computed the last step (poses, velocities and contacts
    of one instant); :meth:`forward` refreshes it to the current positions.

    Args:
        model: a compiled ``mujoco.MjModel``, or variants of one that differ in numbers only (see
            :func:`~robotics_bridge.physics.scene.compile_variants`); copies are simulated, without the flag
            ``autoreset``.
        num_envs: B.
        threads: how many work at once, at least 1; every processor by default.
        fields: values per environment [B, ...] of any model field, e.g. ``{"body_mass": …}``.
        assignment: variant of environment e is ``assignment[e % len(assignment)]``; each in turn by default.
        contacts: room for contacts per environment.
    """

    def __init__(
        self,
        model: Any | Sequence[Any],
        num_envs: int,
        *,
        threads: int | None = None,
        fields: Mapping[str, ArrayLike] | None = None,
        assignment: Sequence[int] = (),
        contacts: int = 64,
    ) -> None:
        check_number("environments of an engine", num_envs, least=1, most=MOST_ENVS, whole=True)
        if threads is not None:
            check_number("threads of an engine", threads, least=1, whole=True)
        models: list[Any] = list(map(copy.copy, model if isinstance(model, (list, tuple)) else [model]))
        self.model: Any = models[0]
        """A copy of the model, or of the first of its variants."""
        for each in models:
            # An environment that diverges shows it; C MuJoCo would put it back to its start and go on.
            each.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        order = list(assignment) or range(len(models))
        self.scene: TouchScene = TouchScene.from_mujoco(models[0], models[1:], assignment)
        self.num_envs = num_envs
        varied = check_model_fields(models[0], fields or {}, num_envs)
        self.models: list[Any] = [models[order[env % len(order)]] for env in range(num_envs)]
        """The ``mujoco.MjModel`` of every environment."""
        self._own_models = bool(varied)
        if varied:
            self.models = list(map(copy.copy, self.models))
            for env, model_of in enumerate(self.models):
                for name, rows in varied.items():
                    getattr(model_of, name)[...] = rows[env]
                # Masses, inertias and the like enter constants that the compiler derived.
                mujoco.mj_setConst(model_of, mujoco.MjData(model_of))
        self.data: list[Any] = [mujoco.MjData(m) for m in self.models]
        """The ``mujoco.MjData`` of every environment."""
        self.state: HandState = HandState.empty(num_envs, self.model.nbody, contacts * num_envs, "cpu")
        """Refreshed by :meth:`step`, :meth:`forward` and :meth:`reset`."""
        self._gatherer = _Gatherer(self.model, self.data, self.state)
        workers = max(1, min(threads or os.cpu_count() or 1, num_envs))
        self._pool = ThreadPoolExecutor(workers) if workers > 1 else None
        self._chunks = np.array_split(np.arange(num_envs), workers)
        self.forward()

    @property
    def timestep(self) -> float:
        """Seconds of one step."""
        return float(self.model.opt.timestep)

    @property
    def qpos(self) -> NDArray[np.float64]:
        """Positions [B, nq], a copy; write with :meth:`set`."""
        return np.stack([data.qpos for data in self.data])

    @property
    def qvel(self) -> NDArray[np.float64]:
        """Velocities [B, nv], a copy; write with :meth:`set`."""
        return np.stack([data.qvel for data in self.data])

    def set(self, **values: ArrayLike) -> None:
        """Write ``qpos``, ``qvel``, ``ctrl``, … of every environment [B, n] (or one row [n] for all)."""
        for name, value in values.items():
            if not isinstance(field := getattr(self.data[0], name, None), np.ndarray):
                raise unknown_name("array of the simulation", name, model_fields(self.data[0]))
            shape = (self.num_envs, *field.shape)
            try:
                rows = np.broadcast_to(np.asarray(value, dtype=float), shape)
            except ValueError:
                raise UsageError(f"{name} has the shape {shape} here; received {np.shape(value)}.") from None
            for data, row in zip(self.data, rows, strict=True):
                getattr(data, name)[...] = row

    def set_fields(self, env: int, values: Mapping[str, ArrayLike]) -> None:
        """Write model fields of one environment, in an engine made with ``fields``, but no derived constants."""
        if not self._own_models:
            raise UsageError("The environments share one model; make the engine with fields={...} to change them.")
        for name, value in values.items():
            getattr(self.models[env], name)[...] = value

    def integration_state(self) -> NDArray[np.float64]:
        """Return all that the next step of every environment depends on, [B, n]."""
        kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        rows = np.zeros((self.num_envs, mujoco.mj_stateSize(self.model, kind)))
        for env, row in enumerate(rows):
            mujoco.mj_getState(self.models[env], self.data[env], row, kind)
        return rows

    def set_integration_state(self, rows: NDArray[np.float64]) -> None:
        """Take up what :meth:`integration_state` returned."""
        kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        for env, row in enumerate(rows):
            mujoco.mj_setState(self.models[env], self.data[env], row, kind)

    def kinematics(self) -> None:
        """Refresh poses and velocities of the state at the current positions; contacts stay those of the last step."""

        def _work(env: int) -> None:
            model, data = self.models[env], self.data[env]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)

        self._each(_work)

    def step(self, steps: int = 1) -> None:
        """Advance every environment by so many steps and refresh the state."""
        check_number("steps of an engine", steps, least=1, whole=True)
        self._each(lambda env: mujoco.mj_step(self.models[env], self.data[env], steps))

    def forward(self) -> None:
        """Refresh the state at the current positions and velocities, without advancing."""
        self._each(lambda env: mujoco.mj_forward(self.models[env], self.data[env]))

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Put environments (all by default), given by numbers or a mask, back to the model's start."""
        for env in select_envs(env_ids, self.num_envs, "cpu").nonzero().flatten().tolist():
            mujoco.mj_resetData(self.models[env], self.data[env])
        self.forward()

    def _each(self, work: Any) -> None:
        """Do some work in every environment, by all threads, and refresh the state."""
        gather = self._gatherer.gather

        def _run(chunk: NDArray[np.int64]) -> None:
            for env in chunk.tolist():
                work(env)
                gather(env)

        if self._pool is None:
            _run(self._chunks[0])
        else:
            list(self._pool.map(_run, self._chunks))
        self._gatherer.finish()


class _Gatherer:
    """Copies what each environment computed into the shared buffers."""

    def __init__(self, model: Any, data: Sequence[Any], state: HandState) -> None:
        bodies, count = model.nbody, len(data)
        self._data, self._state = data, state
        self._pose = state.pose.numpy()
        self._velocity = state.velocity.numpy()
        self._time = state.time.numpy()
        self._twist = np.zeros((count, bodies, 6))
        self._com = np.zeros((count, bodies, 3))
        self._root = np.asarray(model.body_rootid)
        self._views = [(d.xpos, d.xquat, d.cvel, d.subtree_com) for d in data]
        self._contacts: list[tuple[NDArray[Any], ...]] = [()] * count
        self._model = model
        self._warned = False

    def gather(self, env: int) -> None:
        """Copy poses, spatial velocities and contacts of one environment; threads may do so at once."""
        data = self._data[env]
        xpos, xquat, cvel, com = self._views[env]
        pose = self._pose[env]
        pose[:, :3] = xpos
        pose[:, 3:6] = xquat[:, 1:]
        pose[:, 6] = xquat[:, 0]
        self._twist[env] = cvel
        self._com[env] = com
        self._time[env] = data.time
        self._contacts[env] = ()
        if data.ncon:
            c = data.contact
            frames = c.frame.reshape(-1, 3, 3)
            parts = (c.geom, c.dist, c.pos, frames[:, 0], c.efc_address, c.dim, data.efc_force, frames)
            self._contacts[env] = tuple(part.copy() for part in (*parts, c.friction))

    def _forces(self, contacts: Sequence[tuple[NDArray[Any], ...]]) -> tuple[NDArray[np.float64], ...]:
        """Return normal force [C], friction and torque [C, 3] of every contact, by its rows of constraint forces."""
        address, dim, frame, cone = (np.concatenate([parts[i] for parts in contacts]) for i in (4, 5, 7, 8))
        before = np.cumsum([0, *(len(parts[6]) for parts in contacts)])
        rows = np.concatenate([*(parts[6] for parts in contacts), np.zeros(1)])
        first = np.maximum(address, 0) + np.repeat(before[:-1], [len(parts[4]) for parts in contacts])

        def _row(offset: int, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
            return rows[np.where(valid & (address >= 0), first + offset, len(rows) - 1)]

        if self._model.opt.cone:
            # An elliptic cone has a row for the normal force, one for each tangent, and one for each torque.
            normal, slip = _row(0, dim > 0), np.stack([_row(axis, axis < dim) for axis in range(1, 6)], axis=1)
        else:
            # A pyramid has two edges for each tangent (and for each torque): their sum is the normal force, their
            # difference by the coefficient the friction.
            edges = np.stack([_row(edge, edge < np.maximum(2 * (dim - 1), 1)) for edge in range(10)], axis=1)
            normal = edges.sum(axis=1)
            slip = np.where(np.arange(1, 6) < dim[:, None], cone * (edges[:, ::2] - edges[:, 1::2]), 0.0)
        # Along both tangents; about the normal and about both tangents.
        return normal, np.einsum("ca,caj->cj", slip[:, :2], frame[:, 1:]), np.einsum("ca,caj->cj", slip[:, 2:], frame)

    def finish(self) -> None:
        """Turn what was gathered into velocities of link origins and the contacts of all environments."""
        omega = self._twist[..., :3]
        # v + ω × (p − com): MuJoCo's spatial velocities refer to the centre of mass of the kinematic tree.
        lever = self._pose[..., :3] - self._com[:, self._root]
        self._velocity[..., :3] = self._twist[..., 3:] + np.cross(omega, lever)
        self._velocity[..., 3:] = omega
        state = self._state
        owners = [env for env, parts in enumerate(self._contacts) if parts]
        contacts = [self._contacts[env] for env in owners]
        total = sum(len(parts[1]) for parts in contacts)
        room = state.contact_env.shape[0]
        if contacts:
            env = np.repeat(owners, [len(parts[1]) for parts in contacts])
            columns = [np.concatenate([parts[index] for parts in contacts])[:room] for index in range(4)]
            columns += [force[:room] for force in self._forces(contacts)]
            keep = len(columns[0])
            state.contact_env.numpy()[:keep] = env[:keep]
            names = ("geom", "distance", "position", "normal", "force", "friction", "couple")
            for name, column in zip(names, columns, strict=True):
                getattr(state, f"contact_{name}").numpy()[:keep] = column
        state.contact_count.fill_(total)
        if total > room and not self._warned:
            self._warned = True
            enough = max(*(len(parts[1]) for parts in contacts), -(-total // len(self._data)))
            text = f"The engine found {total} contacts and has room for {room}; the last ones are lost. "
            warnings.warn(f"{text}Make it with contacts={enough}.", RuntimeWarning, stacklevel=2)


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
        wp = warp()
        with needing("mujoco-warp", extra="gpu", purpose="Simulation on a GPU"):
            import mujoco_warp
        self._engine: Any = mujoco_warp
        check_number("environments of an engine", num_envs, least=1, most=MOST_ENVS, whole=True)
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
            # Room for constraint rows: two per tangent and torque of a contact (in a pyramid), limits, equalities,
            # tendons, friction of joints.
            dim = max(int(sizes.max(initial=3)) for sizes in (self.model.geom_condim, self.model.pair_dim))
            m = self.model
            rows = 2 * (dim - 1) * contacts + 2 * m.njnt + 6 * m.neq + 2 * m.ntendon + m.nv
            room = {"nconmax": contacts, "njmax": rows}
            self.data: Any = self._engine.make_data(self.model, nworld=num_envs, **room)
            """The ``mujoco_warp.Data`` behind the state."""
            if set(varied) & set(_MASSES):
                self._engine.set_const(self._m, self.data)
            self._root = wp.array(np.asarray(self.model.body_rootid, dtype=np.int32), dtype=wp.int32)
        contact = self.data.contact
        self.state: HandState = HandState.empty(num_envs, self.model.nbody, contact.worldid.shape[0], self._device)
        # The engine's own arrays serve where they have the form of the state's.
        arrays = self.state.arrays
        arrays.contact_geom, arrays.contact_env, arrays.contact_distance = contact.geom, contact.worldid, contact.dist
        arrays.contact_position, arrays.contact_count, arrays.time = contact.pos, self.data.nacon, self.data.time
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
        d = self.data
        # MuJoCo's quaternions are (w, x, y, z); the kernel stores them as Warp's (x, y, z, w).
        inputs = [d.xpos, d.xquat, d.cvel, d.subtree_com, self._root, self.state.arrays]
        warp().launch(fill_links, dim=(self.num_envs, self.model.nbody), inputs=inputs, device=self._device)

    def _fill(self) -> None:
        self._fill_links()
        c, pyramidal = self.data.contact, int(self.model.opt.cone == 0)
        inputs = [c.frame, c.dim, c.efc_address, self.data.efc.force, c.friction, pyramidal, self.state.arrays]
        warp().launch(fill_contacts, dim=c.worldid.shape[0], inputs=inputs, device=self._device)


def _put_model(engine: Any, model: Any, varied: Mapping[str, np.ndarray], num_envs: int) -> Any:
    """Return the model on the device, with fields [B, …] that differ between environments."""
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
