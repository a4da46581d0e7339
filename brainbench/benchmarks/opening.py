"""Benchmarks and scores: one made of a score's options, checked, and opened in their place."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from brainbench.benchmarks.files import OPTIONS, Benchmark, Ceilings, Recordings, files_named_in, open_benchmark
from brainbench.core.contracts import read_match
from brainbench.core.errors import DataError, UsageError, brief, listing, unknown_name
from brainbench.core.files import file_hash, to_plain
from brainbench.core.progress import Progress
from brainbench.core.provenance import Provenance
from brainbench.core.reading.texts import read_toml
from brainbench.core.records import ResultRecord
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

TOLERANCE = 1e-3
"""Numbers of a ceiling agree within this on every machine."""
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
    if colon and layout not in list_layouts():
        raise unknown_name("recording layout of a benchmark", layout, list_layouts())
    recordings = path if path in DEMOS else f"{layout}{colon}{folder / path}"
    if path not in DEMOS:
        _check_listed(benchmark, folder, path, find_files(folder / path))
    if (stimuli := stated.get("stimuli")) is not None and not is_recipe(str(stimuli)):
        if stimuli not in benchmark.files:
            raise unknown_name("stimuli of a benchmark", stimuli, [*benchmark.files, *list_recipes()])
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

    ``origin`` are entries of :class:`~brainbench.benchmarks.files.Recordings`.
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
    place = path.expanduser().absolute()
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
    paired = tuple(brain.pairs(labels, options.match))
    digest = recordings_hash(brain) or ""
    if brain.published and options.estimator != "default":
        return digest, None
    animals = brain.animals(paired, metric, options)
    score = metric.score_animals(animals, stimuli=paired, estimator=options.estimator, seed=options.seed)
    lower, upper = (score.ceiling.lower, score.ceiling.upper) if score.ceiling else (math.nan, math.nan)
    numbers = (score.reliability, score.value, lower, upper)
    return digest, Ceilings(len(animals), len(paired), *(x if math.isfinite(x) else None for x in numbers))


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a benchmark, or that it lacks."""

    severity: str
    """``error`` or ``note``."""
    what: str


def check(source: str, progress: Progress | None = None) -> tuple[Benchmark, list[Fault]]:
    """Return a benchmark whose every file is as it states, and what is wrong with or missing in what else it states."""
    benchmark, folder = open_benchmark(source)
    digest, ceiling = _measure(options_of(benchmark, folder), progress)
    return benchmark, [*_findings(benchmark, digest, ceiling)]


def _findings(benchmark: Benchmark, digest: str, ceiling: Ceilings | None) -> Iterator[Fault]:
    if digest != (stated := benchmark.recordings.content_hash):
        yield Fault("error", f"what is read of the recordings has the hash {digest}, and {stated} is stated")
    for name, number in vars(ceiling).items() if ceiling and benchmark.ceiling else ():
        before = getattr(benchmark.ceiling, name)
        if (number is None) != (before is None) or abs((number or 0) - (before or 0)) > TOLERANCE:
            yield Fault("error", f"{name} of the ceiling is {number} here, and {before} is stated")
    if (held := benchmark.held_out) is not None and held.recordings == stated:
        yield Fault("error", "what is held back is of these very recordings: give the public part of them")
    for name, what in ADVISED.items():
        table, _, entry = name.rpartition(".")
        if not getattr(getattr(benchmark, table) if table else benchmark, entry):
            yield Fault("note", f"{name} is empty: {what}")
