"""A benchmark as its file states it, found by path or name, packed into one ``.zip``, every byte compared.

The file is TOML. What :class:`Benchmark` calls ``options`` are fields of
:class:`~brainbench.scoring.options.ScoreOptions`, by the names and with the defaults of ``brainbench score``.
A ``.zip`` holds ``benchmark.toml`` and the files that it lists, nothing else. It is unpacked into the cache,
where each file is compared with its hash again whenever it is used.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import re
import shutil
import stat
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from brainbench.core.errors import (
    BrainbenchError,
    DataError,
    UsageError,
    brief,
    check_each,
    listing,
    nearest,
    repeats,
    unknown_name,
    visible,
)
from brainbench.core.files import atomic_path, cache_dir, content_hash, file_hash, settings_dir, to_plain
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.plugins import load_entry_points
from brainbench.core.reading.archives import check_archive
from brainbench.core.reading.regular import check_file, readable
from brainbench.core.reading.texts import parse_toml, read_text
from brainbench.core.reading.values import typed_values
from leaderboards.held_out import Commitment

OPTIONS = (
    "title", "stimuli", "conditions", "select", "window", "bin", "time", "whiskers", "fidelity", "metric", "estimator",
    "units_reliability", "seed",
)  # fmt: skip
"""Options of a score that are the benchmark's; all others are the model's, or say where and how to work."""
SCHEMA = 1
Words = Annotated[str, Limit(longest=2_000)]
Place = Annotated[str, Limit(shortest=1, longest=400)]
Digest = Annotated[str, Limit(shortest=64, longest=64)]
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")


@dataclass(frozen=True)
@limited(of="{} of the recordings of a benchmark")
class Recordings:
    """Recordings of a benchmark, and where they come from."""

    path: Place
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


ENTRY_POINTS = "brainbench.benchmarks"
"""Group by which a package brings benchmarks: the name, and what is the path of a ``.toml`` or ``.zip``."""
DEFINITION = "benchmark.toml"
MOST_DEFINITION = 4 << 20
"""Bytes of a definition."""
ENDINGS = (".toml", ".zip")


def added_folder() -> Path:
    """Return the folder of the benchmarks that the user added."""
    return settings_dir() / "benchmarks"


def list_benchmarks() -> dict[str, Path]:
    """Return the files of the benchmarks that have a name: those of packages, and those that the user added."""
    files: dict[str, Path] = {}
    load_entry_points(ENTRY_POINTS, lambda name, path: files.update({name: Path(path)}))
    return files | {path.stem: path for path in sorted(added_folder().glob("*.zip"))}


def open_benchmark(source: str | os.PathLike[str]) -> tuple[Benchmark, Path]:
    """Return a benchmark, by its file or its name, and the folder of its files, all of which are as it states.

    Raises:
        DataFileNotFoundError: it, or one of its files, is not there.
    """
    path = Path(source)
    if path.suffix.lower() not in ENDINGS:
        names = list_benchmarks()
        if path.is_file() or str(source) not in names:
            hint = "Or give a file that ends in .toml or .zip; brainbench benchmark make writes one."
            raise unknown_name("benchmark", os.fspath(source), names, hint=hint)
        path = names[str(source)]
    if path.suffix.lower() == ".zip":
        return _unpacked(check_file(path, "benchmark"))
    name = os.fspath(path)
    text = read_text(path, "benchmark", most=MOST_DEFINITION)
    benchmark = Benchmark.stated_by(parse_toml(text, name), f"The benchmark {brief(name)}", sealed=False)
    folder = path.expanduser().absolute().parent
    for file in benchmark.files:
        _compare(benchmark, folder, file)
    return benchmark, folder


def pack(source: str | os.PathLike[str], out: Path) -> Benchmark:
    """Write a benchmark and its files into one ``.zip``, whose bytes follow from theirs alone."""
    benchmark, folder = open_benchmark(source)
    with atomic_path(out) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        archive.writestr(_entry(DEFINITION), benchmark.to_toml())
        for name in sorted(benchmark.files):
            with (folder / name).open("rb") as file, archive.open(_entry(name), "w", force_zip64=True) as stream:
                shutil.copyfileobj(file, stream, 1 << 20)
    return benchmark


def _entry(name: str) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name)  # its fixed date of 1980 keeps the bytes equal
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def _unpacked(path: Path) -> tuple[Benchmark, Path]:
    where = f"The benchmark {brief(os.fspath(path))}"
    with readable(path, "benchmark (.zip)"), zipfile.ZipFile(path) as archive:
        check_archive(archive, path, "benchmark")
        benchmark = _definition(archive, where)
        folder = cache_dir("benchmarks", _hash(path)[:32])  # another archive is unpacked, and so compared, itself
        for name, digest in benchmark.files.items():
            target = folder / name
            if target.is_file() and not target.is_symlink() and _hash(target) == digest:
                continue
            with atomic_path(target) as temporary:
                hashed = _extract(archive, name, temporary)
                if hashed != digest:
                    raise DataError(_changed(benchmark, name, digest, hashed))
        return benchmark, folder


def _definition(archive: zipfile.ZipFile, where: str) -> Benchmark:
    """Return the definition in an archive, whose members are the files that it lists and no others."""
    members = {entry.filename: entry for entry in archive.infolist()}
    if twice := repeats(entry.filename for entry in archive.infolist()):
        raise DataError(f"{where} holds {listing(twice, limit=3)} twice; pack it again.")
    if links := [name for name, entry in members.items() if stat.S_ISLNK(entry.external_attr >> 16)]:
        raise DataError(f"{where} holds a link, {brief(links[0])}; it holds files alone: pack it again.")
    if DEFINITION not in members:
        guess = next((name for name in members if name.endswith(DEFINITION)), None) or nearest(DEFINITION, members)
        near = f"; its {brief(guess)} stands elsewhere or is called otherwise" if guess else ""
        raise DataError(f"{where} holds no {DEFINITION!r}{near}: make one with brainbench benchmark pack.")
    if (size := members[DEFINITION].file_size) > MOST_DEFINITION:
        raise DataError(f"{where} states {size:,} bytes of {DEFINITION}; at most {MOST_DEFINITION:,} are read.")
    data = parse_toml(archive.read(DEFINITION).decode(), f"{DEFINITION} in {where[4:]}")
    benchmark = Benchmark.stated_by(data, where, sealed=True)
    if lacking := sorted({*benchmark.files} - {*members}):
        guess = nearest(lacking[0], {*members} - {*benchmark.files})
        near = f"; it holds {brief(guess)} instead" if guess else ""
        raise DataError(f"{where} lacks {listing(lacking, limit=3)}, which it lists{near}: get it again.")
    if more := sorted({*members} - {*benchmark.files} - {DEFINITION}):
        raise DataError(f"{where} holds {listing(more, limit=3)}, which it does not list; pack it again.")
    return benchmark


def _extract(archive: zipfile.ZipFile, name: str, target: Path) -> str:
    """Write a member of an archive, never more than it declares, and return its hash."""
    digest = hashlib.sha256()
    with archive.open(name) as stream, target.open("wb") as file:
        while block := stream.read(1 << 20):
            digest.update(block)
            file.write(block)
    return digest.hexdigest()


def _compare(benchmark: Benchmark, folder: Path, name: str) -> None:
    """Refuse a file beside a definition that is missing, lies elsewhere, or is not the one that is listed."""
    place, digest = folder / name, benchmark.files[name]
    if not place.resolve().is_relative_to(folder.resolve()):
        raise DataError(f"{brief(str(place))} is a link out of the folder of the benchmark; copy the file there.")
    origin = benchmark.recordings
    try:
        check_file(place, f"file of the benchmark {benchmark.name!r}")
    except BrainbenchError as error:
        where = ", ".join(filter(None, (origin.source, origin.doi)))
        raise type(error)(f"{error} Get it{f' from {where}' if where else ''}, or score on the .zip.") from error
    if (hashed := _hash(place)) != digest:
        raise DataError(_changed(benchmark, name, digest, hashed))


def _hash(path: Path) -> str:
    state = path.stat()
    return _digest(path, state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino)


@functools.lru_cache(maxsize=4096)
def _digest(path: Path, *state: int) -> str:
    """Hash a file once for each state of it: a batch opens a benchmark for every model."""
    del state
    return file_hash(path, length=64)


def _changed(benchmark: Benchmark, name: str, stated: str, hashed: str) -> str:
    return (
        f"{brief(name)} is not the file that the benchmark {benchmark.name!r} lists (SHA-256 {stated[:12]}…, here "
        f"{hashed[:12]}…): it was changed or damaged; get the original, or make the benchmark again."
    )


def add(source: str | os.PathLike[str]) -> tuple[Benchmark, Path]:
    """Keep a benchmark with its files in the user's settings, by its name, and return it with its place there."""
    benchmark, _ = open_benchmark(source)
    target = added_folder() / f"{benchmark.name}.zip"
    present = list_benchmarks().get(benchmark.name)
    if present is not None and (there := open_benchmark(present)[0]).identity != benchmark.identity:
        raise UsageError(
            f"There is already a benchmark {benchmark.name!r} ({there.identity}, {brief(str(present))}); remove that "
            "file first, or make yours under another --name."
        )
    pack(source, target)
    return benchmark, target


def files_named_in(scene: Path, texts: object) -> Iterator[Path]:
    """Yield the files that the values of a scene file name, of which ``{trial}`` is any text."""
    if isinstance(texts, dict | list):
        for inner in texts.values() if isinstance(texts, dict) else texts:
            yield from files_named_in(scene, inner)
    elif isinstance(texts, str) and texts.strip():
        before, trials, after = texts.partition("{trial}")
        if trials:
            yield from sorted(scene.parent.glob(f"{before}*{after}"))
        elif len(texts) < 400 and "\0" not in texts and (scene.parent / texts).is_file():
            yield scene.parent / texts
