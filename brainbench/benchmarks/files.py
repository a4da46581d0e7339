"""Files of benchmarks: found by path or name, packed into one ``.zip``, unpacked within bounds, every byte compared.

A ``.zip`` holds ``benchmark.toml`` and the files that it lists, nothing else. It is unpacked into the cache, where each
file is compared with its hash again whenever it is used.
"""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path

from brainbench.benchmarks.definition import Benchmark
from brainbench.core.errors import (
    BrainbenchError,
    DataError,
    UsageError,
    brief,
    listing,
    nearest,
    repeats,
    unknown_name,
)
from brainbench.core.files import atomic_path, cache_dir, file_hash, settings_dir
from brainbench.core.plugins import load_entry_points
from brainbench.core.reading.archives import check_archive
from brainbench.core.reading.regular import check_file, readable
from brainbench.core.reading.texts import parse_toml, read_text

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
