"""Scores to compute: from patterns and batch files to jobs, and the jobs whose score does not exist yet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from brainbench.core.contracts import BY_TRIAL
from brainbench.core.errors import DataError, UsageError, brief, unknown_name
from brainbench.core.files import to_plain
from brainbench.core.identity import ScoreIdentity
from brainbench.core.limits import Limit, Seed
from brainbench.core.provenance import Provenance
from brainbench.core.reading.texts import read_toml
from brainbench.core.reading.values import read_table
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord
from brainbench.scoring.model_responses import follows_seed
from brainbench.scoring.options import ScoreOptions

if TYPE_CHECKING:
    from brainbench.scoring.neural_responses import NeuralResponses
    from brainbench.stimuli import Stimuli

_OPENED_BY = ("stimuli", "conditions", "select", "window", "bin", "fidelity", "whiskers", "metric")
"""Settings by which recordings and stimuli are opened."""


@dataclass(frozen=True)
class ScoringJob:
    """One score to compute."""

    model: str
    options: ScoreOptions

    def run(self, command: str) -> ResultRecord:
        """Compute the score; ``command`` is the command line that makes it by itself."""
        from brainbench.scoring.scores import score_record

        return score_record(self.model, self.options, command=command)


def jobs_of(patterns: Sequence[str], seeds: Sequence[int] | None, options: Mapping[str, Any]) -> list[ScoringJob]:
    """Return the scores of the models that the patterns match, for each seed of untrained weights.

    Without ``seeds`` the options state one. Weights that follow no seed are scored once.
    """
    common = ScoreOptions.of(options)
    fixed = replace(common, weights_seed=None)
    by_seed = [
        replace(common, weights_seed=None if seed == common.seed else seed)
        for seed in ([common.model_seed] if seeds is None else dict.fromkeys(seeds))
    ]
    return [
        ScoringJob(name, seeded)
        for name in find_models(patterns)
        for seeded in (by_seed if follows_seed(name) else [fixed])
    ]


def find_models(patterns: Sequence[str]) -> list[str]:
    """Return the registry names and shipped trained models that the patterns match, in the order of the patterns.

    A name that is no pattern may also be a file or a folder, and is then taken as it is. A pattern without a dot
    means architectures, one with a dot trained models: ``*-small`` and ``*-small.*``.
    """
    from brainbench.models.recipes import Architecture, is_path
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped

    names = [*list_models(), *shipped()]
    matches: dict[str, None] = {}
    for pattern in patterns:
        if any(mark in pattern for mark in "*?["):
            some = list_models() if Architecture.parse(pattern).tag is None else shipped()
            if not (alike := [name for name in some if fnmatchcase(name, pattern)]):
                raise UsageError(f"No model matches {brief(pattern)}; see them with: brainbench models list")
            matches |= dict.fromkeys(alike)
        elif pattern in names or is_path(pattern) or Architecture.parse(pattern).tag is not None:
            matches[pattern] = None
        else:
            raise unknown_name("model", pattern, names)
    return list(matches)


def missing(jobs: Sequence[ScoringJob], records: Iterable[ResultRecord]) -> list[ScoringJob]:
    """Return the jobs whose score is not among the records.

    A record counts if it states the identity that the score would have, with this version of the estimator: so a batch
    also renews what has become stale.
    """
    from brainbench.metrics import get_metric
    from brainbench.scoring.model_responses import DEFAULT_STIMULI
    from brainbench.scoring.neural_responses import open_neural_responses
    from brainbench.scoring.scores import with_benchmark
    from brainbench.stimuli import load_stimuli

    opened = ((job, with_benchmark(job.options)) for job in jobs)
    scored = [job if benchmark is None else replace(job, options=benchmark.options) for job, benchmark in opened]
    # Jobs of --model and of a batch file may have other recordings and stimuli.
    inputs: dict[str, tuple[NeuralResponses, Stimuli]] = {}
    for options in (job.options for job in scored):
        if (key := _opened_by(options)) not in inputs:
            brain = open_neural_responses(options.recordings, progress=None, **options.selection)
            brain = replace(brain, covariates=get_metric(options.metric).of_covariates)
            source = options.stimuli or brain.stimuli or DEFAULT_STIMULI
            inputs[key] = brain, load_stimuli(source, whiskers=options.whiskers, fidelity=options.fidelity)
    present = set()
    for record in records:
        origin = record.score.provenance
        additions = ("estimator_walk" in origin.statistics, bool(origin.settings.get("over_time")))
        present.add((ScoreIdentity.of(record), origin.recordings.get("title"), *additions))
    absent = []
    for job, full in zip(jobs, scored, strict=True):
        identity, options = _identity_of(full, *inputs[_opened_by(full.options)]), full.options
        if (identity, options.title, options.explain, options.over_time) not in present:
            absent.append(job)
    return absent


def _identity_of(job: ScoringJob, brain: NeuralResponses, stimuli: Stimuli) -> ScoreIdentity:
    """Return the identity that a job's score will have."""
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.scoring.scores import metric_of

    model = resolve_model(job.model, seed=job.options.model_seed)
    labels = model.labels or stimuli.labels
    pairs = brain.pairs(labels, job.options.match)
    brain = brain.with_stimuli(labels) if job.options.match == BY_TRIAL else brain
    # Features with labels of their own were made of stimuli that nobody here knows.
    hashes = {} if model.labels else {"config_hash": stimuli.config_hash, "content_hash": stimuli.content_hash}
    options = replace(job.options, metric=metric_of(job.options))
    settings = options.settings | {"estimator_version": ESTIMATOR_VERSION}
    stated = {"recordings": brain.origin, "stimuli": hashes, "pairs": brain.stated_pairs(pairs), "settings": settings}
    return ScoreIdentity.stated_by(model.card.name, model.card.weights, tuple(pairs), Provenance.of(stated))


def _opened_by(options: ScoreOptions) -> str:
    """Return the words by which the recordings, the stimuli, and what the metric takes of them are opened."""
    return str([options.recordings, *(options.settings[name] for name in _OPENED_BY)])


def asked_settings(stated: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a score as a record states them, with the default of every option that it leaves out."""
    defaults = ScoreOptions().settings
    return to_plain({name: stated.get(name, default) for name, default in defaults.items()})


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of ``0``, ``0,3`` or ``0-4``.

    >>> parse_seeds("0-2,7")
    (0, 1, 2, 7)
    """
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, dash, last = part.strip().partition("-")
            values = range(int(first), int(last) + 1) if dash else [int(first)]
            if not values:
                raise ValueError("a range that ends before it begins")
            seeds += values
    except ValueError as error:
        raise UsageError(f"Seeds are numbers and ranges such as 0-4 or 0,3; received {brief(text)}.") from error
    return tuple(dict.fromkeys(seeds))


class _Entry(msgspec.Struct):
    models: Annotated[tuple[str, ...], Limit(shortest=1)]
    seeds: Annotated[tuple[Seed, ...], Limit(shortest=1)] | None = None


class _Batch(msgspec.Struct):
    options: dict[str, Any] = {}
    entries: tuple[_Entry, ...] = ()


def read_batch(path: Path) -> list[ScoringJob]:
    """Read the scores that a batch file asks for: TOML with ``[[entries]]`` of ``models`` and ``seeds``.

    ``[options]`` are the fields of :class:`~brainbench.scoring.options.ScoreOptions` that hold for all of them.
    """
    file = read_table(_Batch, read_toml(path, "batch file"), f"the batch file {str(path)!r}")
    options = vars(ScoreOptions.of(file.options))
    jobs = [job for entry in file.entries for job in jobs_of(entry.models, entry.seeds, options)]
    if not jobs:
        raise DataError(f'{str(path)!r} names no model; give [[entries]] with models = ["NAME"].')
    return jobs
