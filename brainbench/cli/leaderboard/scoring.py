"""Scoring for the leaderboard: what a record states, once more; and many models, without those already there."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from brainbench.cli.options import SCORE, SCORE_FLAGS, as_flags, option_fields
from brainbench.core.errors import DataError, UsageError, listing, shown, unknown_name
from brainbench.core.files import to_json, to_plain
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.texts import read_toml
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord
from brainbench.scoring.model_responses import follows_seed
from brainbench.scoring.options import ScoreOptions

if TYPE_CHECKING:
    from brainbench.scoring.neural_responses import NeuralResponses
    from brainbench.stimuli import Stimuli

_IN_HASHES = ("stimuli", "conditions", "select", "window", "bin", "fidelity", "whiskers")
"""Settings that the hashes of recordings and stimuli hold."""


@dataclass(frozen=True)
class ScoringJob:
    """One score to compute."""

    model: str
    options: ScoreOptions

    @property
    def command(self) -> str:
        """Command line that makes this score by itself."""
        return shlex.join(["brainbench", "score", self.model, *as_flags(SCORE, self.options, SCORE_FLAGS)])

    def run(self) -> ResultRecord:
        """Compute the score."""
        from brainbench.scoring.scores import score_record

        return score_record(self.model, self.options, command=self.command)


def jobs_of(patterns: Sequence[str], seeds: Sequence[int] | None, options: Mapping[str, Any]) -> list[ScoringJob]:
    """Return the scores of the models that the patterns match, for each seed of untrained weights.

    Without ``seeds`` the options state one. Weights that follow no seed are scored once.
    """
    common = ScoreOptions.of(options)
    by_seed = {
        seed: replace(common, weights_seed=None if seed == common.seed else seed)
        for seed in ([common.model_seed] if seeds is None else seeds)
    }
    fixed = [replace(common, weights_seed=None)]
    asked = {name: by_seed.values() if follows_seed(name) else fixed for name in find_models(patterns)}
    return [ScoringJob(name, seeded) for name, each in asked.items() for seeded in each]


def score_again(record: ResultRecord, *, recordings: str | None = None, trust_code: bool = False) -> ResultRecord:
    """Repeat a record's computation from its provenance.

    Only demo recordings are found without ``recordings``, since records keep no folders. ``trust_code`` also runs code
    and weights that do not come with this package.
    """
    from brainbench.scoring.demo import DEMOS
    from brainbench.scoring.scores import score_record

    origin = record.score.provenance
    model, source = origin.settings.get("model"), origin.recordings.get("source")
    _check_kinds(record, model, source)
    if not isinstance(model, str):
        raise DataError(
            f"The record of {record.score.name!r} does not name a model that can be loaded (a module in memory or a "
            "record of an earlier layout); score the model again."
        )
    refuse_foreign_code(record, trusted=trust_code)
    if recordings is None and (not isinstance(source, str) or source not in DEMOS):
        raise UsageError(f"The record was made with recordings {str(source)[:80]!r}; give them with --recordings PATH.")
    options = ScoreOptions.stated_in(origin.settings, recordings=recordings or source, match=origin.pairs or None)
    return score_record(model, options)


def _check_kinds(record: ResultRecord, model: Any, source: Any) -> None:
    """Raise DataError for settings of other kinds than the options of a score: anyone may have written the record."""
    origin = record.score.provenance
    stated: dict[str, tuple[Any, Any]] = {
        "model": (model, str),
        "source": (source, str | list[str]),
        "pairs": (origin.pairs, dict[str, str | None]),
        # Presets are texts, other fidelities their fields.
        "fidelity": (origin.settings.get("fidelity"), str | dict[str, Any]),
    }
    for name, option in option_fields(SCORE).items():
        kind = list[str] if option.several else str if option.kind is Path else option.kind
        stated.setdefault(name, (origin.settings.get(name), kind))
    for name, (value, kind) in stated.items():
        try:
            msgspec.convert(value, kind | None)
        except msgspec.ValidationError as error:
            raise DataError(f"The settings of {record.score.name[:80]!r} cannot be used: {name}: {error}.") from error


def refuse_foreign_code(record: ResultRecord, *, trusted: bool) -> None:
    """Refuse to run what a record names unless it is in the registry or comes with the package."""
    from brainbench.metrics import list_metrics
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped

    settings = record.score.provenance.settings
    known = {"model": [*list_models(), *shipped()], "metric": list_metrics()}
    for what, names in known.items():
        if not trusted and settings.get(what) not in names:
            raise UsageError(
                f"The {what} {str(settings.get(what))[:80]!r} of the record is not in the registry and does not come "
                "with this package; read its code, then run it with --trust-code."
            )


def find_models(patterns: Sequence[str]) -> list[str]:
    """Return the registry names and shipped trained models that the patterns match, in the order of the patterns.

    A name that is no pattern may also be a file or a folder, and is then taken as it is. A pattern without a dot
    means architectures, one with a dot trained models: ``*-small`` and ``*-small.*``.
    """
    from brainbench.models.architecture import Architecture, is_path
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped

    names = [*list_models(), *shipped()]
    found: dict[str, None] = {}
    for pattern in patterns:
        if any(mark in pattern for mark in "*?["):
            some = list_models() if Architecture.parse(pattern).tag is None else shipped()
            if not (alike := [name for name in some if fnmatchcase(name, pattern)]):
                raise UsageError(f"No model matches {shown(pattern)}; see them with: brainbench models list")
            found |= dict.fromkeys(alike)
        elif pattern in names or is_path(pattern) or Architecture.parse(pattern).tag is not None:
            found[pattern] = None
        else:
            raise unknown_name("model", pattern, names)
    return list(found)


def missing(jobs: Sequence[ScoringJob], records: Iterable[ResultRecord]) -> list[ScoringJob]:
    """Return the jobs whose score is not among the records.

    A record counts only if made by this version of the package and of the estimator from the same weights,
    recordings, stimuli, pairs of labels and settings, so that a batch also renews what has become stale.
    """
    from brainbench.core.version import __version__
    from brainbench.metrics import get_metric
    from brainbench.scoring.model_responses import DEFAULT_STIMULI, resolve_model
    from brainbench.scoring.neural_responses import open_neural_responses
    from brainbench.stimuli import load_stimuli

    # Jobs of --model and of a batch file may have other recordings and stimuli.
    inputs: dict[str, tuple[NeuralResponses, Stimuli]] = {}
    for options in (job.options for job in jobs):
        if (key := _asked_for(options)) not in inputs:
            brain = open_neural_responses(options.recordings, progress=None, **options.selection)
            brain = replace(brain, covariates=get_metric(options.metric).of_covariates)
            source = options.stimuli or brain.stimuli or DEFAULT_STIMULI
            inputs[key] = brain, load_stimuli(source, whiskers=options.whiskers, fidelity=options.fidelity)
    known = set()
    for record in records:
        origin = record.score.provenance
        hashes = origin.stimuli.get("config_hash") or origin.stimuli.get("content_hash")
        versions = [origin.version, origin.settings.get("estimator_version")]
        weights = record.card.weights if record.card else None
        asked = [origin.pairs, origin.recordings.get("title"), "estimator_walk" in origin.statistics]
        made = [record.score.name, weights, origin.recordings.get("content_hash"), hashes, *asked, *versions]
        known.add(to_json([*made, full_settings(origin.settings, without=_IN_HASHES)]))
    found = []
    for job in jobs:
        model = resolve_model(job.model, seed=job.options.model_seed)
        brain, stimuli = inputs[_asked_for(job.options)]
        # Features with labels of their own were made of stimuli that nobody here knows.
        felt = None if model.labels else stimuli.config_hash or stimuli.content_hash
        pairs = brain.pairs(model.labels or stimuli.labels, job.options.match)
        asked = [brain.stated_pairs(pairs), job.options.title, job.options.explain]
        given = [model.card.name, model.card.weights, brain.origin["content_hash"], felt, *asked]
        wanted = [*given, __version__, ESTIMATOR_VERSION]
        if to_json([*wanted, full_settings(job.options.settings, without=_IN_HASHES)]) not in known:
            found.append(job)
    return found


def _asked_for(options: ScoreOptions) -> str:
    """Return the words that ask for the recordings, the stimuli, and what the metric takes of them."""
    return str([options.recordings, *(options.settings[name] for name in (*_IN_HASHES, "metric"))])


def full_settings(stated: Mapping[str, Any], *, without: Sequence[str] = ()) -> dict[str, Any]:
    """Return the settings of a score as a record states them, with the default of every option that it leaves out."""
    whole = {**ScoreOptions().settings, **stated}
    return to_plain({name: whole[name] for name in ScoreOptions().settings if name not in without})


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of ``0``, ``0,3`` or ``0-4``.

    >>> parse_seeds("0-2,7")
    (0, 1, 2, 7)
    """
    seeds: list[int] = []
    try:
        for part in text.split(","):
            first, dash, last = part.strip().partition("-")
            found = range(int(first), int(last) + 1) if dash else [int(first)]
            if not found:
                raise ValueError("a range that ends before it begins")
            seeds += found
    except ValueError as error:
        raise UsageError(f"Seeds are numbers and ranges such as 0-4 or 0,3; received {shown(text)}.") from error
    return tuple(dict.fromkeys(seeds))


def read_batch(path: Path) -> list[ScoringJob]:
    """Read the scores that a batch file asks for: TOML with ``[[entries]]`` of ``models`` and ``seeds``.

    ``[options]`` are the fields of :class:`~brainbench.scoring.options.ScoreOptions` that hold for all of them.
    """
    data = read_toml(path, "batch file")
    given, entries = data.get("options", {}), data.get("entries", [])
    if set(data) - {"options", "entries"} or not isinstance(given, dict) or not isinstance(entries, list):
        raise DataError(f"{str(path)!r} has a table [options] and lists [[entries]]; received {listing(data)}.")
    options = vars(ScoreOptions.of(given))
    jobs = []
    for entry in entries:
        if not isinstance(entry, dict) or set(entry) - {"models", "seeds"} or "models" not in entry:
            raise DataError(f"An entry of {str(path)!r} has 'models' and maybe 'seeds'; received {shown(entry)}.")
        models, seeds = entry["models"], entry.get("seeds")
        if not isinstance(models, list) or not models or not all(isinstance(name, str) for name in models):
            raise DataError(f"'models' of {str(path)!r} is a list of one or more names; received {shown(models)}.")
        if seeds is not None and (not isinstance(seeds, list) or not seeds):
            raise DataError(f"'seeds' of {str(path)!r} is a list of whole numbers, not empty; received {shown(seeds)}.")
        for seed in seeds or ():
            check_number("A seed of a batch", seed, least=0, whole=True)
        jobs += jobs_of(models, seeds, options)
    if not jobs:
        raise DataError(f'{str(path)!r} names no model; give [[entries]] with models = ["NAME"].')
    return jobs
