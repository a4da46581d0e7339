"""The physics of a batch of environments as torch tensors, on either engine, and what a control step feels.

With MuJoCo Warp the tensors are views of the engine's own memory; with C MuJoCo they are copies that
:class:`Simulation` keeps in step, so that what stands above knows no engine.

Contacts of finger tips and objects, and the readings of a hand's taxels, are read once per control step. Letters:
B environment, J joint, F finger tip, K object, S physics step of a control step, N column (active taxel, or link for
``agg_*``), C channel.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import torch

from brainbench.core.devices import Recorder, mujoco_module, no_collection, pick_device, warp
from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.rotations import conjugate, from_xyzw, rotate
from robotics_bridge.envs.kernels.actuation import ActuatorArrays, actuate, add_contact_forces
from robotics_bridge.hands import Hand
from robotics_bridge.hands.layouts import check_names
from robotics_bridge.hands.observations import ObservationMap, observation_type, sensors_for
from robotics_bridge.physics import MujocoEngine, MujocoWarpEngine
from robotics_bridge.physics.state import MOST_ENVS, HandState
from robotics_bridge.sensors import Probes, SensorSuite, SurfaceDistanceProbe
from robotics_bridge.tasks.scenes import TaskModel
from robotics_bridge.tasks.task import Task

ENGINES = ("mujoco", "warp")


@limited(kw_only=True)
class EnvOptions:
    """Options of the simulation of a task, and of what is observed; a value that is not valid is a UsageError."""

    num_envs: Annotated[int, Limit(least=1, most=MOST_ENVS)] = 1
    """Environments B at once."""
    device: str = "cpu"
    """``cpu``, or ``cuda`` (``cuda:1``) for MuJoCo Warp."""
    engine: Literal["mujoco", "warp"] | None = None
    """``mujoco`` (C MuJoCo) or ``warp`` (MuJoCo Warp); by default the one for the device."""
    observe: str = "none"
    """Tactile observation type (table 4.3); ``none`` builds no tactile sensor."""
    placement: str = "hand"
    """Place of the taxels: ``hand``, ``fingers``, ``tips`` or ``palm``."""
    resolution: str = "med"
    """Number of taxels: ``low``, ``med`` or ``high``; or a probe file (``.json``)."""
    noisy: bool = False
    """Tactile readings with the published imperfections."""
    seed: Annotated[int, Limit(least=0, most=2**63 - 1)] = 0
    """Seed of all random numbers."""
    link_pose: bool = False
    """Also observe the poses of the tactile links in the palm's frame."""
    keep_final: bool = False
    """Return the last observations of episodes that ended as ``info["final_observations"]``."""
    threads: Count | None = None
    """Threads of C MuJoCo; None takes all processors."""
    knobs: Mapping[str, Any] = field(default_factory=dict)
    """Further settings of the tactile sensors, e.g. ``{"points": 500}``."""
    graphs: bool | None = None
    """Replay what a control step does around physics as CUDA graphs, recorded in the third step; by default on CUDA.

    A task whose terms cannot be recorded runs without, and says so; with ``True`` it is an error.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "engine", self.engine or ("mujoco" if self.device == "cpu" else "warp"))
        observation_type(self.observe)
        check_names("low" if self.resolution == "custom" else self.resolution, self.placement)
        if self.observe == "none" and (self.noisy or self.knobs):
            raise UsageError("noisy and knobs are settings of tactile sensors; choose an observation type.")
        if self.link_pose and self.observe == "none":
            raise UsageError("Poses of tactile links belong to tactile sensors; choose an observation type.")
        pick_device(self.device)
        if self.graphs and not self.device.startswith("cuda"):
            raise UsageError(f"Graphs are recorded on CUDA only, not on {self.device}; leave it out.")


mujoco = mujoco_module()

FIELDS = ("body_mass", "body_inertia", "body_subtreemass", "body_invweight0", "geom_friction")
"""Numbers of the model that differ between environments and change at resets."""


class Simulation:
    """Batched physics by the engine ``mujoco`` or ``warp``, with a ``mujoco.MjModel`` per shape of the object."""

    def __init__(self, models: Sequence[Any], options: EnvOptions, *, substeps: int = 1) -> None:
        device, num_envs = options.device, options.num_envs
        if options.engine == "mujoco" and device != "cpu":
            raise UsageError("C MuJoCo runs on the processor: use device='cpu', or engine='warp'.")
        self.model = models[0]
        self.num_envs, self._substeps = num_envs, substeps
        free = int(mujoco.mjtJoint.mjJNT_FREE)
        starts = zip(self.model.jnt_bodyid, self.model.jnt_type, self.model.jnt_dofadr, strict=True)
        # A body whose centre of mass is not its origin is not simple: its inertia depends on how it lies.
        self._free = {int(b): int(d) for b, kind, d in starts if kind == free and self.model.body_simple[b]}
        # Shapes in turn: every environment keeps its shape, whatever the size of the batch.
        order = np.arange(num_envs) % len(models)
        self.shape_of = order
        """Number [B] of the shape that each environment has."""
        nominal = {name: np.stack([getattr(m, name) for m in models])[order] for name in FIELDS}
        self.uses_warp = options.engine == "warp"
        """True for MuJoCo Warp, False for C MuJoCo."""
        if self.uses_warp:
            self.engine: Any = MujocoWarpEngine(list(models), num_envs, device=device, fields=nominal)
            self.qpos, self.qvel, self.ctrl = self.engine.qpos, self.engine.qvel, self.engine.ctrl
            self.push = warp().to_torch(self.engine.data.xfrc_applied)
            self._warmstart = warp().to_torch(self.engine.data.qacc_warmstart)
            self.fields = {name: self.engine.field(name) for name in FIELDS}
        else:
            self.engine = MujocoEngine(list(models), num_envs, fields=nominal, threads=options.threads)
            self.qpos = torch.from_numpy(self.engine.qpos.astype(np.float32))
            self.qvel = torch.from_numpy(self.engine.qvel.astype(np.float32))
            self.ctrl = torch.zeros(num_envs, self.model.nu)
            self.push = torch.zeros(num_envs, self.model.nbody, 6)
            self.fields = {name: torch.from_numpy(np.array(nominal[name], np.float32)) for name in FIELDS}
        self.device = self.qpos.device
        self.state = self.engine.state
        self.pose: torch.Tensor = self.state.pose_torch
        """[B, L, 7] world poses of links (m; x y z, qx qy qz qw) as of the last step or refresh; a view."""
        self._time = warp().to_torch(self.state.time)
        self.warp_device = pick_device(device)
        self.start = self.qpos.clone()
        self._pushed = False

    @property
    def timestep(self) -> float:
        """Duration of a step (s)."""
        return self._substeps * self.engine.timestep

    def step(self) -> None:
        """Advance all environments by one step, of ``substeps`` physics steps, with ``ctrl`` and ``push``."""
        if self.uses_warp:
            self.engine.step(self._substeps)
            return
        self.engine.set(ctrl=self.ctrl.numpy())
        self.engine.step(self._substeps)
        self.qpos.copy_(torch.from_numpy(self.engine.qpos))
        self.qvel.copy_(torch.from_numpy(self.engine.qvel))

    def apply_push(self) -> None:
        """Hand ``push`` (force and torque on bodies [B, nbody, 6], N and N·m, world axes) to the engine."""
        if self.uses_warp:
            return
        pushing = bool(self.push.any())
        if pushing or self._pushed:
            self.engine.set(xfrc_applied=self.push.numpy())
        self._pushed = pushing

    def refresh(self) -> None:
        """Bring poses and velocities of the state up to ``qpos`` and ``qvel``."""
        self.engine.kinematics()

    def reset(self, mask: torch.Tensor, qpos: torch.Tensor) -> None:
        """Put some environments [B] bool to positions [B, nq], at rest, and make changed ``fields`` valid there."""
        column = mask.unsqueeze(1)
        self.qpos.copy_(torch.where(column, qpos, self.qpos))
        self.qvel.masked_fill_(column, 0.0)
        self.ctrl.masked_fill_(column, 0.0)
        self.push.masked_fill_(column.unsqueeze(2), 0.0)
        self._time.masked_fill_(mask, 0.0)
        if self.uses_warp:
            self._warmstart.masked_fill_(column, 0.0)
            return
        for env in torch.nonzero(mask).flatten().tolist():
            data = self.engine.data[env]
            mujoco.mj_resetData(self.engine.models[env], data)
            data.qpos[:] = self.qpos[env].numpy()
            self._write_fields(env)

    def memory(self) -> dict[str, torch.Tensor]:
        """Return what the next step depends on, by name: the tensors themselves, but for C MuJoCo's own state."""
        tensors = {"ctrl": self.ctrl, "push": self.push, "qpos": self.qpos, "qvel": self.qvel}
        tensors |= {f"field.{name}": value for name, value in self.fields.items()}
        if self.uses_warp:
            return {**tensors, "warmstart": self._warmstart, "time": self._time}
        return {**tensors, "integration": torch.from_numpy(self.engine.integration_state())}

    def restored(self, values: Mapping[str, torch.Tensor]) -> None:
        """Take note that values were written to :meth:`memory`; C MuJoCo takes its own state from there."""
        if not self.uses_warp:
            for env in range(self.num_envs):
                self._write_fields(env)
            self.engine.set_integration_state(values["integration"].numpy())
        self.refresh()

    def _write_fields(self, env: int) -> None:
        values = {name: value[env].numpy() for name, value in self.fields.items()}
        # C MuJoCo takes the inertia of free bodies from here, not from their masses.
        inertia = np.array(self.engine.models[env].dof_M0)
        for body, first in self._free.items():
            inertia[first : first + 3] = values["body_mass"][body]
            inertia[first + 3 : first + 6] = values["body_inertia"][body]
        self.engine.set_fields(env, {**values, "dof_M0": inertia})


_IMPERFECTIONS = ("strength", "bias", "deadband", "backlash", "kick")


class Actuators:
    """Imperfect position actuators of all joints: the published randomisation as one kernel per physics step.

    Torque = strength · (stiffness · e − damping · q̇ + kick · sign e) + noise, held within the joint's effort. The error
    e is between target and measured position, which carries a bias and the play of the gears (a stop operator on the
    joint's motion); below the deadband it counts as none.
    """

    def __init__(self, simulation: Simulation, model: TaskModel, task: Task, *, seed: int) -> None:
        self._simulation, self._changes, self._substeps = simulation, task.actuators, task.solver.decimation
        device, first = simulation.device, simulation.model
        ids = [first.joint(name).id for name in model.joints]
        self.qpos_columns = torch.as_tensor(np.array(first.jnt_qposadr[ids]), device=device).long()
        """[J] columns of ``qpos``."""
        self.qvel_columns = torch.as_tensor(np.array(first.jnt_dofadr[ids]), device=device).long()
        """[J] columns of ``qvel``."""
        self.nominal = {
            name: torch.as_tensor(getattr(model, name), dtype=torch.float32, device=device)
            for name in ("stiffness", "damping", "effort")
        }
        self.lever = torch.as_tensor(model.lever, dtype=torch.float32, device=device)
        """[J] factor on imperfections and noise that are stated for hinges."""

        zeros = partial(torch.zeros, simulation.num_envs, len(ids), device=device)
        names = ("stiffness", "damping", *_IMPERFECTIONS, "play", "before")
        self.values = {name: zeros() for name in names}
        """[B, J] gains and imperfections, and what the gears remember (as in ``ActuatorArrays``)."""
        self.target = zeros()
        """[B, J] positions that the actuators seek (rad)."""
        self.power = zeros()
        """[B, J] mean |torque · speed| over the last control step (W)."""
        self._noise_state = torch.zeros(2, dtype=torch.int32, device=device)
        """[2] launches so far, and where the torque noise of the seed begins."""
        self.seed(seed)
        self._noise = self.nominal["effort"] * (task.actuators.torque_noise if task.actuators else 0.0)
        wp = warp()
        self._arrays = ActuatorArrays()
        for name, value in self.values.items():
            setattr(self._arrays, name, wp.from_torch(value, dtype=wp.float32))
        self._arrays.effort, self._arrays.noise = wp.from_torch(self.nominal["effort"]), wp.from_torch(self._noise)
        channels = [first.actuator(name).id for name in model.joints]
        columns = {"position": first.jnt_qposadr[ids], "speed": first.jnt_dofadr[ids], "channel": channels}
        for name, numbers in columns.items():
            column = wp.array(np.array(numbers, dtype=np.int32), dtype=wp.int32, device=simulation.warp_device)
            setattr(self._arrays, name, column)
        shared = (simulation.qpos, simulation.qvel, self.target, self._noise_state, simulation.ctrl, self.power)
        self._qpos, self._qvel, self._target, self._random, self._ctrl, self._power = map(wp.from_torch, shared)

    def reset(self, mask: torch.Tensor, draw: Any) -> None:
        """Draw imperfections anew in some environments [B] bool; ``draw(n, low, high)`` returns numbers [B, n]."""
        column, joints = mask.unsqueeze(1), self.target.shape[1]
        position, c = self._simulation.qpos[:, self.qpos_columns], self._changes
        values = {name: self.nominal[name] for name in ("stiffness", "damping")}
        values |= {"play": torch.zeros_like(self.target), "before": position, "strength": torch.ones_like(self.target)}
        if c is not None:
            # Stated for hinges; a slide moves as the tip of a finger would.
            lever = self.lever
            values |= {
                "stiffness": self.nominal["stiffness"] * draw(joints, *c.stiffness),
                "damping": self.nominal["damping"] * draw(joints, *c.damping),
                "strength": draw(joints, *c.strength), "bias": lever * draw(joints, *c.position_bias),
                "deadband": lever * draw(joints, *c.deadband), "backlash": lever * draw(joints, *c.backlash),
                "kick": c.kick * draw(joints, *c.kick_ratio) / lever,
            }  # fmt: skip
        for name, value in values.items():
            present = self.values[name]
            present.copy_(torch.where(column, value, present))
        self.target.copy_(torch.where(column, position, self.target))

    def seed(self, seed: int) -> None:
        """Begin the torque noise anew."""
        self._noise_state[0].fill_(0)
        # The kernel adds the launch to it. An odd multiplier, 2³² over the golden ratio, keeps streams of neighbouring
        # seeds apart, which would be the same ones a launch later.
        self._noise_state[1].fill_(seed * 0x9E3779B1 & 0x3FFFFFFF)

    def launch(self, substep: int) -> None:
        """Write the torques of one physics step to the simulation's ``ctrl``."""
        wp, device = warp(), self._simulation.warp_device
        inputs = [self._arrays, self._qpos, self._qvel, self._target, self._random]
        inputs += [int(substep == 0), 1.0 / self._substeps, self._ctrl, self._power]
        wp.launch(actuate, dim=self.target.shape, inputs=inputs, device=device)
        self._noise_state[0] += 1

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves that the next launch depends on, by name."""
        tensors = {"target": self.target, "power": self.power}
        return {**self.values, **tensors, "tick": self._noise_state[:1], "seed": self._noise_state[1]}


_REACH = 0.5  # largest distance that is told (m)
_LIMIT = 10.0  # bounds of the components of a force on a finger tip, as published (N)


class Contacts:
    """Privileged senses of a task, read once per control step."""

    def __init__(self, simulation: Simulation, model: TaskModel, *, step_dt: float, seed: int) -> None:
        wp, scene, device = warp(), simulation.engine.scene, simulation.warp_device
        self._simulation, self._dt = simulation, step_dt
        tips = list(model.tips)
        self._tips = len(tips)
        self.tip_links = torch.as_tensor([scene.link_index(tip) for tip in tips], device=simulation.device)
        """[F] numbers of the links of finger tips."""
        up, radius, probes = np.array([[0.0, 0.0, 1.0]]), np.array([0.5]), {}
        for tip, point in model.tips.items():
            place = Probes(np.array([point]), up, radius, (1,))
            probes[tip] = SurfaceDistanceProbe(link=tip, probes=place, track=model.objects, max_range=_REACH)
        self._suite = SensorSuite(scene, probes, num_envs=simulation.num_envs, device=device, seed=seed)
        (runtime,) = self._suite.runtimes
        self.planes: torch.Tensor = wp.to_torch(runtime.measured())
        """[1, B, F] distances (m)."""
        rows = np.full(len(scene.geometries), -1, dtype=np.int32)
        for row, link in enumerate((*tips, *model.objects)):
            rows[list(scene.geometries_of(link))] = row
        self._rows = wp.array(rows, dtype=wp.int32, device=device)
        shape = (simulation.num_envs, len(tips) + len(model.objects))
        self._forces: Any = wp.zeros(shape, dtype=wp.vec3f, device=device)
        self.forces: torch.Tensor = wp.to_torch(self._forces)
        """[B, F + K, 3] net normal contact forces on finger tips, then on objects, world axes (N); a view."""

    def read(self) -> None:
        """Take forces and distances from the simulation's state."""
        wp, state = warp(), self._simulation.state
        # One thread per contact adds its force, so the sums start from zero in every control step.
        self._forces.zero_()
        inputs = [state.contact_count, state.contact_geom, state.contact_env, state.contact_normal]
        inputs += [state.contact_force, self._rows, self._forces]
        wp.launch(
            add_contact_forces, dim=state.contact_env.shape[0], inputs=inputs, device=self._simulation.warp_device
        )
        self._suite.update(state, self._dt)

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes in some environments [B] bool."""
        self._suite.reset(mask)

    def refresh(self, mask: torch.Tensor) -> None:
        """Take distances of new episodes, which have no contacts yet, from the refreshed state."""
        self.forces.masked_fill_(mask[:, None, None], 0.0)
        self._suite.update(self._simulation.state, self._dt)

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves of what was read last, by name."""
        return {"forces": self.forces, "distances": self.planes}

    def on_object(self, rows: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the size [B] of the force on the objects ``target`` [B] (N); ``rows`` numbers the environments."""
        return self.forces[rows, self._tips + target].norm(dim=1)

    @property
    def tip_force(self) -> torch.Tensor:
        """Net normal contact force [B, F, 3] on finger tips in their own frame, within ±10 N as published."""
        # World to link: the inverse of a unit quaternion is its conjugate. A lost force reads as 0, since a network
        # cannot take NaN.
        turn = conjugate(from_xyzw(self._simulation.pose[:, self.tip_links, 3:]))
        return rotate(turn, self.forces[:, : self._tips]).clamp(-_LIMIT, _LIMIT).nan_to_num()

    @property
    def surface_distance(self) -> torch.Tensor:
        """Distance [B, F] from each finger tip to the nearest object (m), at most 0.5."""
        return self.planes[0].nan_to_num(_REACH)


class TactileObservation:
    """The tactile sensors of an environment, read after every physics step; the observation type is not ``none``."""

    def __init__(self, model: TaskModel, hand: Hand, simulation: Simulation, options: EnvOptions, task: Task) -> None:
        observe, num_envs, device = options.observe, options.num_envs, simulation.warp_device
        kind = observation_type(observe)
        taxels = hand.layout(options.resolution, options.placement)
        taxels = {link: probes for link, probes in taxels.items() if probes.active.any()}
        # The task's torsional friction of force taxels, where the options name none.
        knobs = {"twist": task.taxel_twist, **options.knobs}
        sensors = sensors_for(observe, taxels, noisy=options.noisy, track=model.objects, **knobs)
        self.suite = SensorSuite(simulation.engine.scene, sensors, num_envs=num_envs, device=device, seed=options.seed)
        self.links = tuple(taxels)
        """Links with taxels, in the order of their columns."""
        active = {link: np.flatnonzero(probes.active) for link, probes in taxels.items()}
        counts = [len(active[link]) for link in taxels]
        where = simulation.device
        self._parts: list[tuple[Any, torch.Tensor, torch.Tensor]] = []
        starts = dict(zip(taxels, np.cumsum([0, *counts[:-1]]).tolist(), strict=True))
        for runtime in self.suite.runtimes:
            source = np.concatenate([place.start + active[name] for name, place in runtime.slices.items()])
            target = np.concatenate([starts[name] + np.arange(len(active[name])) for name in runtime.slices])
            planes = warp().to_torch(runtime.measured())
            self._parts.append((planes, torch.as_tensor(source, device=where), torch.as_tensor(target, device=where)))
        width: int = 3 if observe == "force" else int(self._parts[0][0].shape[0])
        self._taxels = torch.zeros(num_envs, sum(counts), width, device=where)
        self._map = ObservationMap(observe, taxels, where)
        self.reading = torch.zeros(num_envs, task.solver.decimation, self._map.items, kind.channels, device=where)
        """[B, S, N, C] of the last control step, oldest first; zeros after a reset."""

    def update(self, state: HandState, dt: float, substep: int) -> None:
        """Read the sensors after a physics step of duration dt (s)."""
        self.suite.update(state, dt)
        for planes, source, target in self._parts:
            part = planes[: self._taxels.shape[2]].index_select(2, source).permute(1, 2, 0)
            if len(self._parts) == 1:
                self._taxels = part
            else:
                self._taxels.index_copy_(1, target, part)
        self.reading[:, substep] = self._map(self._taxels)

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes in some environments [B] bool."""
        self.suite.reset(mask)
        self.reading.masked_fill_(mask[:, None, None, None], 0.0)


def warp_recorder(device: Any, generators: Sequence[torch.Generator]) -> Recorder:
    """Return a recorder of work of torch and Warp together, without gradients.

    Args:
        device: Warp's CUDA device.
        generators: Random numbers that the work draws, beside torch's own on the device.
    """

    def _record(work: Callable[[], Any]) -> tuple[Any, Any]:
        wp = warp()
        where = wp.device_to_torch(device)
        # What Python throws away meanwhile could free device memory, which ends a recording.
        gc.collect()
        external = torch.cuda.ExternalStream(device.stream.cuda_stream, device=where)
        graph, side = torch.cuda.CUDAGraph(), torch.cuda.Stream(where)
        for generator in generators:
            graph.register_generator_state(generator)
        stream = wp.stream_from_torch(side)
        with contextlib.ExitStack() as scope:
            scope.enter_context(no_collection())
            scope.enter_context(torch.cuda.device(where))
            # A recording that breaks off leaves torch on its stream.
            scope.enter_context(torch.cuda.stream(torch.cuda.current_stream(where)))
            # Results outlive the caller's inference mode, tensors of which no gradient could ever pass.
            scope.enter_context(torch.inference_mode(False))
            scope.enter_context(torch.no_grad())
            scope.enter_context(torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"))
            # Waiting for Warp's own stream would tie the recording to work outside of it.
            scope.enter_context(wp.ScopedStream(stream, sync_enter=False))
            result = work()
        return _BetweenStreams(graph, external), result

    return _record


class _BetweenStreams:
    """A recorded graph that is replayed on torch's stream, between what Warp does on its own."""

    def __init__(self, graph: torch.cuda.CUDAGraph, warp_stream: torch.cuda.Stream) -> None:
        self._graph, self._warp = graph, warp_stream

    def replay(self) -> None:
        """Launch the graph on torch's current stream, in order with what Warp is given before and after."""
        current = torch.cuda.current_stream(self._warp.device)
        current.wait_stream(self._warp)
        self._graph.replay()
        self._warp.wait_stream(current)
