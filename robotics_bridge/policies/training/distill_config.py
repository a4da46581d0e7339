"""Options of distillation: one student as plain values, and a sweep of students as one TOML file.

Per entry of a sweep (task, hand, placements) there are the baseline ``none`` and the product of observation types,
placements, resolutions and clean or noisy readings (thesis, table 4.10). Subsets: ``all``; ``types``, every type at the
pinned resolution and noise; ``encoders``, the arms of tactile encoders there; or one type's name, all its resolutions
and noise. A file may list ``[[students]]`` instead, each with its own settings; ``all`` is then that list.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import field, fields, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from brainbench.core.errors import UsageError, brief, check_each, check_name, listing, repeats
from brainbench.core.limits import Count, Limit, Seed, Share, limited
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_toml
from brainbench.core.reading.values import read_table
from brainbench.models.recipes import Architecture
from robotics_bridge.hands.layouts import check_names
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.policies.encoders.arms import ARMS, AUTO, EncoderConfig
from robotics_bridge.tasks.settings import LearningRate, Loss, StudentSettings, Widths

_HIDDEN = (512, 256, 128)
_SHARED = ("hand", "observe", "placement", "resolution")
"""Fields of an encoder that are those of its student."""
FELT = ("placement", "resolution", "noisy", "law", "encoder", "encoder_settings")
"""Fields of a student's touch, which one without touch does not have."""
_Times = Annotated[int, Limit(least=0)]


@limited(of="'{}' of a student", kw_only=True)
class DistillConfig:
    """A student, with the task's own settings for those of None (thesis, table 4.4); UsageError for a bad value."""

    task: str
    teacher: str = ""
    """Folder of the teacher's run, or the name of a shipped teacher."""
    start: str | None = None
    """A student, by folder or shipped name, whose weights it begins with; by default new ones. Any version of the tasks
    will do."""
    hand: str = "xhand1"
    """``xhand1``, ``sharpa``, or a URDF or MJCF file."""
    variant: str = "default"
    """Configuration of the task: ``default`` or ``published``."""
    observe: str = "force_torque"
    """Tactile observation type (table 4.3), ``agg_bool``, or ``none``."""
    placement: str = "hand"
    """Place of the taxels: ``tips``, ``fingers``, ``palm`` or ``hand``."""
    resolution: str = "med"
    """Number of taxels: ``low``, ``med`` or ``high``; or a probe file (``.json``)."""
    noisy: bool = False
    """Taxels with the published noise (table 4.12)."""
    contacts: Literal["firm", "published"] | None = None
    """Contact model, ``firm`` or ``published``; by default that in which the teacher was trained."""
    law: Literal["task", "published"] = "task"
    """Forces of force taxels: the task's own (the engine's, static friction), or the ``published`` law of depths."""
    encoder: str = AUTO
    """Tactile encoder: ``mlp``, ``rnn``, ``tactile_cnn``, ``tactile_convrnn``, … (an arm of
    :data:`~robotics_bridge.policies.encoders.arms.ARMS`), or a network's name; ``auto`` as published."""
    encoder_settings: Mapping[str, Any] = field(default_factory=dict)
    """Further fields of :class:`~robotics_bridge.policies.encoders.arms.EncoderConfig`: time, learning, seed, …"""
    embedder: Literal["none", "mlp", "lstm"] = "mlp"
    """Embedder of joints and goal: ``none``, ``mlp`` or ``lstm``."""
    hidden: Widths = _HIDDEN
    """Widths of the head's layers."""
    num_envs: Count = 4096
    """Environments at once."""
    steps_per_env: Count = 24
    """Control steps of every environment in an iteration."""
    iterations: Count | None = None
    """Iterations in all; by default the task's own (table 4.4)."""
    learning_rate: LearningRate | None = None
    """Learning rate; by default the task's own (table 4.4)."""
    epochs: Count | None = None
    """Passes over the steps of an iteration; by default the task's own."""
    gradient_length: Count | None = None
    """Steps through which gradients flow back in time."""
    clip: Annotated[float, Limit(above=0, most=100)] | None = None
    """Largest change of an action within an iteration that still lowers the loss."""
    max_grad_norm: Annotated[float, Limit(above=0, most=1e6)] | None = None
    """Norm to which longer gradients are cut."""
    loss: Loss | None = None
    """Loss of the actions; by default the task's own."""
    teacher_share: Share = 0.0
    """Share of actions that the teacher takes at the start (β of DAgger); 0 is the published, on-policy way."""
    teacher_iterations: _Times = 0
    """Iterations over which that share falls linearly to 0; 0 keeps it."""
    aggregate: _Times = 0
    """Earlier rollouts that are kept and learned from again."""
    save_interval: Count = 100
    """Iterations from one saved state to the next."""
    seed: Seed = 0
    """Seed of weights, episodes and the teacher's share."""
    precision: Literal["float32", "bf16"] = "float32"
    """Precision of the tactile encoder in learning and acting: ``float32`` or ``bf16`` (mixed). The rest is single."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))
        kind = observation_type(self.observe)
        check_names(self.resolution, self.placement)
        defaults = {item.name: item.default for item in fields(self)} | {"encoder_settings": {}}
        if idle := [name for name in FELT if kind.sensor is None and getattr(self, name) != defaults[name]]:
            raise UsageError(f"A student that observes {self.observe!r} has no touch; leave out {listing(idle)}.")
        if self.teacher_iterations and not self.teacher_share:
            raise UsageError("'teacher_iterations' is the time in which 'teacher_share' falls, and that is 0.")
        if shared := {"name", *_SHARED} & set(self.encoder_settings):
            raise UsageError(f"{listing(shared)} of an encoder: set it for the student (its 'encoder' is the name).")
        _ = self.tactile  # whose settings are checked by its own class

    @classmethod
    def of(cls, value: Mapping[str, Any]) -> DistillConfig:
        """Return a configuration from a mapping of its fields; raise UsageError for a field that does not exist."""
        check_each("setting of a student", value, cls.__dataclass_fields__)
        return cls(**value)

    def resolved(self, settings: StudentSettings) -> DistillConfig:
        """Return the configuration with the task's own settings where it has none."""
        open_fields = ("iterations", "learning_rate", "epochs", "gradient_length", "clip", "max_grad_norm", "loss")
        settled = {name: getattr(settings, name) for name in open_fields if getattr(self, name) is None}
        return replace(self, **settled)

    @property
    def tactile(self) -> EncoderConfig | None:
        """The tactile encoder; None without touch."""
        if observation_type(self.observe).sensor is None:
            return None
        shared = {name: getattr(self, name) for name in _SHARED}
        # Another seed is another draw of what is random in the encoder too.
        return EncoderConfig.of({"seed": self.seed, **self.encoder_settings, "name": self.encoder, **shared})

    @property
    def draw(self) -> str | None:
        """What was drawn for the encoder: weights, or a seed; None for encoders that are learned with the policy."""
        tactile = self.tactile
        if tactile is None or (tactile.arm in ARMS and not tactile.arm.startswith("reservoir")):
            return None
        tagged = tactile.arm if ":" in tactile.arm or Architecture.parse(tactile.arm).tag else None
        return tactile.pretrained or tagged or f"seed {tactile.seed}"

    @property
    def felt(self) -> str:
        """Observation type, with the embedder of joints and the widths of the head where those are not the usual."""
        return f"{self.observe} ({', '.join(self._unusual)})" if self._unusual else self.observe

    @property
    def _unusual(self) -> list[str]:
        words = [] if self.embedder == "mlp" else [self.embedder]
        return words if self.hidden == _HIDDEN else [*words, f"head-{'-'.join(map(str, self.hidden))}"]

    @property
    def name(self) -> str:
        """Name that distinguishes the student from its neighbours, for folders and reports."""
        parts = [self.task, self.hand, self.observe]
        if self.tactile is not None:
            learning = f"-{self.tactile.learning}" if "learning" in self.encoder_settings else ""
            arm = self.tactile.arm.replace("/", "-").replace(":", "-")
            arm += f"-{units}-units" if (units := self.encoder_settings.get("units")) else ""
            parts += [
                self.placement,
                Path(self.resolution).stem,
                "noisy" if self.noisy else "clean",
                f"{arm}{learning}",
            ]
        parts += self._unusual
        parts += [] if self.contacts in (None, "firm") else [self.contacts]
        parts += [] if self.law == "task" else [f"{self.law}-law"]
        parts.append(f"seed{self.seed}")
        drawn = self.encoder_settings.get("pretrained") or self.encoder_settings.get("seed", self.seed)
        parts += [f"draw-{re.sub(r'[^A-Za-z0-9]+', '-', str(drawn)).strip('-')}"] if drawn != self.seed else []
        return "_".join(parts)

    def share(self, iteration: int) -> float:
        """Return the teacher's share of the actions in an iteration (from 0)."""
        if not self.teacher_iterations:
            return self.teacher_share
        return self.teacher_share * max(0.0, 1 - iteration / self.teacher_iterations)


PUBLISHED = Path(__file__).parents[1] / "sweeps" / "table-4.10.toml"
"""The sweep of the thesis."""
SUBSETS = ("all", "types", "encoders")
_OF_PRODUCT = ("types", "extra_types", "pinned", "encoders", "resolutions", "noisy")


class SweepEntry(msgspec.Struct, frozen=True):
    """A line of table 4.10."""

    task: str
    hand: str
    placements: tuple[str, ...] = ()
    iterations: int | None = None
    settings: dict[str, Any] = {}
    """Further fields of every student."""


class Pinned(msgspec.Struct, frozen=True):
    """What the subsets ``types`` and ``encoders`` hold still."""

    resolution: str = "med"
    noisy: bool = False


class Encoders(msgspec.Struct, frozen=True):
    """Observation types of the subset ``encoders``, and the encoders there, each with its settings."""

    types: tuple[str, ...] = ()
    arms: tuple[dict[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for arm in self.arms:
            if "encoder" not in arm:
                raise UsageError(f"An arm of a sweep names no 'encoder': {brief(arm)}.")


class StudentSweep(msgspec.Struct, frozen=True, kw_only=True):
    """A file of students."""

    entries: tuple[SweepEntry, ...] = ()
    types: tuple[str, ...] = ()
    """Observation types, each at every placement of an entry."""
    extra_types: tuple[str, ...] = ()
    """Types beyond the published ones."""
    resolutions: tuple[str, ...] = ("med",)
    """Resolutions of the taxels, or probe files, in the subset ``all`` and in that of one type."""
    noisy: tuple[bool, ...] = (False,)
    """Without noise, with it, or both; in the same subsets."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds, every student once with each."""
    pinned: Pinned = Pinned()
    encoders: Encoders = Encoders()
    settings: dict[str, Any] = {}
    """Further fields of every student of all entries."""
    listed: tuple[dict[str, Any], ...] = msgspec.field(default=(), name="students")
    """Settings of every student of an entry and a seed, in place of the product."""
    variant: str = "default"
    """Configuration of the tasks."""
    teacher: str = "teachers/{task}-{hand}"
    """Folder of a teacher's run, with ``{task}`` and ``{hand}``."""

    def __post_init__(self) -> None:
        if not self.entries:
            raise UsageError("A sweep has no entries; each is a table [[entries]] with a task and a hand.")
        placed = [bool(entry.placements) for entry in self.entries]
        defaults = zip(self.__struct_fields__, self.__struct_defaults__, strict=True)
        idle = [name for name, default in defaults if name in _OF_PRODUCT and getattr(self, name) != default]
        if self.listed and (idle or any(placed)):
            fields = listing([*idle, *["placements"] * any(placed)])
            raise UsageError(f"A sweep that lists its students one by one has no {fields}; leave them out.")
        if not self.listed and not all(placed):
            raise UsageError("An entry of a sweep needs 'placements', unless the sweep lists its students.")
        # Every student is made once, so that no value is found wrong in the middle of a sweep.
        for subset in ("all",) if self.listed else SUBSETS:
            self.students(subset)

    def students(self, subset: str = "all") -> list[DistillConfig]:
        """Return every student of a subset: ``all``, ``types``, ``encoders`` or an observation type."""
        every = (*self.types, *self.extra_types)
        listed = {arm["observe"] for arm in self.listed if "observe" in arm}
        choices = ("all", *sorted(listed)) if self.listed else (*SUBSETS, *every)
        check_name("subset of the sweep", subset, choices)
        each = product(self.entries, self.seeds)
        students = [student for entry, seed in each for student in self._of_entry(entry, seed, subset, every)]
        if twice := repeats(student.name for student in students):
            raise UsageError(f"The sweep names the student {twice[0]!r} twice.")
        return students

    def _of_entry(self, entry: SweepEntry, seed: int, subset: str, every: Sequence[str]) -> list[DistillConfig]:
        common = {
            "task": entry.task, "hand": entry.hand, "variant": self.variant, "seed": seed,
            **self.settings, **entry.settings,
            "teacher": self.teacher.format(task=entry.task, hand=entry.hand),
        }  # fmt: skip
        if entry.iterations is not None:
            common["iterations"] = entry.iterations
        if self.listed:
            chosen = [arm for arm in self.listed if subset in ("all", arm.get("observe"))]
            return [DistillConfig.of({**common, **arm}) for arm in chosen]
        if subset == "encoders":
            pinned = {"resolution": self.pinned.resolution, "noisy": self.pinned.noisy}
            return [
                DistillConfig(
                    **common, **pinned, observe=kind, placement=placement, encoder=arm["encoder"],
                    encoder_settings={key: value for key, value in arm.items() if key != "encoder"},
                )
                for kind, placement, arm in product(self.encoders.types, entry.placements, self.encoders.arms)
            ]  # fmt: skip
        types = every if subset in SUBSETS else (subset,)
        pin = subset == "types"
        resolutions = (self.pinned.resolution,) if pin else self.resolutions
        noises = (self.pinned.noisy,) if pin else self.noisy
        return [
            DistillConfig(**{name: value for name, value in common.items() if name not in FELT}, observe="none"),
            *(
                DistillConfig(**common, observe=kind, placement=placement, resolution=resolution, noisy=noisy)
                for kind, placement, resolution, noisy in product(types, entry.placements, resolutions, noises)
            ),
        ]

    def count(self, subset: str = "all") -> dict[str, Any]:
        """Return how many students there are: in all, without the extra types, and per entry."""
        students = self.students(subset)
        published = [student for student in students if student.observe not in self.extra_types]
        entries = Counter(f"{student.task} {student.hand}" for student in students)
        types = Counter(student.observe for student in students)
        return {"students": len(students), "published": len(published), "entries": entries, "types": types}


def read_sweep(path: str | Path = PUBLISHED) -> StudentSweep:
    """Read a sweep: a file, or one that ships, by its name without ending."""
    shipped = PUBLISHED.parent / f"{path}.toml"
    path = shipped if not Path(path).exists() and shipped.is_file() else path
    names = ", ".join(sorted(one.stem for one in PUBLISHED.parent.glob("*.toml")))
    document = read_toml(path, f"sweep (shipped: {names})")
    with readable(path, "sweep of students"):
        return read_table(StudentSweep, document, f"the sweep {Path(path).name!r}")
