"""Distil a teacher into a student that feels: DAgger with decoders, teacher mixing and aggregation, exactly resumable.

The run's folder holds ``config.json`` (the student and how to build it again), ``model.safetensors``,
``state.safetensors`` (where it stands, environments included), ``log.jsonl`` and ``tensorboard/``. A run that was
killed goes on from its last state when it is started again and ends with the weights of an unbroken one.

One iteration (Ross et al. 2011): the student acts, in a share of steps the teacher; the teacher names its action for
every observation; the student learns those actions by truncated backpropagation through time, from this rollout and
from aggregated ones, together with decoders of what the teacher knows (thesis, table 4.5).
"""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from torch import nn

from brainbench.core.devices import WARM_UP, CudaGraphStep, record_torch
from brainbench.core.errors import BrainbenchError, DataError, needing
from brainbench.core.files import file_hash, provenance, read_mapping, write_tensors
from brainbench.core.progress import Progress
from brainbench.core.reading.regular import readable
from brainbench.core.reading.tensors import read_tensors
from brainbench.core.runs.folder import (
    RESTART,
    STATE,
    RunEnd,
    Stop,
    claim,
    learner_state,
    load_state,
    occupied,
    random_state,
    restore_learner,
    save_state,
    set_random_state,
)
from brainbench.core.runs.log import RunLog
from brainbench.models.ops.layers import load_named
from robotics_bridge.envs.step import JOINTS
from robotics_bridge.hands.layouts import check_probes, is_probe_file
from robotics_bridge.policies.contract import Groups, check_hand, check_version, from_json, shapes_of, world_of
from robotics_bridge.policies.encoders.arms import EncoderConfig, elu_perceptron
from robotics_bridge.policies.evaluate import Policy
from robotics_bridge.policies.shipped import model_file, policy_path, student_folder
from robotics_bridge.policies.student import TACTILE, TactilePolicy
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.task import TASK_VERSION, check_measured

CONFIG, MODEL = "config.json", "model.safetensors"


class _Described(msgspec.Struct):
    distill: dict[str, Any]
    groups: Groups
    actions: Annotated[int, msgspec.Meta(ge=1, le=JOINTS)]
    deployment: dict[str, Any]


def build_student(
    config: DistillConfig, shapes: Mapping[str, tuple[int, ...]], groups: list[str], actions: int
) -> TactilePolicy:
    """Return a student of ``groups`` with new weights (the global random state)."""
    example: Any = {name: torch.zeros(1, *shapes[name]) for name in groups}
    tactile = config.tactile
    return TactilePolicy(
        example, {"student": groups}, "student", actions, hidden_dims=config.hidden, embedder=config.embedder,
        tactile=asdict(tactile) if tactile is not None else None,
    )  # fmt: skip


def begin_with(student: TactilePolicy, start: str | Path) -> None:
    """Give a student the weights of another, by folder or shipped name; learning begins anew."""
    path = policy_path("student", start) / MODEL
    with readable(path, "student", "It is damaged, or of another student."):
        weights = read_tensors(path, "file of weights (safetensors)")
    what = f"the student here, which starts from {str(start)!r} and not from one that feels and acts alike"
    load_named(student.state_dict(), weights, what=what)


def origins_of(config: DistillConfig) -> dict[str, str]:
    """Return the hashes of the teacher and of the weights that a student begins with; of what is not there, none.

    By name alone, a teacher that was trained anew in its folder would be the one before.
    """
    files: dict[str, Callable[[], Path]] = {}
    if config.teacher:
        files["teacher_hash"] = lambda: model_file(config.teacher)
    if config.start is not None:
        files["start_hash"] = lambda: policy_path("student", str(config.start)) / MODEL
    hashes = {}
    for name, file in files.items():
        with contextlib.suppress(BrainbenchError, OSError):
            hashes[name] = file_hash(file())
    return hashes


def load_student(folder: str | Path, *, device: str = "cpu") -> tuple[TactilePolicy, dict[str, Any]]:
    """Return a distilled student in evaluation mode, and its run's configuration.

    The folder is that of a run, or a name of :func:`~robotics_bridge.policies.shipped.list_policies`.
    """
    folder = student_folder(policy_path("student", folder))
    described = read_mapping(folder / CONFIG, "configuration of a student")
    if described.get("brainbench_student") != 1:
        raise DataError(f"{str(folder)!r} holds no student; brainbench policy distill makes one.")
    if not (folder / MODEL).is_file():
        raise DataError(f"The student in {str(folder)!r} has no weights yet; its run was interrupted early.")
    check_version(described, str(folder))
    stated = from_json(_Described, described, CONFIG)
    config = from_json(DistillConfig, stated.distill, CONFIG)
    settings = {name: value for name, value in config.encoder_settings.items() if value is not None}
    # Which settings it may have depends on the encoder's name.
    from_json(EncoderConfig, {**settings, "name": config.encoder}, f"encoder_settings of {CONFIG}")
    shapes, actions = shapes_of(stated.groups, CONFIG, "groups"), stated.actions
    with readable(folder / MODEL, "student", "It is damaged, or of another student."):
        _require_sizes(folder / MODEL, config, shapes)
        with torch.random.fork_rng(devices=[]):
            student = build_student(config, shapes, list(shapes), actions)
        student.load_state_dict(read_tensors(folder / MODEL, "file of weights (safetensors)"))
    check_probes(config.resolution, stated.deployment.get("probes"))
    return student.to(device).eval(), described


def _require_sizes(path: Path, config: DistillConfig, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Compare the sizes that a configuration states with the file's, before networks of that size take memory."""
    with safe_open(path, "pt") as file:
        sizes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118
    flat = sum(shape[0] for name, shape in shapes.items() if name != TACTILE)
    widths = [sizes.get(f"mlp.{2 * index}.bias") for index in range(len(config.hidden))]
    mean = sizes.get("obs_normalizer._mean", [1, flat])
    if mean != [1, flat] or widths != [[width] for width in config.hidden]:
        raise DataError(f"The weights in {str(path.parent)!r} are of another student than {CONFIG} describes.")


Tensors = dict[str, torch.Tensor]
Rollout = Tensors
"""T control steps of B environments by name [T, B, …]: observation groups that the student or its decoders read;
touch as features [F] of a frozen encoder in place of its readings; actions [A] of ``teacher`` and ``student``;
``ended``: an episode did after the step. ``memory`` is the student's [B, H] before the first step."""


class ChunkStep:
    """Forward, backward, clipping and a step of the optimiser, on data of always the same shapes.

    ``loss`` maps the data to the parts of the loss, by name, and the memory after it; ``clip`` is the largest norm of
    the gradients. With ``record``, on CUDA, the step is recorded and replayed; one that cannot be runs as it is, and
    says so.
    """

    def __init__(
        self,
        loss: Callable[[Mapping[str, torch.Tensor]], tuple[Tensors, torch.Tensor]],
        parameters: Sequence[nn.Parameter],
        optimizer: torch.optim.Optimizer,
        *,
        clip: float | None,
        record: bool,
    ) -> None:
        self._loss, self._parameters, self._optimizer, self._clip = loss, list(parameters), optimizer, clip
        self._record, self._inputs = record, dict[str, torch.Tensor]()
        # On a stream of its own: what backward keeps must not lead to the default one.
        self._step = CudaGraphStep(
            self._descend, self._recorder, subject="Learning", warm_up=WARM_UP, aside=True, retained=None
        )

    def __call__(self, given: Tensors) -> tuple[Tensors, torch.Tensor]:
        """Take a step; return the parts of the loss and the memory, which the next call may overwrite."""
        if not self._record or self._step.failed:
            return self._descend(given)
        if not self._inputs:
            self._inputs = {name: value.clone() for name, value in given.items()}
        if any(value.shape != self._inputs[name].shape for name, value in given.items()):
            return self._descend(given)
        for name, value in given.items():
            self._inputs[name].copy_(value)
        return self._step(self._inputs)

    def _descend(self, given: Mapping[str, torch.Tensor]) -> tuple[Tensors, torch.Tensor]:
        self._optimizer.zero_grad(set_to_none=True)
        parts, memory = self._loss(given)
        torch.stack(list(parts.values())).sum().backward()
        if self._clip is not None:
            nn.utils.clip_grad_norm_(self._parameters, self._clip)
        self._optimizer.step()
        return {name: value.detach() for name, value in parts.items()}, memory.detach()

    def _recorder(self, work: Callable[[], Any]) -> tuple[Any, Any]:
        # Gradients are then allocated in the memory of the graph.
        self._optimizer.zero_grad(set_to_none=True)
        return record_torch(work)


_log = logging.getLogger(__name__)

_LEAST_VARIANCE = 1e-4


@dataclass(frozen=True)
class DistillResult(RunEnd):
    """Outcome of a run."""

    iterations: int
    """Iterations done in all."""
    loss: float
    """Behaviour-cloning loss of the last iteration."""
    seconds: float
    """Time of this session."""


def distill(
    config: DistillConfig,
    out: str | Path,
    *,
    env: Any,
    teacher: Policy,
    stop_after: float | None = None,
    stop_at: int | None = None,
    progress: Progress | None = None,
) -> DistillResult:
    """Teach a student in a folder, or go on with the run that the folder holds.

    The environment (:func:`robotics_bridge.tasks.make`) has the configuration's observation type. The state is saved
    after ``stop_after`` seconds or ``stop_at`` iterations in all, where that is before the end. A loss that is not
    finite ends the run as ``diverged``; the last saved state stays.
    """
    stop = Stop(stop_after, stop_at, "iterations")
    # Without it a student can act, but not learn.
    with needing("rsl-rl-lib", extra="policies", purpose="Training policies"):
        import rsl_rl.models  # noqa: F401
    devices = [env.device] if torch.device(env.device).type == "cuda" else []
    with occupied(Path(out), stop), torch.random.fork_rng(devices=devices):
        torch.manual_seed(config.seed)
        run = _Run(config.resolved(env.task.student), Path(out), env, teacher)
        # Products as exact as PyTorch's convolutions are by default.
        before = torch.get_float32_matmul_precision()
        if devices:
            torch.set_float32_matmul_precision("high")
        try:
            return run.run(stop, progress or (lambda done, total, what: None))
        finally:
            torch.set_float32_matmul_precision(before)
            run.log.close()


class _Run:
    """The state of a distillation and its iterations."""

    def __init__(self, config: DistillConfig, out: Path, env: Any, teacher: Policy, *, graphs: bool = True) -> None:
        self.config, self.out, self.env, self.teacher = config, out, env, teacher
        self.device = torch.device(env.device)
        read = [name for name in env.task.groups["student"] if name != TACTILE]
        # The published students read the goal; nothing else of the simulation is an input, targets of decoders least.
        check_measured((name for name in read if name != "goal"), "A student")
        self.groups: list[str] = [*read, TACTILE] if config.tactile is not None else read
        self.student = build_student(config, env.observation_shapes, self.groups, env.num_actions).to(self.device)
        if config.start is not None and not (out / STATE).exists():
            begin_with(self.student, config.start)
        self.decoders = env.task.decoders
        sizes, features = env.observation_shapes, self.student.core.features
        self.heads = nn.ModuleDict(
            {
                part.target: elu_perceptron(features, part.hidden, math.prod(sizes[part.target]))
                for part in self.decoders
            }
        )
        self.learner = nn.ModuleDict({"student": self.student, "decoders": self.heads}).to(self.device)
        weights = [weight for weight in self.learner.parameters() if weight.requires_grad]
        cuda = self.device.type == "cuda"
        self.optimizer = torch.optim.Adam(weights, lr=config.learning_rate or 1e-4, fused=cuda, capturable=cuda)
        tactile = self.student.core.tactile
        self.front = tactile.frozen_part if tactile is not None else None
        self.precision = torch.bfloat16 if config.precision == "bf16" else None
        self.student.core.precision = self.precision
        self.step = ChunkStep(self._loss, weights, self.optimizer, clip=config.max_grad_norm, record=cuda and graphs)
        self.observations: dict[str, torch.Tensor] = env.reset()
        # First episodes end at different times, so that no rollout holds only beginnings.
        env.episode_length_buf.copy_(torch.randint_like(env.episode_length_buf, int(env.max_episode_length)))
        self.memory = self.student.zeros(env.num_envs, stored=self.front is not None)
        self.touched = self.front.init_state(env.num_envs) if self.front is not None else self.memory[:, :0]
        self.rollouts: dict[int, Rollout] = {}
        self.iteration, self.saved, self.loss = 0, 0, math.nan
        self._claim()
        if (out / STATE).exists():
            state = load_state(out / STATE)
            with readable(out / STATE, "training state", RESTART):
                self._go_on(state)
        self.log = RunLog(out, "step", self.iteration)

    def run(self, stop: Stop, progress: Progress) -> DistillResult:
        """Learn to the last iteration, or until it is to stop."""
        total = self.config.iterations or 0
        status: Literal["finished", "stopped", "diverged"] = "finished"
        reason = ""
        while self.iteration < total and not reason:
            begun = time.perf_counter()
            rollout = self._act(self.config.share(self.iteration))
            acted = time.perf_counter()
            losses = self._learn(rollout)
            if not all(math.isfinite(value) for value in losses.values()):
                status, reason = "diverged", f"The loss of iteration {self.iteration + 1} is not finite."
                break
            self.loss = losses["behaviour"]
            self.iteration += 1
            acting, learning = acted - begun, time.perf_counter() - acted
            steps = rollout["ended"].numel()
            self.log.write("loss", self.iteration, **losses)
            self.log.write("time", self.iteration, acting=acting, learning=learning, steps_per_second=steps / acting)
            self.log.write("teacher", self.iteration, share=self.config.share(self.iteration - 1))
            episodes = self.env.statistics()
            if episodes.get("episodes"):
                self.log.write("episode", self.iteration, **{key: float(value) for key, value in episodes.items()})
            progress(self.iteration, total, "distilling")
            last = self.iteration == total
            reason = "" if last else stop.reason(self.iteration)
            if last or reason or self.iteration % self.config.save_interval == 0:
                self._save()
            status = "stopped" if reason else "finished"
        return DistillResult(status, reason, self.out, self.iteration, self.loss, stop.elapsed)

    @torch.no_grad()
    def _act(self, share: float) -> Rollout:
        """Step the environments; the teacher takes a share of the actions and labels all."""
        steps, rollout = self.config.steps_per_env, {"memory": self.memory.clone()}
        rollout["ended"] = torch.empty(steps, len(self.memory), dtype=torch.bool, device=self.device)
        targets = [head.target for head in self.decoders]
        self.student.eval()
        for step in range(steps):
            obs = self.observations
            row = {name: obs[name] for name in (*self.groups, *targets)}
            if self.front is not None:
                with torch.autocast(self.device.type, self.precision, enabled=self.precision is not None):
                    features, self.touched = self.front(obs[TACTILE], self.touched)
                row[TACTILE], self.touched = features.float(), self.touched.float()
            latent, memory = self.student.advance(row, self.memory)
            action = self.student.action_of(latent).float()
            right = self.teacher(obs).float()
            # Ross et al. 2011: the student's own states are visited, a share of actions being the teacher's, and the
            # teacher labels them all.
            taught = torch.rand(len(action), 1, device=self.device) < share
            row |= {"teacher": right, "student": action}
            for name, value in row.items():
                if name not in rollout:
                    rollout[name] = value.new_empty(steps, *value.shape)
                # The environment may write its next observations over these.
                rollout[name][step].copy_(value)
            self.observations, _, terminated, truncated, _ = self.env.step(torch.where(taught, right, action))
            ended = terminated | truncated
            rollout["ended"][step].copy_(ended)
            self.memory = torch.where(ended[:, None], 0.0, memory.float())
            if self.front is not None:
                self.touched = torch.where(ended[:, None], 0.0, self.touched)
        return rollout

    def _learn(self, rollout: Rollout) -> dict[str, float]:
        """Take the steps of one iteration; return the mean losses over its first epoch on the new rollout."""
        self.learner.train()
        self.student.update_normalization(rollout)
        if self.config.aggregate:
            self.rollouts[self.iteration] = rollout
            self.rollouts = {number: self.rollouts[number] for number in [*self.rollouts][-self.config.aggregate :]}
        losses: dict[str, torch.Tensor] = {}
        for _ in range(self.config.epochs or 1):
            means = self._pass(rollout)
            losses = losses or means
            older = [other for other in self.rollouts.values() if other is not rollout]
            if older:
                self._pass(older[int(torch.randint(len(older), ()))])
        return {name: float(value) for name, value in losses.items()}

    def _pass(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Go once through a rollout, a gradient step every ``gradient_length`` steps."""
        length = self.config.gradient_length or 1
        memory, steps = rollout["memory"], len(rollout["teacher"])
        scale = torch.ones(rollout["teacher"].shape[-1], device=self.device)
        if self.config.loss == "inv_var_mse":
            # Error of each joint in units of the teacher's own variance, bounded below for joints that hardly move.
            scale = 1 / rollout["teacher"].flatten(0, 1).var(0).clamp(min=_LEAST_VARIANCE)
        sums: dict[str, torch.Tensor] = {}
        for first in range(0, steps, length):
            chunk = {name: value[first : first + length] for name, value in rollout.items()}
            share = len(chunk["teacher"]) / steps
            parts, memory = self.step({**chunk, "memory": memory, "scale": scale})
            sums = {name: sums.get(name, 0) + share * value for name, value in parts.items()}
        return sums

    def _loss(self, given: Mapping[str, torch.Tensor]) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """Return the parts of the loss of a chunk and the memory after it."""
        latent, memory = self.student.unroll(given, given["memory"], given["ended"])
        parts = {"behaviour": self._behaviour(self.student.action_of(latent), given)}
        for head in self.decoders:
            # Auxiliary decoders read the latent: their losses shape it, and nothing of them remains in the policy.
            aim = given[head.target].flatten(2) * head.scale
            parts[head.target] = head.weight * nn.functional.mse_loss(self.heads[head.target](latent), aim)
        return parts, memory

    def _behaviour(self, action: torch.Tensor, given: Mapping[str, torch.Tensor]) -> torch.Tensor:
        right, scale = given["teacher"], given["scale"]
        error = (action - right).pow(2) * scale
        if self.config.clip is not None:
            # As PPO clips values: what moved further than allowed in this iteration gains nothing more.
            old = given["student"]
            near = old + (action - old).clamp(-self.config.clip, self.config.clip)
            error = torch.maximum(error, (near - right).pow(2) * scale)
        return error.mean()

    def _claim(self) -> None:
        """Write the run's configuration, or check that the folder holds this run."""
        earlier: dict[str, Any] = {}
        origins = origins_of(self.config)

        def _stated(document: dict[str, Any]) -> object:
            check_version(document, str(self.out))
            earlier.update(document)
            # Runs of earlier versions do not say what they learned from.
            return {**document.get("distill", {}), **origins, **(document.get("origins") or {})}

        def _begin() -> dict[str, Any]:
            return {**describe_run(self.config, self.student, self.env), "origins": origins}

        claim(self.out / CONFIG, asdict(self.config) | origins, _begin, stated=_stated, what="student")
        if earlier:
            check_hand(earlier, self.env, str(self.out))
            check_probes(self.config.resolution, earlier.get("deployment", {}).get("probes"))

    def _save(self) -> None:
        """Write the state, the rollouts that are learned from again, and the student."""
        for number, rollout in self.rollouts.items():
            # A file of this number from before the last state was left by a run that ended while it saved.
            if number >= self.saved:
                write_tensors(self.out / "rollouts" / f"{number}.safetensors", rollout)
        reached = {"iteration": self.iteration, "loss": self.loss, "rollouts": [*self.rollouts]}
        world = {"env": self.env.state_dict(), "memory": self.memory, "touched": self.touched}
        random = random_state(self.device)
        # The student first: a run that its state says is finished is not saved again.
        write_tensors(self.out / MODEL, self.student.state_dict())
        save_state(
            self.out / STATE, {**learner_state(self.learner, self.optimizer), **reached, **world, "random": random}
        )
        self.saved = self.iteration
        for path in (self.out / "rollouts").glob("*.safetensors"):
            if int(path.stem) not in self.rollouts:
                path.unlink()

    def _go_on(self, state: Mapping[str, Any]) -> None:
        """Take up what :meth:`_save` wrote."""
        restore_learner(state, self.learner, self.optimizer, self.out / STATE)
        self.iteration = self.saved = int(state["iteration"])
        self.loss = float(state["loss"])
        cuda = self.device.type == "cuda"
        for group in self.optimizer.param_groups:
            group |= {"fused": cuda, "capturable": cuda}
        for entries in self.optimizer.state.values():
            entries["step"] = entries["step"].to(self.device)
        self.env.load_state_dict(state["env"])
        self.observations = self.env.observations
        self.memory, self.touched = (state[name].to(self.device) for name in ("memory", "touched"))
        for number in state["rollouts"]:
            stored = load_file(self.out / "rollouts" / f"{number}.safetensors")
            # Earlier versions stored the features of a frozen encoder by a name of their own.
            names = {name: TACTILE if name == "features" else name for name in stored}
            self.rollouts[number] = {names[name]: value.to(self.device) for name, value in stored.items()}
        set_random_state(state["random"], self.device)


def describe_run(config: DistillConfig, student: TactilePolicy, env: Any) -> dict[str, Any]:
    """Return what a run's ``config.json`` holds: the student, its input, and what a robot needs to run it."""
    return {
        "brainbench_student": 1,
        "task_version": TASK_VERSION,
        "contacts": asdict(env.task.contacts),
        "world": world_of(env.task),
        "hand_physics": env.hand.physics,
        "distill": asdict(config),
        "network": student.config,
        # A list: the order counts, and JSON keeps that of lists alone.
        "groups": [[name, list(shape)] for name, shape in student.shapes.items()],
        "actions": env.num_actions,
        "deployment": {
            **{name: getattr(config, name) for name in ("task", "hand", "observe", "placement", "resolution")},
            **({"probes": file_hash(config.resolution)} if is_probe_file(config.resolution) else {}),
            **({"command": [1.0]} if env.task.command == ("on",) else {}),
            "rate": 1 / env.step_dt,
            "sub_steps": env.decimation,
            "action_limit": env.task.action_limit,
            "starts": env.task.starts,
            "twist": env.task.taxel_twist,
            "contacts": asdict(env.task.contacts),
            "joints": list(env.joint_names),
            "action_map": asdict(env.action_map),
            "frozen": dict(env.frozen),
            "links": list(env.touch.links) if env.touch is not None else [],
        },
        "provenance": provenance(),
    }
