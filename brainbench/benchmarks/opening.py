"""A benchmark handed to a score: its options in place of the caller's, and what the record says of it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from brainbench.benchmarks.definition import OPTIONS, Benchmark
from brainbench.benchmarks.files import open_benchmark
from brainbench.core.errors import DataError, UsageError, brief, listing, unknown_name
from brainbench.core.provenance import Provenance
from brainbench.core.records import ResultRecord
from brainbench.datasets.layouts.registry import list_layouts
from brainbench.datasets.reading import find_files
from brainbench.metrics import get_metric
from brainbench.scoring.demo import DEMOS
from brainbench.scoring.neural_responses import NeuralResponses, short_name
from brainbench.scoring.options import ScoreOptions
from brainbench.stimuli.scenes.recipes import is_recipe, list_recipes


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
        folder = json.dumps(f"{self.folder}{os.sep}", ensure_ascii=False)[1:-1]
        text = record.to_json()
        return ResultRecord.from_json(text.replace(folder, "")) if folder in text else record


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
        if wanted != value and (wanted != getattr(defaults, name) or name in explicit):
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
        _check_listed(benchmark, folder, path)
    if (stimuli := stated.get("stimuli")) is not None and not is_recipe(str(stimuli)):
        if stimuli not in benchmark.files:
            raise unknown_name("stimuli of a benchmark", stimuli, [*benchmark.files, *list_recipes()])
        stated["stimuli"] = str(folder / str(stimuli))
    metric = str(stated.get("metric", "rsa"))
    if ":" in metric:
        raise UsageError(f"A benchmark brings no code, and its metric is {brief(metric)}; name one that is installed.")
    get_metric(metric)
    match = {label: partner or None for label, partner in benchmark.match.items()}
    return ScoreOptions.of({**stated, "recordings": recordings, "match": match or None})


def _check_listed(benchmark: Benchmark, folder: Path, path: str) -> None:
    """Refuse recordings that the benchmark does not list: a file that was put beside the others."""
    listed = {(folder / name).resolve() for name in benchmark.files}
    if more := [file.name for file in find_files(folder / path) if file.resolve() not in listed]:
        raise DataError(
            f"{brief(path)} holds {listing(more, limit=3)}, which the benchmark {benchmark.name!r} does not list; take "
            "it away, or make the benchmark again."
        )
