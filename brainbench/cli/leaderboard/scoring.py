"""Scoring for the leaderboard: what a record states, once more; and many models, without those already there."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, UsageError, unknown_name
from brainbench.core.progress import Progress
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord

REPEATED = ("estimator", "metric", "whiskers", "fidelity", "normalize", "time", "conditions", "select", "window", "bin")
"""Settings of a record that are arguments of :func:`brainbench.scoring.scores.score_record`."""


@dataclass(frozen=True)
class ScoringJob:
    """One score to compute."""

    model: str
    weights_seed: int
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def command(self) -> str:
        """The command line that makes this score by itself."""
        words = ["brainbench", "score", self.model]
        if self.weights_seed:
            words += ["--weights-seed", str(self.weights_seed)]
        for name, value in self.options.items():
            words += [f"--{name}", str(value)]
        return shlex.join(words)


def score_again(
    record: ResultRecord, *, recordings: str | None = None, progress: Progress | None = None
) -> ResultRecord:
    """Repeat a record's computation from its provenance.

    Args:
        record: The record.
        recordings: Where its recordings are; only ``demo`` is found without, since records keep no folders.
        progress: Called with (done, total, what).

    Raises:
        DataError: the record does not say enough.
        UsageError: the recordings are not given, or differ in their labels.
    """
    from brainbench.scoring.scores import score_record

    score = record.score
    settings = score.provenance.get("settings") or {}
    source = (score.provenance.get("recordings") or {}).get("source")
    model = settings.get("model")
    if not isinstance(model, str):
        raise DataError(
            f"The record of {score.name!r} does not name a model that can be loaded (a module in memory or a record "
            "of an earlier layout); score the model again."
        )
    if recordings is None and source != "demo":
        raise UsageError(f"The record was made with the recordings {source!r}; give them with --recordings PATH.")
    options = {name: settings[name] for name in REPEATED if settings.get(name) is not None}
    layers = settings.get("layers")
    pairs = score.provenance.get("pairs") or {}
    match = pairs if any(label != partner for label, partner in pairs.items()) else None
    return score_record(
        model,
        recordings=recordings or "demo",
        stimuli=settings.get("stimuli"),
        match=match,
        layers=tuple(layers) if layers else None,
        seed=settings.get("seed", 0),
        weights_seed=settings.get("weights_seed"),
        progress=progress,
        **options,
    )


def find_models(patterns: Sequence[str]) -> list[str]:
    """Return the registry names and shipped trained models that the patterns match, in the order of the patterns.

    A name that is no pattern may also be a file or a folder, and is then taken as it is. A pattern without a dot
    means architectures, one with a dot trained models: ``*-small`` and ``*-small.*``.

    Raises:
        UsageError: an architecture does not exist.
    """
    from brainbench.models.architecture import Architecture, is_path
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped

    names = [*list_models(), *shipped()]
    found: dict[str, None] = {}
    for pattern in patterns:
        plain = not any(mark in pattern for mark in "*?[")
        if plain and (pattern in names or is_path(pattern) or Architecture.parse(pattern).tag is not None):
            found[pattern] = None
            continue
        trained = Architecture.parse(pattern).tag is not None
        hits = [name for name in (shipped() if trained else list_models()) if fnmatchcase(name, pattern)]
        if plain and not hits:
            raise unknown_name("model", pattern, names)
        found |= dict.fromkeys(hits)
    return list(found)


def missing(
    jobs: Iterable[ScoringJob], records: Iterable[ResultRecord], *, options: dict[str, Any]
) -> list[ScoringJob]:
    """Return the jobs whose score is not among the records.

    A record counts only if made by this version of the package and of the estimator from the same weights,
    recordings, stimuli and settings, so that a batch also renews what has become stale.
    """
    from brainbench import __version__
    from brainbench.scoring.model_responses import DEFAULT_STIMULI, resolve_model
    from brainbench.scoring.neural_responses import open_neural_responses
    from brainbench.stimuli import load_stimuli

    selection = {name: options.get(name) for name in ("conditions", "select", "window")}
    brain = open_neural_responses(options.get("recordings", "demo"), progress=None, **selection).origin["content_hash"]
    shown = load_stimuli(
        options.get("stimuli", DEFAULT_STIMULI),
        whiskers=options.get("whiskers", "all"),
        fidelity=options.get("fidelity", "balanced"),
    )
    stimuli = shown.config_hash or shown.content_hash
    defaults = {"metric": "rsa", "estimator": "default", "time": "mean"}
    wanted = tuple(options.get(name, default) for name, default in defaults.items())
    known = set()
    for record in records:
        said = record.score.provenance
        settings = said.get("settings") or {}
        seen = said.get("stimuli") or {}
        known.add(
            (
                record.score.name,
                settings.get("weights_seed"),
                record.card.weights if record.card else None,
                said.get("version"),
                (said.get("recordings") or {}).get("content_hash"),
                seen.get("config_hash") or seen.get("content_hash"),
                tuple(settings.get(name) for name in defaults),
                settings.get("estimator_version"),
            )
        )
    return [
        job
        for job in jobs
        if (
            job.model,
            job.weights_seed,
            resolve_model(job.model, seed=job.weights_seed).card.weights,
            __version__,
            brain,
            stimuli,
            wanted,
            ESTIMATOR_VERSION,
        )
        not in known
    ]


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of ``0``, ``0,3`` or ``0-4``.

    >>> parse_seeds("0-2,7")
    (0, 1, 2, 7)

    Raises:
        UsageError: it is something else.
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
        raise UsageError(f"Seeds are numbers and ranges such as 0-4 or 0,3; received {text!r}.") from error
    return tuple(dict.fromkeys(seeds))


def read_batch(path: Path) -> list[ScoringJob]:
    """Read the scores that a batch file asks for: TOML with ``[[entries]]`` of ``models`` and ``seeds``.

    ``[options]`` are those of ``brainbench score`` that hold for all: recordings, stimuli, fidelity, whiskers, …

    Raises:
        DataError: the file is missing or of another kind.
        UsageError: an option does not exist.
    """
    import tomllib

    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataError(f"{str(path)!r} is not a readable batch file ({error}).") from error
    options = data.get("options", {})
    for name in options:
        if name not in OPTIONS:
            raise unknown_name("option of a batch", name, OPTIONS)
    jobs = []
    for entry in data.get("entries", []):
        if set(entry) - {"models", "seeds"} or "models" not in entry:
            raise DataError(f"An entry of {str(path)!r} has 'models' and maybe 'seeds'; received {sorted(entry)}.")
        for model in find_models(entry["models"]):
            jobs += [ScoringJob(model, seed, options) for seed in entry.get("seeds", [0])]
    return jobs


OPTIONS = (
    "recordings", "conditions", "select", "window", "stimuli", "fidelity", "whiskers", "metric", "estimator", "time"
)  # fmt: skip
"""Options of a scoring run that ``leaderboard add`` passes on."""
