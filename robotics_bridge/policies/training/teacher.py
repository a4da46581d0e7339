"""The privileged teacher: PPO with curiosity (RND) and a critic that sees more, through rsl_rl (thesis, table 4.4).

A run is a folder: ``config.json``, ``model_<iteration>.safetensors`` (actor and critic), ``state.safetensors``
(all that the next iteration depends on), ``log.jsonl`` and ``tensorboard/``. Started again, it goes on exactly.

A student follows from its configuration alone: environment, teacher, distillation, evaluation (:func:`train_student`).
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, cast

import torch

from brainbench.core.errors import DataError, UsageError, brief, check_name, needing
from brainbench.core.files import file_hash, provenance, read_json, read_mapping, to_plain, write_json, write_tensors
from brainbench.core.limits import Count, Limit, NotNegative, Positive, Seed, limited
from brainbench.core.progress import Progress, track
from brainbench.core.reading.regular import readable
from brainbench.core.reading.tensors import check_finite
from brainbench.core.runs.folder import (
    RESTART,
    STATE,
    RunEnd,
    Stop,
    claim,
    load_state,
    occupied,
    random_state,
    save_state,
    set_random_state,
)
from brainbench.core.runs.log import RunLog, check_sinks
from brainbench.models.ops.layers import load_named
from robotics_bridge import tasks
from robotics_bridge.envs.env import Env, RslRlEnv
from robotics_bridge.policies.contract import check_fit, check_version, from_json, with_contacts_of, world_of
from robotics_bridge.policies.encoders.arms import ARMS, EncoderConfig
from robotics_bridge.policies.encoders.taxel_grid import CONTROL_SUB_STEP, HandCalibration
from robotics_bridge.policies.evaluate import Policy, evaluate
from robotics_bridge.policies.shipped import SENSING, list_policies, model_file
from robotics_bridge.policies.student import TACTILE, ActingModel
from robotics_bridge.policies.training.distill import (
    CONFIG,
    MODEL,
    DistillResult,
    describe_run,
    distill,
    load_student,
    origins_of,
)
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.settings import CONTACTS, TeacherSettings, contacts_name
from robotics_bridge.tasks.task import GROUPS, TASK_VERSION, check_measured

_log = logging.getLogger(__name__)

EVALUATION = "evaluation.json"
"""File of a student's evaluations."""
GRADED = ("metric", "goals", "turn_rate", "seconds", "returns", "dropped")
"""Quantities of an episode beside its success."""
SEEDS = (1000, 1001, 1002)
"""Seeds of the environments in which students are evaluated; none of them is one of training."""
_CALIBRATION_STEPS, _CALIBRATION_ENVS = 80, 64
"""Two seconds of control, in so many environments."""


@dataclass(frozen=True)
class Student:
    """A student that was distilled, and how it does."""

    folder: Path
    result: DistillResult
    evaluations: tuple[dict[str, Any], ...]
    """One per evaluation seed; empty when none was asked for, or the run diverged."""

    @property
    def success(self) -> float | None:
        """Share of successful episodes; None without any."""
        return success_of(self.evaluations)


def success_of(evaluations: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the share of successful episodes of some evaluations; None without any."""
    episodes = [value for evaluation in evaluations for value in evaluation["success"]]
    return sum(episodes) / len(episodes) if episodes else None


@limited(of="'{}' of a student's run")
class StudentRun:
    """Where and how long a student is distilled, and how it is evaluated then."""

    episodes: Annotated[int, Limit(least=0)] = 100
    """Episodes of the evaluation, per seed; 0 for none."""
    evaluations: Annotated[int, Limit(least=1, most=3)] = 3
    """Seeds of the evaluation."""
    device: str = "cpu"
    """``cpu``, or ``cuda`` (``cuda:1``) for MuJoCo Warp."""
    stop_after: NotNegative | None = None
    """Save, stop and evaluate after so many seconds."""
    stop_at: Count | None = None
    """Likewise after so many iterations in all."""


def train_student(
    config: DistillConfig, out: str | Path, options: StudentRun | None = None, *, progress: Progress | None = None
) -> Student:
    """Distil a student, or go on with an interrupted one, and evaluate it, also when its time is over.

    Its ``teacher`` is a folder or a shipped one. A run in the folder ``out`` that is finished and evaluated is left as
    it is. An evaluation says how many iterations the student had.
    """
    options = options or StudentRun()
    if not config.teacher:
        raise UsageError(
            "A student needs a teacher: the folder of a run of brainbench policy train, or a shipped one "
            f"({', '.join(list_policies('teacher'))})."
        )
    out = Path(out)
    task = tasks.load(config.task, config.variant)
    if config.contacts is not None:
        task = replace(task, contacts=CONTACTS[config.contacts])
    elif config.variant != "published":
        task = with_contacts_of(task, [config.teacher])
    if config.law == "published":
        task = replace(task, taxel_twist=tasks.load(config.task, "published").taxel_twist)
    if config.tactile is not None and config.tactile.time == "resampled" and task.solver.timestep != CONTROL_SUB_STEP:
        raise UsageError(
            f"time='resampled' is for readings every {CONTROL_SUB_STEP:g} s; those of {config.task!r} come every "
            f"{task.solver.timestep:g} s. Use time='native'."
        )
    env = tasks.make(
        task, num_envs=config.num_envs, device=options.device, hand=config.hand, observe=config.observe,
        placement=config.placement, resolution=config.resolution, noisy=config.noisy,
        seed=config.seed,
    )  # fmt: skip
    contacts = contacts_name(task.contacts)
    config = replace(config, contacts=contacts if contacts in CONTACTS else None)
    teacher = load_teacher(config.teacher, env)
    config = calibrated(config, env, teacher, out)
    stops = {"stop_after": options.stop_after, "stop_at": options.stop_at}
    result = distill(config, out, env=env, teacher=teacher, **stops, progress=progress)
    if result.status == "diverged" or not options.episodes:
        return Student(out, result, ())
    return Student(out, result, evaluate_student(out, env, options, result.iterations, progress))


def is_done(config: DistillConfig, out: Path, stop_at: int | None = None) -> bool:
    """Return whether a folder holds this very student, evaluated after its last iteration, or after ``stop_at``."""
    if not (out / EVALUATION).is_file():
        return False
    mine = config.resolved(tasks.load(config.task, config.variant).student)
    described = read_mapping(out / CONFIG)
    check_version(described, str(out))
    stored = DistillConfig.of(described.get("distill", {}))
    # Contacts and calibration that a student does not state are chosen when it begins.
    settings = {**stored.encoder_settings, **mine.encoder_settings}
    mine = replace(mine, encoder_settings=settings, contacts=mine.contacts or stored.contacts)
    origins = described.get("origins") or {}
    if any(origins.get(name, now) != now for name, now in origins_of(mine).items()):
        return False
    total = stored.iterations or 0
    rows = read_json(out / EVALUATION)
    return mine == stored and all(row.get("iterations", total) >= min(total, stop_at or total) for row in rows)


def calibrated(config: DistillConfig, env: Any, teacher: Any, out: Path) -> DistillConfig:
    """Return the configuration with a hand calibration for a network, measured while the teacher acts.

    Nothing changes for encoders that are learned with the policy, or where a calibration is given. A run that was
    begun keeps the one it began with.
    """
    tactile = config.tactile
    if tactile is None or tactile.arm in ARMS or "calibration" in config.encoder_settings:
        return config
    if (out / CONFIG).is_file():
        measured = read_mapping(out / CONFIG).get("distill", {}).get("encoder_settings", {}).get("calibration")
    else:
        measured = asdict(_measure(tactile, env, teacher))
    settings = {} if measured is None else {"calibration": measured}
    return replace(config, encoder_settings={**config.encoder_settings, **settings})


def _measure(tactile: EncoderConfig, env: Any, teacher: Any) -> HandCalibration:
    """Return the unit of force and moment of two seconds in which the teacher acts."""
    grid = tactile.grid().to(env.device)
    observations, felt = env.reset(), []
    for _ in range(_CALIBRATION_STEPS):
        felt.append(grid(observations["tactile"][:_CALIBRATION_ENVS]).cpu())
        observations, *_ = env.step(teacher(observations))
    try:
        return HandCalibration.fit(torch.stack(felt))
    except DataError:
        _log.warning("The teacher touched nothing in %d steps; the default calibration is used.", _CALIBRATION_STEPS)
        return HandCalibration()


def evaluate_student(
    folder: str | Path, env: Any, options: StudentRun, iterations: int, progress: Progress | None
) -> tuple[dict[str, Any], ...]:
    """Run whole episodes with a student and write ``evaluation.json``, one entry for each seed of :data:`SEEDS`.

    An entry lists per episode ``success``, ``metric``, ``returns``, ``goals``, ``turn_rate`` (rad/s), ``seconds`` and
    ``dropped`` (:class:`~robotics_bridge.policies.evaluate.PolicyEvaluation`), and holds the ``iterations`` learned
    so far.
    """
    student, _ = load_student(folder, device=str(env.device))
    policy, rows = Policy(student), []
    for seed in track(SEEDS[: options.evaluations], "evaluating", progress):
        result = evaluate(env, policy, episodes=options.episodes, seed=seed, name=Path(folder).name)
        rows.append(
            {
                "seed": seed, "success": [float(item) for item in result.success], "diverged": result.diverged,
                "iterations": iterations,
                **{name: [float(item) for item in getattr(result, name)] for name in GRADED},
            }
        )  # fmt: skip
    write_json(Path(folder) / EVALUATION, rows)
    return tuple(rows)


SENSES = {
    "proprio": "proprio", "touch": TACTILE, "command": "command", "link_pose": "link_pose", "thermal": "thermal"
}  # fmt: skip
"""Name of an observation → its group."""


def sensed_groups(observe: Iterable[str]) -> tuple[str, ...]:
    """Return the groups of observations of :data:`SENSES`; UsageError for another, or one that is privileged."""
    groups = []
    for name in observe:
        if name in GROUPS and name != TACTILE:
            check_measured((name,), "A policy without a teacher")
        check_name("observation", name, SENSES)
        groups.append(SENSES[name])
    return tuple(groups)


def sensing_policy(
    env: Env, settings: TeacherSettings, seed: int, observe: tuple[str, ...], encoder: str
) -> DistillConfig:
    """Return what a policy that reads some observations is as a student: its touch and network, and its memory."""
    for name in sensed_groups(observe):
        if name not in env.observation_shapes:
            given = "make the environment with an observation type" if name == TACTILE else "leave it out"
            raise UsageError(f"Task {env.task.name!r} gives no {name!r} here: {given}.")
    o, contacts = env.options, contacts_name(env.task.contacts)
    senses: dict[str, Any] = {"observe": "none"}
    if "touch" in observe:
        senses = {name: getattr(o, name) for name in ("observe", "placement", "resolution", "noisy")} | {
            "encoder": encoder
        }
    return DistillConfig(
        task=env.task.name, hand=env.hand.source, embedder="lstm", hidden=settings.hidden,
        num_envs=env.num_envs, seed=seed, contacts=cast(Any, contacts if contacts in CONTACTS else None), **senses,
    )  # fmt: skip


_IDENTITY = (
    "task", "hand", "num_envs", "seed", "settings", "observe", "contacts", "rate", "world", "sensing", "hand_physics",
)  # fmt: skip
"""Facts that must be equal for a run to go on."""


@dataclass(frozen=True)
class TeacherResult(RunEnd):
    """Outcome of a training run."""

    iterations: int
    """Done since the run began."""
    steps: int
    """Control steps of all environments since the run began."""
    seconds: float
    """Time of this call (s)."""
    history: tuple[Mapping[str, float], ...]
    """Lines of ``log.jsonl`` written by this call."""


class Trainer:
    """PPO on one environment batch, by default with the task's settings; :meth:`iterate` is one iteration."""

    def __init__(
        self,
        env: Env,
        settings: TeacherSettings | None = None,
        *,
        seed: int = 0,
        observe: tuple[str, ...] = (),
        encoder: str = "rnn",
    ) -> None:
        with needing("rsl-rl-lib", extra="policies", purpose="Training policies"):
            from rsl_rl.algorithms import PPO
        self.env, self.settings = RslRlEnv(env), settings or env.task.teacher
        torch.manual_seed(seed)
        groups = {name: tuple(groups) for name, groups in env.task.groups.items()}
        self.sensing = sensing_policy(env, self.settings, seed, observe, encoder) if observe else None
        """What a policy that senses is as a student; None for a teacher."""
        actor = None
        if self.sensing is not None:
            groups["actor"] = sensed_groups(observe)
            tactile = self.sensing.tactile
            actor = {
                "class_name": "robotics_bridge.policies.student:TactilePolicy", "embedder": self.sensing.embedder,
                "tactile": asdict(tactile) if tactile is not None else None,
            }  # fmt: skip
        self.config = self.settings.config(groups, actor)
        # rsl_rl cuts the pass of a policy with memory by environments, leaves out what is left over, and multiplies all
        # steps by all where a part holds a single one.
        pieces = env.num_envs * (1 if actor else self.settings.steps_per_env)
        fits = (n for n in range(min(self.settings.minibatches, pieces // 2), 0, -1) if not actor or pieces % n == 0)
        parts = self.config["algorithm"]["num_mini_batches"] = next(fits, 0)
        if not parts:
            what = "environments" if actor else "steps"
            raise UsageError(f"PPO learns from at least two {what} at a time; received {pieces}: take more of them.")
        observations = self.env.get_observations()
        # rsl_rl prints its networks; what a command prints is its own business.
        with contextlib.redirect_stdout(io.StringIO()) as said:
            wrapped: Any = self.env
            config = json.loads(json.dumps(self.config))
            self.algorithm = PPO.construct_algorithm(observations, wrapped, config, str(env.device))
        _log.info("%s", said.getvalue())
        self.iteration = 0
        self._observations = observations
        # First episodes end at different times, so that no batch holds only beginnings.
        self.env.episode_length_buf = torch.randint_like(self.env.episode_length_buf, int(env.max_episode_length))
        self.algorithm.train_mode()

    def iterate(self) -> dict[str, float]:
        """Collect steps, learn from them, and return steps in all, losses, episode means and seconds spent."""
        env, algorithm, steps = self.env, self.algorithm, self.config["num_steps_per_env"]
        start = _now(env.device)
        reward = torch.zeros((), device=env.device)
        curiosity = torch.zeros((), device=env.device)
        with torch.inference_mode():
            for _ in range(steps):
                actions = algorithm.act(self._observations)
                self._observations, rewards, dones, extras = env.step(actions)
                algorithm.process_env_step(self._observations, rewards, dones, extras)
                reward += rewards.mean()
                if algorithm.rnd:
                    curiosity += algorithm.intrinsic_rewards.mean()
            algorithm.compute_returns(self._observations)
        collected = _now(env.device)
        try:
            losses = algorithm.update()
        except (RuntimeError, ValueError) as error:
            self._check_weights(error)
            raise
        self._check_weights()
        if self.sensing is not None:
            # Trajectories of a policy with memory have other sizes each time, so that PyTorch keeps ever more freed
            # blocks; Warp, which needs some for the next step, ran out of 80 GB after 69 iterations.
            torch.cuda.empty_cache()
        self.iteration += 1
        row = {
            "steps": self.iteration * steps * env.num_envs,
            "reward": float(reward) / steps, "collect_s": collected - start, "learn_s": _now(env.device) - collected,
            **{f"loss/{name}": float(value) for name, value in losses.items()},
            "learning_rate": float(algorithm.learning_rate),
            "std": float(algorithm.get_policy().output_std.detach().mean()),
        }  # fmt: skip
        if algorithm.rnd:
            row["curiosity"] = float(curiosity) / steps
        if self._curriculum:
            row["threshold"] = float(env.unwrapped.goals.threshold)
        return row | {f"episode/{name}": value for name, value in env.unwrapped.statistics().items()}

    def _check_weights(self, cause: Exception | None = None) -> None:
        weights = [weight for model in (self.algorithm.actor, self.algorithm.critic) for weight in model.parameters()]
        # One number to wait for: the norm of all weights is one only if each is.
        if not bool(torch.nn.utils.get_total_norm(weights).isfinite()):
            raise DataError(
                f"Learning diverged: after iteration {self.iteration + 1} weights are no numbers. The last "
                "checkpoint stands; go on from that with a smaller rate (--change learning_rate=1e-4), or begin with "
                "another encoder."
            ) from cause

    @property
    def _curriculum(self) -> dict[str, torch.Tensor]:
        return {f"curriculum_{name}": value for name, value in self.env.unwrapped.goals.curriculum().items()}

    def begin_from(self, path: Path, *, std: float | None = None) -> None:
        """Take up actor and critic of another run (:func:`model_file`); learning begins anew.

        Actions begin with the standard deviation ``std``; None takes that of the other run.
        """
        file = model_file(path)
        given, state = load_state(file), self.algorithm.save()
        parts = {name: tree for name in ("actor", "critic") if isinstance(tree := given.get(name), dict) and tree}
        if missing := [name for name in ("actor", "critic") if name not in parts]:
            raise DataError(
                f"{brief(str(file))} holds no {missing[0]}, and a run begins with actor and critic of another: give a "
                "folder of brainbench policy train, one of its model_<iteration>.safetensors, or a shipped teacher."
            )
        with readable(file, "teacher", "It is damaged, or of another policy."):
            for name, tree in parts.items():
                check_finite(tree, str(file))
                what = f"the {name} here, whose observations, actions or layers are not those of {brief(str(file))}"
                load_named(state[f"{name}_state_dict"], tree, what=what)
        if std is not None:
            spread: Any = self.algorithm.get_policy().distribution
            log = spread.std_type == "log"
            (spread.log_std_param if log else spread.std_param).data.fill_(math.log(std) if log else std)

    def state(self) -> dict[str, Any]:
        """Return all that the next iteration depends on, random numbers included."""
        state = {"algorithm": self.algorithm.save(), "env": self.env.unwrapped.state_dict()}
        state |= {name: value.clone() for name, value in self._curriculum.items()}
        state |= {"iteration": self.iteration, "random": random_state(self.env.device)}
        if self.sensing is not None:
            state["memory"] = self.algorithm.get_policy().get_hidden_state()
        if self.algorithm.rnd:
            normaliser = self.algorithm.rnd.reward_normalizer
            # rsl_rl keeps these two outside its state_dict.
            state["rnd_average"] = getattr(getattr(normaliser, "disc_avg", None), "avg", None)
            state["rnd_updates"] = self.algorithm.rnd.update_counter
        return state

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state` returned."""
        self.env.unwrapped.load_state_dict(state["env"])
        self.algorithm.load(dict(state["algorithm"]), None, strict=True)
        for name, value in self._curriculum.items():
            # A run that was begun without a curriculum begins it now.
            value.copy_(state.get(name, value))
        self.iteration = int(state["iteration"])
        if state.get("memory") is not None:
            self.algorithm.get_policy().reset(hidden_state=state["memory"].to(self.env.device))
        if self.algorithm.rnd:
            self.algorithm.rnd.update_counter = int(state["rnd_updates"])
            average = state["rnd_average"]
            if average is not None:
                self.algorithm.rnd.reward_normalizer.disc_avg.avg = average.to(self.env.device)  # type: ignore[union-attr]
        self._observations = self.env.get_observations()
        set_random_state(state["random"], self.env.device)


@limited(of="'{}' of a teacher's run", kw_only=True)
class TeacherRun:
    """Extent of a training run, and what it begins with."""

    iterations: Count | None = None
    """In total, earlier ones of the run included; the settings' by default."""
    minutes: Positive | None = None
    """Stop after this time and save."""
    seed: Seed = 0
    """Seed of weights and actions."""
    save_every: Count = 50
    """Iterations between checkpoints."""
    start: Path | None = None
    """Another run, one of its models, or a shipped teacher, whose actor and critic a new run begins with."""
    start_std: Positive | None = None
    """Standard deviation of actions that it begins with, to explore anew; by default that of the other run."""
    observe: tuple[str, ...] = ()
    """What the policy reads, with memory, in place of a teacher's groups: proprio, touch, command, …; the critic, which
    only training needs, keeps its own."""
    encoder: str = "rnn"
    """Network of the touch that it reads. Those with layer norm may diverge: at places that nothing touches it enlarges
    the gradient once for each step back in time."""
    loggers: tuple[str, ...] = ("tensorboard",)
    """Loggers beside log.jsonl: tensorboard, csv (log.csv), wandb (offline)."""

    def __post_init__(self) -> None:
        if self.start_std is not None and self.start is None:
            raise UsageError(f"start_std goes with a run to start from; received {self.start_std!r} alone.")
        sensed_groups(self.observe)
        check_sinks(self.loggers)


def train(
    env: Env,
    run: Path,
    options: TeacherRun | None = None,
    *,
    settings: TeacherSettings | None = None,
    progress: Progress | None = None,
) -> TeacherResult:
    """Train a teacher in a folder, or go on with the run that the folder holds, in environments as before.

    The settings of the optimisation are those of the task by default.
    """
    settings, options = settings or env.task.teacher, options or TeacherRun()
    stop = Stop(None if options.minutes is None else 60 * options.minutes)
    with occupied(run, stop):
        total = options.iterations or settings.iterations
        trainer = Trainer(env, settings, seed=options.seed, observe=options.observe, encoder=options.encoder)
        env.goals.start_curriculum()
        origin = None
        if options.start is not None:
            start = model_file(options.start)
            trainer.begin_from(start, std=options.start_std)
            origin = {"file": str(start), "hash": file_hash(start), "std": options.start_std}
        facts = {
            "kind": "teacher", "task": env.task.name, "hand": env.hand.name,
            "hand_path": "" if env.hand.pads else str(env.hand.path), "hand_physics": env.hand.physics,
            "num_envs": env.num_envs, "seed": options.seed, "settings": asdict(settings), "rsl_rl": trainer.config,
            "observation_shapes": {name: list(shape) for name, shape in env.observation_shapes.items()},
            "action_names": list(env.action_names), "action_map": asdict(env.action_map), "start": origin,
            "task_version": TASK_VERSION, "contacts": asdict(env.task.contacts), "observe": list(options.observe),
            "rate": 1 / env.step_dt, "world": world_of(env.task), "sensing": to_plain(trainer.sensing),
        }  # fmt: skip
        _resume(trainer, run, facts)
        # Iterations after the last checkpoint are done again.
        rows, reason = [], ""
        with contextlib.closing(RunLog(run, "iteration", trainer.iteration, sinks=options.loggers, facts=facts)) as log:
            while trainer.iteration < total and not reason:
                row = trainer.iterate()
                rows.append({"iteration": trainer.iteration, **row})
                log.write("", trainer.iteration, **row)
                if progress:
                    progress(trainer.iteration, total, "training")
                reason = "" if trainer.iteration == total else stop.reason()
                if reason or trainer.iteration % options.save_every == 0 or trainer.iteration == total:
                    _save(trainer, run)
                    log.save()
        steps = trainer.iteration * settings.steps_per_env * env.num_envs
        status = "stopped" if reason else "finished"
        return TeacherResult(status, reason, run, trainer.iteration, steps, stop.elapsed, tuple(rows))


def _resume(trainer: Trainer, run: Path, facts: dict[str, Any]) -> None:
    """Claim the folder of a run, and go on from its last state where there is one."""
    document = run / "config.json"

    def _stated(document_of_run: dict[str, Any]) -> object:
        check_version(document_of_run, str(run))
        # Settings that came later than the run had their defaults in it.
        settings = from_json(TeacherSettings, document_of_run.get("settings"), f"settings of {document}")
        return {**document_of_run, "settings": to_plain(settings)}

    # Without a state the run has yet to begin with it, and who names another expects that one.
    free = facts["start"] is None and (run / STATE).exists()
    identity = {name: facts[name] for name in (_IDENTITY if free else (*_IDENTITY, "start"))}
    claim(document, identity, lambda: facts | {"provenance": provenance()}, stated=_stated)
    if not (run / STATE).exists():
        return
    state = load_state(run / STATE)
    with readable(run / STATE, "training state", RESTART):
        trainer.load(state)


def _save(trainer: Trainer, run: Path) -> None:
    models = {name: trainer.algorithm.save()[f"{name}_state_dict"] for name in ("actor", "critic")}
    save_state(run / f"model_{trainer.iteration}.safetensors", models)
    if trainer.sensing is not None:
        actor: Any = trainer.algorithm.get_policy()
        weights = {name: value for name, value in actor.state_dict().items() if not name.startswith("distribution.")}
        write_tensors(run / SENSING / MODEL, weights)
        write_json(run / SENSING / CONFIG, describe_run(trainer.sensing, actor, trainer.env.unwrapped))
    save_state(run / STATE, trainer.state())


def load_teacher(run: str | Path, env: Env) -> Policy:
    """Return the trained actor of a run for environments with the same observation groups and actions.

    The run is a folder, one of its ``model_<iteration>.safetensors``, or a name of
    :func:`~robotics_bridge.policies.shipped.list_policies`.
    """
    file = model_file(run)
    facts = read_mapping(file.parent / "config.json", "configuration of a teacher")
    check_fit(facts, env, str(run))
    hidden = from_json(TeacherSettings, facts.get("settings"), "settings of config.json").hidden
    weights = load_state(file).get("actor")
    weights = weights if isinstance(weights, dict) else {}
    check_finite(weights, str(file))
    biases = [weights.get(f"mlp.{2 * layer}.bias") for layer in range(len(hidden))]
    if [list(getattr(bias, "shape", ())) for bias in biases] != [[width] for width in hidden]:
        raise DataError(f"The weights in {str(file)!r} are of another policy than config.json describes.")
    # Who only acts finds random numbers and episodes as they were.
    with torch.random.fork_rng(devices=[]):
        actor = ActingModel(env.observations, env.task.groups, "actor", env.num_actions, hidden)
    weights = {name: value for name, value in weights.items() if not name.startswith("distribution.")}
    task, mine = str(facts.get("task"))[:80], env.task.name
    with readable(file, "teacher", "It is damaged, or of another policy."):
        load_named(actor.state_dict(), weights, what=f"a policy of the task {mine!r} ({str(run)!r} learned {task!r})")
    return Policy(actor.to(env.device))


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
