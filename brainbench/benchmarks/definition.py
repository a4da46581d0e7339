"""A benchmark as its file states it: recordings, stimuli, and everything by which a score on them is made.

The file is TOML. What :class:`Benchmark` calls ``options`` are fields of
:class:`~brainbench.scoring.options.ScoreOptions`, by the names and with the defaults of ``brainbench score``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

from brainbench.core.errors import BrainbenchError, DataError, UsageError, brief, check_each, visible
from brainbench.core.files import content_hash, to_plain
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.reading.values import typed_values
from leaderboards.held_out import Commitment

OPTIONS = (
    "title", "stimuli", "conditions", "select", "window", "bin", "time", "whiskers", "fidelity", "metric", "estimator",
    "units_reliability", "seed",
)  # fmt: skip
"""Options of a score that are the benchmark's; all others are the model's, or say where and how to work."""
SCHEMA = 1
Words = Annotated[str, Limit(longest=2_000)]
Path = Annotated[str, Limit(shortest=1, longest=400)]
Digest = Annotated[str, Limit(shortest=64, longest=64)]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")


@dataclass(frozen=True)
@limited(of="{} of the recordings of a benchmark")
class Recordings:
    """Recordings of a benchmark, and where they come from."""

    path: Path
    """As ``brainbench score`` takes them, from the folder of the benchmark: a file, a folder, a glob, LAYOUT:PATH, or
    a demo."""
    content_hash: Annotated[str, Limit(shortest=8, longest=64)]
    """Hash of what is read of them."""
    source: Words = ""
    """Archive or address where they are published."""
    doi: Words = ""
    version: Words = ""
    """Version of the data set at its source."""
    licence: Words = ""


@dataclass(frozen=True)
@limited(of="{} of the ceiling of a benchmark")
class Ceilings:
    """What the recordings allow: numbers that do not depend on a model."""

    animals: Count
    stimuli: Count
    reliability: float | None = None
    """Mean over animals."""
    animal_to_animal: float | None = None
    """Score of the animals against one another."""
    lower: float | None = None
    """Noise ceiling of the raw comparison: each animal against the mean of the others."""
    upper: float | None = None
    """Each animal against the mean of all."""


@dataclass(frozen=True)
@limited(of="{} of a benchmark", unresolved=("held_out",))
class Benchmark:
    """Everything that a score needs but the model."""

    name: Words
    recordings: Recordings
    options: Mapping[str, str | bool | int | float] = field(default_factory=dict)
    """:data:`OPTIONS` of a score that are not their defaults."""
    match: Mapping[str, str] = field(default_factory=dict)
    """Label of the recordings → label of the stimuli, empty for one that is dropped; equal labels need none."""
    files: Mapping[str, Digest] = field(default_factory=dict)
    """File, from the folder of the benchmark → its SHA-256."""
    ceiling: Ceilings | None = None
    held_out: Commitment | None = None
    """Published hash of what is held back."""
    citation: Words = ""
    contact: Words = ""
    schema: Literal[1] = SCHEMA

    def __post_init__(self) -> None:
        """Refuse names that could be paths, and options that are not a benchmark's."""
        if not _NAME.fullmatch(self.name):
            raise UsageError(
                "The name of a benchmark has letters, digits, '.', '_' and '-', 80 at most; received "
                f"{brief(self.name)}."
            )
        check_each("option of a benchmark", self.options, OPTIONS)
        for name in self.files:
            check_inside(name)
        check_inside(self.recordings.path.rpartition(":")[2])

    @property
    def identity(self) -> str:
        """Hash of all that is stated."""
        return content_hash(self.plain)

    @property
    def plain(self) -> dict[str, Any]:
        """All that is stated, as files hold it."""
        held_out = None if self.held_out is None else self.held_out.plain
        return {**to_plain(replace(self, held_out=None)), "held_out": held_out}

    @property
    def stated(self) -> dict[str, str]:
        """What the record of a score on it says of it."""
        origin = {name: getattr(self.recordings, name) for name in ("source", "doi", "version", "licence")}
        texts = {"name": self.name, "hash": self.identity, "citation": self.citation, "contact": self.contact, **origin}
        return {name: text for name, text in texts.items() if text}

    def to_toml(self) -> str:
        """Return the content of its file, with its hash."""
        return "\n".join(_toml({"hash": self.identity, **self.plain})).strip() + "\n"

    @classmethod
    def stated_by(cls, data: Mapping[str, Any], where: str, *, sealed: bool) -> Benchmark:
        """Return the benchmark of a parsed file; ``sealed`` ones must state the hash that they have."""
        try:
            for place, kind in (("", cls), ("recordings", Recordings), ("ceiling", Ceilings)):
                table = data.get(place, {}) if place else data
                if isinstance(table, Mapping):
                    names = [item.name for item in fields(kind)]
                    check_each(f"entry of {place or 'a benchmark'}", table, names if place else [*names, "hash"])
            benchmark = typed_values(cls, data, where, choices={"kind": ("animals", "stimuli"), "schema": (SCHEMA,)})
        except BrainbenchError as error:
            cause = error.__cause__ and error.__cause__.__cause__  # what a class itself refuses says all
            words = str(cause if isinstance(cause, UsageError) else error)
            raise DataError(words if words.startswith(where) else f"{where}: {words}") from error
        digest = data.get("hash")
        if digest != benchmark.identity and (sealed or digest is not None):
            raise DataError(
                f"{where} was edited: it states the hash {brief(digest)} and has {benchmark.identity!r}; take out the "
                "line 'hash' if the change is yours (of a .zip, pack the .toml again), else get the original."
            )
        return benchmark


def check_inside(name: str) -> None:
    """Raise a :class:`UsageError` unless a name of a file stays in the folder of the benchmark, on every system."""
    parts = name.split("/")
    if {"", ".", ".."} & {*parts} or re.search(r'[\\:"|<>]', name) or visible(name) != name:
        raise UsageError(
            f"A benchmark names {brief(name)}, which is no place in its own folder; its files lie there, and are named "
            f"from there, such as {brief(parts[-1].strip('.') or 'data')}."
        )


def _toml(values: Mapping[str, Any], place: str = "") -> Iterator[str]:
    """Yield the lines of a table, what it states itself before its inner tables; nothing is written for None."""
    inner = {name: value for name, value in values.items() if isinstance(value, Mapping) and value}
    for name, value in values.items():
        if not isinstance(value, Mapping) and value is not None:
            yield f"{_key(name)} = {json.dumps(value, ensure_ascii=False)}"
    for name, table in inner.items():
        yield f"\n[{place}{_key(name)}]"
        yield from _toml(table, f"{place}{_key(name)}.")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
