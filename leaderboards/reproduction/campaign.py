"""The trainings and result records of a campaign, joined by network and seed.

A line of ``trainings.jsonl`` and a record belong together when architecture, objective, augmentation, masking and seed
agree. A record says these on its model card; where the card does not, its name does
(``<architecture>.<objective>[.<augmentation>][.masked75][.seed0]``).
"""

from __future__ import annotations

import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from brainbench.core.errors import DataError, DataFileNotFoundError
from brainbench.core.records import ResultRecord
from brainbench.core.statistics import wilson_interval
from leaderboards.boards import Board, rank
from leaderboards.reproduction.trainings import OBJECTIVES, TRAININGS, Training, read_trainings
from leaderboards.store import read_records

RECORDS = "records"
_NAME = re.compile(
    r"(?P<model>[^.]+)\.(?P<objective>supervised|simclr|simsiam|ae|untrained)"
    r"(?:\.(?P<augmentation>physical|image|none|thesis))?(?:\.masked(?P<masked>\d+))?(?:\.seed(?P<seed>\d+))?"
)


class NetworkKey(NamedTuple):
    """One way of training one architecture, in all seeds; names as in the registry, without the size."""

    encoder: str
    attender: str = "none"
    objective: str = "supervised"
    variant: str = ""
    """Empty for the usual augmentation without masking, else what differs: ``image``, ``masked``, ``rate 0.01``."""

    @property
    def name(self) -> str:
        """Name in print."""
        model = self.encoder + (f"+{self.attender}" if self.attender != "none" else "")
        return ".".join(filter(None, (model, self.objective, self.variant)))

    @classmethod
    def of(cls, model: str, objective: str, variant: str = "") -> NetworkKey:
        """Return the key of a registry name."""
        encoder, _, attender = model.partition("+")
        return cls(encoder.removesuffix("-small"), attender or "none", objective, variant)


class Network(NamedTuple):
    """All that is known of a network, by seed."""

    trainings: dict[int, Training]
    records: dict[int, dict[int, ResultRecord]]
    """Place of the board in :attr:`Campaign.boards` → seed → record."""


@dataclass(frozen=True)
class Campaign:
    """A campaign, of whatever is there of it."""

    networks: Mapping[NetworkKey, Network]
    baselines: Mapping[str, Training]
    boards: tuple[Board, ...]
    """Boards with enough animals and stimuli for tests first, of those the one of most networks."""
    unmatched: tuple[str, ...]
    """Names of records that say neither objective nor architecture."""
    other_sizes: tuple[str, ...]
    """Names of networks of another size than most; they enter no comparison."""
    other_trainings: tuple[Training, ...]
    """Trainings of these."""

    @property
    def trainings(self) -> list[Training]:
        """All trainings of networks, none of baselines."""
        return [training for network in self.networks.values() for training in network.trainings.values()]


def read_campaign(folder: str | os.PathLike[str]) -> Campaign:
    """Read a folder with ``trainings.jsonl``, ``records/`` or both.

    Raises:
        DataFileNotFoundError: the folder holds neither.
        DataError: a line or a record is damaged, two lines are of one training, or trainings had other classes.
    """
    folder = Path(folder)
    lines, records = folder / TRAININGS, folder / RECORDS
    if not lines.is_file() and not records.is_dir():
        raise DataFileNotFoundError(
            f"{os.fspath(folder)!r} holds neither {TRAININGS!r} nor a folder {RECORDS!r}; name a campaign's folder."
        )
    trainings = read_trainings(lines) if lines.is_file() else []
    stored = read_records(records) if records.is_dir() and any(records.rglob("*.json")) else []
    if problem := next((item.problem for item in stored if item.problem), None):
        raise DataError(f"A record of the campaign cannot be used: {problem}")
    return join_campaign(trainings, [item.record for item in stored if item.record is not None])


def join_campaign(trainings: Sequence[Training], records: Sequence[ResultRecord]) -> Campaign:
    """Join trainings and records by network and seed.

    Raises:
        DataError: two trainings are of the same network and seed.
    """
    runs = [
        _Identity(item.model, item.objective, item.augmentation, item.masking, item.seed, item.rate)
        for item in trainings
    ]
    known = dict(zip(runs, trainings, strict=True))
    boards = rank([_completed(record, known) for record in records])
    boards = tuple(sorted(boards, key=lambda board: (bool(board.lacks), "ridge" in board_name(board))))
    placed = [(place, one, _identity(one)) for place, board in enumerate(boards) for one in _records(board)]
    everyone = [*runs, *(identity for *_, identity in placed if identity)]
    usual = _usual_augmentations(everyone)
    models = [run.model for run in everyone if run.model]
    small = sum("-small" in model for model in models) * 2 >= len(models)
    others = sorted({model for model in models if ("-small" in model) is not small})
    networks: dict[NetworkKey, Network] = defaultdict(lambda: Network({}, {}))
    for training, run in zip(trainings, runs, strict=True):
        if training.objective != "baseline" and training.model not in others:
            held = networks[run.key(usual)].trainings.setdefault(training.seed, training)
            if held is not training:
                raise DataError(
                    f"{held.name!r} and {training.name!r} are the same network and seed; keep one of the two lines."
                )
    for place, record, identity in placed:
        if identity is not None and identity.model not in others:
            seeds = networks[identity.key(usual)].records.setdefault(place, {})
            # Of one network and seed the newest record counts, as on the board.
            old = seeds.get(identity.seed)
            if old is None or old.score.provenance.time < record.score.provenance.time:
                seeds[identity.seed] = record
    return Campaign(
        {key: networks[key] for key in sorted(networks)},
        {line.name: line for line in trainings if line.objective == "baseline"},
        boards,
        tuple(sorted({record.score.name for _, record, identity in placed if identity is None})),
        tuple(others),
        tuple(line for line in trainings if line.model in others),
    )


def board_name(board: Board) -> str:
    """Return recordings and metric, as ``demo, rsa``."""
    metric = _records(board)[0].score.provenance.settings.get("metric") or board.metric
    return f"{board.recordings}, {metric}"


def _records(board: Board) -> list[ResultRecord]:
    return [record for entry in board.entries for record in entry.records]


class _Identity(NamedTuple):
    """Fields that tell one training from another."""

    model: str
    objective: str
    augmentation: str
    masking: float
    seed: int
    rate: float | None = None

    def key(self, usual: Mapping[str, str]) -> NetworkKey:
        if self.objective == "untrained":
            return NetworkKey.of(self.model, self.objective)
        parts = [] if self.augmentation == usual.get(self.objective) else [self.augmentation]
        parts += ["masked"] if self.masking else []
        parts += [f"rate {self.rate:g}"] if self.rate is not None else []
        return NetworkKey.of(self.model, self.objective, " ".join(parts))


def _identity(record: ResultRecord) -> _Identity | None:
    """Return the identity that a record states on its card, or else in its name; None where neither says it."""
    card, settings = record.card, record.score.provenance.settings
    name = record.score.name.removeprefix("local-dir:").rstrip("/").rpartition("/")[2]
    told = _NAME.fullmatch(name)
    stated: dict[str, Any] = told.groupdict() if told else {}
    objective = (card and card.objective) or stated.get("objective") or (None if "." in name else "untrained")
    if objective not in OBJECTIVES[:5]:
        return None
    # A folder of weights may have any name; the card then names the architecture by its twin.
    model = (card and card.twin) or stated.get("model") or name.partition(".")[0]
    seeds = (stated.get("seed"), card and card.seed, settings.get("weights_seed"), 0)
    # The card of a masked training names both: "physical + 75% masking".
    augmentation = (stated.get("augmentation") or (card and card.augmentation) or "none").partition(" + ")[0]
    masking = (card and card.training.get("masking")) or float(stated.get("masked") or 0) / 100
    masking = float(masking) if isinstance(masking, (int, float)) and math.isfinite(masking) else 0.0
    return _Identity(model, objective, augmentation, masking, int(next(one for one in seeds if one is not None)))


def _completed(record: ResultRecord, known: Mapping[_Identity, Training]) -> ResultRecord:
    """Return a record whose card states the accuracies of its training, and of its twin, where it does not."""
    identity = _identity(record)
    line = known.get(identity) if identity else None
    if line is None or record.card is None or not line.finished:
        return record
    stated: dict[str, Any] = {"parameters": line.parameters}
    if (found := line.evaluation) is not None:
        interval = wilson_interval(found.top1 * found.count, found.count, over="sweeps")
        stated |= {"top1": found.top1, "top5": found.top5, "collapsed": found.collapsed, "accuracy_interval": interval}
    if line.twin_evaluation is not None:
        stated["twin_top1"] = line.twin_evaluation.top1
    missing = {name: value for name, value in stated.items() if getattr(record.card, name) is None}
    return replace(record, card=replace(record.card, **missing))


def _usual_augmentations(runs: Sequence[_Identity]) -> dict[str, str]:
    """Return the augmentation that most trainings of each objective used, unmasked ones before masked ones."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for run in runs:
        counts[run.objective][run.augmentation] += 1 if run.masking else len(runs)
    return {name: min(count, key=lambda one: (-count[one], one != "physical")) for name, count in counts.items()}
