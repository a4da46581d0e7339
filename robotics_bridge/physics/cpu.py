"""C MuJoCo on the processor: one simulation per environment, stepped by a pool of threads."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.reading.ranges import check_number
from robotics_bridge.physics.scene import TouchScene, check_model_fields, model_fields
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

        def work(env: int) -> None:
            model, data = self.models[env], self.data[env]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)

        self._each(work)

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
        gather = self._gatherer.gather

        def run(chunk: NDArray[np.int64]) -> None:
            for env in chunk.tolist():
                work(env)
                gather(env)

        if self._pool is None:
            run(self._chunks[0])
        else:
            list(self._pool.map(run, self._chunks))
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
            tangents = c.frame[:, 3:].reshape(-1, 2, 3)
            parts = (c.geom, c.dist, c.pos, c.frame[:, :3], c.efc_address, c.dim, data.efc_force, tangents)
            self._contacts[env] = tuple(part.copy() for part in (*parts, c.friction[:, :2]))

    def _forces(self, contacts: Sequence[tuple[NDArray[Any], ...]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return normal force [C] and friction [C, 3] of every contact, by its rows among the constraint forces."""
        address, dim, tangent, cone = (np.concatenate([parts[i] for parts in contacts]) for i in (4, 5, 7, 8))
        before = np.cumsum([0, *(len(parts[6]) for parts in contacts)])
        rows = np.concatenate([*(parts[6] for parts in contacts), np.zeros(1)])
        first = np.maximum(address, 0) + np.repeat(before[:-1], [len(parts[4]) for parts in contacts])

        def row(offset: int, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
            return rows[np.where(valid & (address >= 0), first + offset, len(rows) - 1)]

        if self._model.opt.cone:
            # An elliptic cone has a row for the normal force and one for each tangent.
            normal, slip = row(0, dim > 0), np.stack([row(1, dim > 1), row(2, dim > 1)], axis=1)
        else:
            # A pyramid has two edges for each tangent (and for each torque): their sum is the normal force, their
            # difference by the coefficient the friction.
            edges = np.stack([row(edge, edge < np.maximum(2 * (dim - 1), 1)) for edge in range(10)], axis=1)
            normal = edges.sum(axis=1)
            slip = np.where(dim[:, None] > 1, cone * (edges[:, [0, 2]] - edges[:, [1, 3]]), 0.0)
        return normal, (slip[:, :, None] * tangent).sum(axis=1)

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
            names = ("geom", "distance", "position", "normal", "force", "friction")
            for name, column in zip(names, columns, strict=True):
                getattr(state, f"contact_{name}").numpy()[:keep] = column
        state.contact_count.fill_(total)
        if total > room and not self._warned:
            self._warned = True
            enough = max(*(len(parts[1]) for parts in contacts), -(-total // len(self._data)))
            text = f"The engine found {total} contacts and has room for {room}; the last ones are lost. "
            warnings.warn(f"{text}Make it with contacts={enough}.", RuntimeWarning, stacklevel=2)
