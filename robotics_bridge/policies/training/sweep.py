"""A sweep of students as one TOML file: what it expands to, and how many that are.

Per entry (task, hand, placements) the baseline ``none`` and the product of observation types, placements, resolutions
and clean or noisy readings (thesis, table 4.10). Subsets: ``all``; ``types``, every type at the pinned resolution and
noise; ``encoders``, the arms of tactile encoders there; or one type's name, all its resolutions and noise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from brainbench.core.errors import UsageError, check_each, check_name, repeats, shown
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_toml
from robotics_bridge.hands.layouts import check_names
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.policies.training.distill_config import FELT, DistillConfig

PUBLISHED = Path(__file__).parents[1] / "sweeps" / "table-4.10.toml"
"""The sweep of the thesis."""
SUBSETS = ("all", "types", "encoders")
_KEYS = (
    "types", "extra_types", "resolutions", "noisy", "seeds", "variant", "teacher", "pinned", "encoders", "entries",
    "settings",
)  # fmt: skip
_ENTRY = ("task", "hand", "placements", "iterations", "settings")


@dataclass(frozen=True)
class SweepEntry:
    """A line of table 4.10."""

    task: str
    hand: str
    placements: tuple[str, ...]
    settings: Mapping[str, Any]
    """Further fields of every student, such as ``iterations``."""


@dataclass(frozen=True, kw_only=True)
class StudentSweep:
    """A file of students."""

    name: str
    entries: tuple[SweepEntry, ...]
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
    pinned_resolution: str
    """The one resolution of the subsets ``types`` and ``encoders``."""
    pinned_noisy: bool
    """Noise of the taxels in these."""
    encoder_types: tuple[str, ...]
    """Observation types of the subset ``encoders``."""
    arms: tuple[Mapping[str, Any], ...]
    """Encoder and its settings, for the subset ``encoders``."""
    variant: str = "default"
    """Configuration of the tasks."""
    teacher: str = "teachers/{task}-{hand}"
    """Folder of a teacher's run, with ``{task}`` and ``{hand}``."""

    def students(self, subset: str = "all") -> list[DistillConfig]:
        """Return every student of a subset: ``all``, ``types``, ``encoders`` or an observation type."""
        every = (*self.types, *self.extra_types)
        check_name("subset of the sweep", subset, (*SUBSETS, *every))
        each = product(self.entries, self.seeds)
        students = [student for entry, seed in each for student in self._of_entry(entry, seed, subset, every)]
        if twice := repeats(student.name for student in students):
            raise UsageError(f"The sweep {self.name!r} names the student {twice[0]!r} twice.")
        return students

    def _of_entry(self, entry: SweepEntry, seed: int, subset: str, every: Sequence[str]) -> list[DistillConfig]:
        common = {
            "task": entry.task, "hand": entry.hand, "variant": self.variant, "seed": seed, **entry.settings,
            "teacher": self.teacher.format(task=entry.task, hand=entry.hand),
        }  # fmt: skip
        if subset == "encoders":
            pinned = {"resolution": self.pinned_resolution, "noisy": self.pinned_noisy}
            return [
                DistillConfig(
                    **common, **pinned, observe=kind, placement=placement, encoder=arm["encoder"],
                    encoder_settings={key: value for key, value in arm.items() if key != "encoder"},
                )
                for kind, placement, arm in product(self.encoder_types, entry.placements, self.arms)
            ]  # fmt: skip
        types = every if subset in SUBSETS else (subset,)
        pin = subset == "types"
        resolutions = (self.pinned_resolution,) if pin else self.resolutions
        noises = (self.pinned_noisy,) if pin else self.noisy
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
    """Read a sweep.

    Raises:
        DataFileNotFoundError: there is no such file.
    """
    document = read_toml(path, f"sweep (the published one is {PUBLISHED.name})")
    with readable(path, "sweep of students"):
        return _sweep(Path(path), document)


def _sweep(path: Path, document: Mapping[str, Any]) -> StudentSweep:
    check_each("key of a sweep", document, _KEYS)
    entries = tuple(_entry(item, document.get("settings", {})) for item in document.get("entries", ()))
    if not entries:
        raise UsageError(f"The sweep {str(path)!r} has no entries; each is a table [[entries]] with a task and a hand.")
    pinned, encoders = document.get("pinned", {}), document.get("encoders", {})
    check_each("key of 'pinned'", pinned, ("resolution", "noisy"))
    check_each("key of 'encoders'", encoders, ("types", "arms"))
    lists = ("types", "extra_types", "resolutions", "noisy", "seeds")
    sweep = StudentSweep(
        name=path.stem, entries=entries, pinned_resolution=pinned.get("resolution", "med"),
        pinned_noisy=pinned.get("noisy", False), encoder_types=tuple(encoders.get("types", ())),
        arms=tuple(encoders.get("arms", ())),
        **{key: tuple(document[key]) for key in lists if key in document},
        **{key: document[key] for key in ("variant", "teacher") if key in document},
    )  # fmt: skip
    for kind in (*sweep.types, *sweep.extra_types, *sweep.encoder_types):
        observation_type(kind)
    for entry in entries:
        for placement, resolution in product(entry.placements, (*sweep.resolutions, sweep.pinned_resolution)):
            check_names(resolution, placement)
    for arm in sweep.arms:
        if "encoder" not in arm:
            raise UsageError(f"An arm of the sweep {path.name!r} names no 'encoder': {shown(dict(arm))}.")
    # Every student is made once, so that no value is found wrong in the middle of a sweep.
    for subset in SUBSETS:
        sweep.students(subset)
    return sweep


def _entry(table: Mapping[str, Any], settings: Mapping[str, Any]) -> SweepEntry:
    check_each("key of a sweep's entry", table, _ENTRY)
    for key in ("task", "hand", "placements"):
        if not table.get(key):
            raise UsageError(f"An entry of a sweep needs {key!r}; received {shown(dict(table))}.")
    combined = {**settings, **table.get("settings", {})}
    if "iterations" in table:
        combined["iterations"] = table["iterations"]
    return SweepEntry(table["task"], table["hand"], tuple(table["placements"]), combined)
