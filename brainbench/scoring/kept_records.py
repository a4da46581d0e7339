"""Records of scores that were made before on this machine, with the same code, network, recordings and options."""

from __future__ import annotations

import re
from pathlib import Path

from brainbench.core.errors import UsageError
from brainbench.core.files import cache_dir, content_hash, read_json
from brainbench.core.reading.sealed import code_stamp, keep_entry, read_entry
from brainbench.core.records import ResultRecord
from brainbench.scoring.demo import DEMOS
from brainbench.scoring.options import ScoreOptions


def record_path(model: str, options: ScoreOptions, command: str) -> Path | None:
    """Return where the cache keeps the record of a model's score; None for one that depends on code or files of others.

    Their changes do not show in the name of the entry: models and metrics of a file, and those that another package
    registered.
    """
    from brainbench.metrics.measures.metric import get_metric
    from brainbench.models.registry import locate_model

    # A path, or FILE.py:NAME, has characters that no name of the package has.
    if not all(re.fullmatch(r"[\w.+-]+", str(name)) for name in (model, options.metric)):
        return None
    foreign = ("stimuli", "match", "plan", "benchmark")
    if str(options.recordings) not in DEMOS or any(getattr(options, name) for name in foreign):
        return None
    try:
        entry, metric = locate_model(model), get_metric(options.metric)
    except UsageError:
        return None
    package = Path(__file__).parents[1]
    ours = entry.record.source == package.name and (entry.weights is None or package in entry.weights.parents)
    if not ours or type(metric).__module__.partition(".")[0] != package.name:
        return None
    return cache_dir("scores") / f"{content_hash(model, options, command, code_stamp(), vars(metric))}.json"


def read_kept(path: Path | None) -> ResultRecord | None:
    """Return the record that the cache keeps at ``path``; None without one, or with a damaged one."""
    return None if path is None else read_entry(path, "record", lambda file: ResultRecord.from_json(read_json(file)))


def keep(record: ResultRecord, path: Path | None) -> None:
    """Keep a record in the cache, where it can be written."""
    if path is not None:
        keep_entry(path, "record", lambda file: file.write_text(record.to_json(), encoding="utf-8"))
