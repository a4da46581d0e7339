"""Benchmarks and scores: one made of a score's options, checked, and opened in their place."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import shutil
import unicodedata
import zipfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal

from brainbench.core.contracts import read_match
from brainbench.core.errors import (
    BrainbenchError,
    DataError,
    UsageError,
    brief,
    check_each,
    check_name,
    listing,
    nearest,
    unknown_name,
    visible,
)
from brainbench.core.files import atomic_path, cache_dir, content_hash, file_hash, settings_dir, state_hash, to_plain
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.plugins import load_entry_points
from brainbench.core.progress import Progress
from brainbench.core.provenance import Provenance
from brainbench.core.reading.regular import check_file, readable, user_path
from brainbench.core.reading.tensors import check_archive
from brainbench.core.reading.texts import parse_toml, read_text, read_toml
from brainbench.core.reading.values import typed_values
from brainbench.core.records import ResultRecord
from brainbench.datasets.checks.findings import Finding
from brainbench.datasets.layouts.registry import list_layouts
from brainbench.datasets.reading import find_files, find_recordings
from brainbench.metrics import get_metric
from brainbench.scoring.demo import DEMOS
from brainbench.scoring.model_responses import DEFAULT_STIMULI
from brainbench.scoring.neural_responses import NeuralResponses, open_neural_responses, short_name
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.scores import metric_of
from brainbench.stimuli import load_stimuli
from brainbench.stimuli.scenes.recipes import is_recipe, list_recipes
from brainbench.stimuli.sources import known_labels
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
_DEVICE = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\.|$)", re.IGNORECASE)  # of Windows, in every folder
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")


@limited(of="{} of the recordings of a benchmark")
class Recordings:
    """Recordings of a benchmark, and where they come from."""

    path: Place
    """As ``brainbench score`` takes them, from the folder of the benchmark: a file, a folder, a glob, LAYOUT:PATH, or
    a demo."""
    content_hash: Annotated[str, Limit(shortest=8, longest=64)]
    """Hash of what is read of them."""
    source: Words = ""
    """Archive or address where the recordings are published."""
    doi: Words = ""
    """DOI of the recordings."""
    version: Words = ""
    """Version of the recordings at their source."""
    licence: Words = ""
    """Licence of the recordings."""


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
    """Work to cite, with its DOI."""
    contact: Words = ""
    """Whom to ask."""
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
        forms = [unicodedata.normalize("NFC", name).casefold() for name in (DEFINITION, *self.files)]
        counts, folders = Counter(forms), {str(folder) for form in forms for folder in PurePosixPath(form).parents}
        if wrong := [
            name for name, form in zip(self.files, forms[1:], strict=True) if counts[form] > 1 or form in folders
        ]:
            raise UsageError(
                f"A benchmark lists {listing(wrong, limit=3)}, which is one with another of its files, or a folder of "
                "them, on systems that do not tell capitals and forms of letters apart; rename one."
            )
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
    wrong = any(part[-1:] in (*". ", "") or len(part.encode()) > 240 or _DEVICE.match(part) for part in parts)
    if wrong or re.search(r'[\\:"|<>]', name) or visible(name) != name:
        near = re.sub(r"[^\w.-]+", "", parts[-1]).strip(".")[:60] or "data"
        raise UsageError(
            f"A benchmark names {brief(name)}, which is no place in its own folder; its files lie there, and are named "
            f"from there, such as {brief(f'file-{near}' if _DEVICE.match(near) else near)}."
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
MOST_DEFINITION = 4 << 20  # bytes of a definition
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
    """Return a benchmark, by its file or its name, and the folder of its files, all of which are as it states."""
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
    folder = user_path(path).absolute().parent
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
        folder = cache_dir("benchmarks", state_hash(path)[:32])  # another archive is unpacked, and so compared, itself
        for name, digest in benchmark.files.items():
            target = folder / name
            if target.is_file() and not target.is_symlink() and state_hash(target) == digest:
                continue
            with atomic_path(target) as temporary:
                hashed = _extract(archive, name, temporary)
                if hashed != digest:
                    raise DataError(_changed(benchmark, name, digest, hashed))
        return benchmark, folder


def _definition(archive: zipfile.ZipFile, where: str) -> Benchmark:
    """Return the definition in an archive, whose members are the files that it lists and no others."""
    members = {entry.filename: entry for entry in archive.infolist()}
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
    if (hashed := state_hash(place)) != digest:
        raise DataError(_changed(benchmark, name, digest, hashed))


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


TOLERANCE = 1e-3  # numbers of a ceiling agree within this on every machine
ADVISED = {
    "citation": "the work to cite", "contact": "whom to ask", "recordings.source": "where the recordings are published",
    "recordings.doi": "their DOI", "recordings.licence": "what others may do with them",
}  # fmt: skip
"""Entries that a benchmark can do without and others will miss."""


@dataclass(frozen=True)
class OpenBenchmark:
    """A benchmark whose files are there and are as it states."""

    benchmark: Benchmark
    folder: Path
    options: ScoreOptions
    """Those of the score: the benchmark's, and of the caller's what is the model's."""

    @property
    def stated(self) -> dict[str, str]:
        """Entry of a record's provenance."""
        return self.benchmark.stated

    def checked(self, brain: NeuralResponses) -> NeuralResponses:
        """Return the recordings under the name that they have in the benchmark, if they are what it states."""
        brain = replace(brain, source=short_name(self.benchmark.recordings.path))
        if (hashed := recordings_hash(brain)) != self.benchmark.recordings.content_hash:
            raise DataError(
                f"What is read of the recordings has the hash {hashed}, and the benchmark {self.benchmark.name!r} "
                f"states {self.benchmark.recordings.content_hash}: it was made by another version, or a layout has "
                "changed since; make it again."
            )
        return brain

    def portable(self, record: ResultRecord) -> ResultRecord:
        """Return a record that names the files from the folder of the benchmark, as on every machine."""
        return ResultRecord.from_json(_renamed(to_plain(record), f"{self.folder}{os.sep}"))


def _renamed(value: Any, folder: str) -> Any:
    """Return plain values whose texts, but for the command, do not hold a folder."""
    if isinstance(value, dict):
        return {name: inner if name == "command" else _renamed(inner, folder) for name, inner in value.items()}
    if isinstance(value, list):
        return [_renamed(inner, folder) for inner in value]
    return value.replace(folder, "") if isinstance(value, str) else value


def recordings_hash(brain: NeuralResponses) -> str | None:
    """Return the hash of opened recordings that a record states."""
    return Provenance.of({"recordings": brain.origin}).recordings_hash


def open_for_score(given: ScoreOptions, explicit: Iterable[str] = ()) -> OpenBenchmark:
    """Open the benchmark that options name and put its options in place of the caller's.

    Options that are ``explicit``, or not the defaults, and say something else than the benchmark are refused.
    """
    benchmark, folder = open_benchmark(str(given.benchmark))
    options = options_of(benchmark, folder)
    defaults = ScoreOptions()
    for name in ("recordings", "match", *OPTIONS):
        wanted, value = getattr(given, name), getattr(options, name)
        same = wanted is None or not (wanted != value and wanted != benchmark.options.get(name, value))
        if not same and (wanted != getattr(defaults, name) or name in explicit):
            stated = benchmark.recordings.path if name == "recordings" else "pairs" if name == "match" else value
            raise UsageError(
                f"{name} is a matter of the benchmark {benchmark.name!r}, which states {brief(stated)}; received "
                f"{brief(wanted)}: leave it out, or score without a benchmark."
            )
    names = {option.name for option in fields(given)} - {"recordings", "match", "benchmark", *OPTIONS}
    return OpenBenchmark(benchmark, folder, replace(options, **{name: getattr(given, name) for name in names}))


def options_of(benchmark: Benchmark, folder: Path) -> ScoreOptions:
    """Return the options that a benchmark states, with its files where they are."""
    stated: dict[str, Any] = dict(benchmark.options)
    layout, colon, path = benchmark.recordings.path.rpartition(":")
    if colon:
        check_name("recording layout of a benchmark", layout, list_layouts())
    recordings = path if path in DEMOS else f"{layout}{colon}{folder / path}"
    if path not in DEMOS:
        _check_listed(benchmark, folder, path, find_files(folder / path))
    if (stimuli := stated.get("stimuli")) is not None and not is_recipe(str(stimuli)):
        check_name("stimuli of a benchmark", stimuli, [*benchmark.files, *list_recipes()])
        scene = folder / str(stimuli)
        if scene.suffix == ".toml":
            _check_listed(benchmark, folder, str(stimuli), files_named_in(scene, read_toml(scene)))
        stated["stimuli"] = str(scene)
    metric = str(stated.get("metric", "rsa"))
    if ":" in metric:
        raise UsageError(f"A benchmark brings no code, and its metric is {brief(metric)}; name one that is installed.")
    get_metric(metric)
    match = {label: partner or None for label, partner in benchmark.match.items()}
    return ScoreOptions.of({**stated, "recordings": recordings, "match": match or None})


def _check_listed(benchmark: Benchmark, folder: Path, path: str, files: Iterable[Path]) -> None:
    """Refuse files of recordings or of a scene that the benchmark does not list: added, or elsewhere."""
    listed = {(folder / name).resolve() for name in benchmark.files}
    if more := [file.name for file in files if file.resolve() not in listed]:
        raise DataError(
            f"{brief(path)} holds or names {listing(more, limit=3)}, which the benchmark {benchmark.name!r} does not "
            "list; take it away, or make the benchmark again."
        )


def make(
    options: ScoreOptions,
    out: Path,
    *,
    name: str,
    held_out: Path | None = None,
    citation: str = "",
    contact: str = "",
    progress: Progress | None = None,
    **origin: str,
) -> Benchmark:
    """Return the benchmark of a score's options, for a file at ``out`` beside or above the files that it needs.

    ``origin`` are entries of :class:`~brainbench.benchmarks.opening.Recordings`.
    """
    folder, source = out.absolute().parent, str(options.recordings)
    defaults = ScoreOptions()
    stated = {
        entry: getattr(options, entry) for entry in OPTIONS if getattr(options, entry) != getattr(defaults, entry)
    }
    files: list[Path] = []
    if source not in DEMOS:
        layout, paths = find_recordings(source)
        prefix = f"{layout.name}:" if layout is not None else ""
        if prefix and not source.startswith(prefix):
            raise UsageError(f"A benchmark brings no code, and {brief(source)} reads by a file of Python; register it.")
        files += paths
        source = prefix + _inside(Path(source.removeprefix(prefix)), folder)
    if (stimuli := options.stimuli) is not None and not is_recipe(str(stimuli)):
        scene = Path(str(stimuli))
        files += [scene, *(files_named_in(scene, read_toml(scene)) if scene.suffix == ".toml" else ())]
        stated["stimuli"] = _inside(scene, folder)
    pairs = (
        options.match if options.match is None or isinstance(options.match, dict) else read_match(str(options.match))
    )
    digest, ceiling = _measure(options, progress)
    return Benchmark(
        name=name,
        recordings=Recordings(source, digest, **origin),
        options={
            entry: value if isinstance(value, bool | int | float) else str(value) for entry, value in stated.items()
        },
        match={label: partner or "" for label, partner in (pairs or {}).items()},
        files={_inside(path, folder): file_hash(path, length=64) for path in dict.fromkeys(files)},
        ceiling=ceiling,
        held_out=None if held_out is None else Commitment.read(held_out),
        citation=citation,
        contact=contact,
    )


def _inside(path: Path, folder: Path) -> str:
    """Return the name of a file from the folder of the benchmark."""
    place = user_path(path).absolute()
    if not place.is_relative_to(folder):
        raise UsageError(
            f"{brief(str(path))} lies outside the folder {brief(str(folder))} of --out, where a benchmark has its "
            "files; write it above them, or copy them there."
        )
    return place.relative_to(folder).as_posix()


def _measure(options: ScoreOptions, progress: Progress | None) -> tuple[str, Ceilings | None]:
    """Return the hash of what is read of the recordings, and what they allow; None where a published file is scored."""
    metric = metric_of(options)
    options = replace(options, metric=metric)
    brain = open_neural_responses(options.recordings, progress=progress, **options.selection)
    brain = replace(brain, title=options.title, covariates=metric.of_covariates)
    source: Any = options.stimuli or brain.stimuli or DEFAULT_STIMULI
    labels = known_labels(source)
    if labels is None:
        how: dict[str, Any] = {"whiskers": options.whiskers, "fidelity": options.fidelity, "progress": progress}
        labels = load_stimuli(source, **how).labels
    unnamed = source is DEFAULT_STIMULI and options.match is None and not brain.label_doubt
    if unnamed and not {*labels} & {*brain.vocabulary}:
        labels = brain.vocabulary  # nobody names stimuli: models are scored by features that were computed elsewhere
    paired = tuple(brain.pairs(labels, options.match))
    digest = recordings_hash(brain) or ""
    if brain.published and options.estimator != "default":
        return digest, None
    animals = brain.animals(paired, metric, options)
    score = metric.score_animals(animals, stimuli=paired, estimator=options.estimator, seed=options.seed)
    lower, upper = (score.ceiling.lower, score.ceiling.upper) if score.ceiling else (math.nan, math.nan)
    numbers = (score.reliability, score.value, lower, upper)
    return digest, Ceilings(len(animals), len(paired), *(x if math.isfinite(x) else None for x in numbers))


def check(source: str, progress: Progress | None = None) -> tuple[Benchmark, list[Finding]]:
    """Return a benchmark whose every file is as it states, and what is wrong with or missing in what else it states."""
    benchmark, folder = open_benchmark(source)
    digest, ceiling = _measure(options_of(benchmark, folder), progress)
    return benchmark, [*_findings(benchmark, digest, ceiling)]


def _findings(benchmark: Benchmark, digest: str, ceiling: Ceilings | None) -> Iterator[Finding]:
    if digest != (stated := benchmark.recordings.content_hash):
        yield Finding(
            "error", "recordings", f"what is read of the recordings has the hash {digest}, and {stated} is stated"
        )
    for name, number in vars(ceiling).items() if ceiling and benchmark.ceiling else ():
        before = getattr(benchmark.ceiling, name)
        if (number is None) != (before is None) or abs((number or 0) - (before or 0)) > TOLERANCE:
            yield Finding("error", "ceiling", f"{name} of the ceiling is {number} here, and {before} is stated")
    if (held := benchmark.held_out) is not None and held.recordings == stated:
        message = "what is held back is of these very recordings"
        yield Finding("error", "held out", message, "Give the public part of them.")
    for name, what in ADVISED.items():
        table, _, entry = name.rpartition(".")
        if not getattr(getattr(benchmark, table) if table else benchmark, entry):
            yield Finding("note", name, f"{name} is empty: {what}")
