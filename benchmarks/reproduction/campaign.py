"""The trainings and result records of a campaign, joined by network and seed.

A line of ``trainings.jsonl`` and a record belong together when
architecture, objective, augmentation, masking and seed agree.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from brainbench.core.errors import DataError
from brainbench.core.records import ResultRecord
from brainbench.core.statistics import wilson_interval
from leaderboards.boards import Board, rank
from leaderboards.store import read_records

_SMALL = "-small"
_Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


@dataclass(frozen=True)
class Accuracy:
    """Accuracy on the test sweeps, as :class:`brainbench.models.training.evaluation.Evaluation` states it."""

    top1: _Share
    top5: _Share
    count: Annotated[int, msgspec.Meta(ge=1)]
    collapsed: bool = False


@dataclass(frozen=True)
class Training:
    """One line of ``trainings.jsonl``: a network trained once, an untrained one, or a baseline."""

    name: str
    objective: Literal["supervised", "simclr", "simsiam", "ae", "untrained", "baseline"]
    model: str = ""
    seed: int = 0
    augmentation: str = "none"
    masking: float = 0.0
    epochs: int | None = None
    rate: float | None = None
    """Learning rate that was given instead of searched."""
    evaluation: Accuracy | None = None
    parameters: int | None = None
    status: Literal["finished", "diverged"] = "finished"
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def result(self) -> Accuracy | None:
        """Accuracy; None for a training that diverged, whose network counts for nothing."""
        return self.evaluation if self.status == "finished" else None


class NetworkKey(NamedTuple):
    """One way of training one architecture, in all seeds; names as in the registry, without ``-small``."""

    encoder: str
    attender: str = "none"
    objective: str = "supervised"
    variant: str = ""
    """Empty for the usual augmentation without masking, else what differs: ``image``, ``masked``, ``rate 0.01``."""
    full: bool = False
    """True for a network of the published size; those that are compared are small."""

    @property
    def name(self) -> str:
        """Name in print."""
        model = self.encoder + (f"+{self.attender}" if self.attender != "none" else "")
        return ".".join(filter(None, (model, self.objective, self.variant)))

    @property
    def family(self) -> str:
        """Kind of its encoder: the ConvRNNs differ in their cells alone."""
        stem = self.encoder.partition("-")[0]
        return "ConvRNNs" if stem == "zhuang" else stem

    @property
    def untrained(self) -> NetworkKey:
        """The same architecture as it is drawn."""
        return self._replace(objective="untrained", variant="")

    @classmethod
    def of(
        cls, model: str, objective: str, augmentation: str = "", masking: float = 0, rate: float | None = None
    ) -> NetworkKey:
        """Return the key of a registry name and of how it was trained; no augmentation: the usual one."""
        encoder, _, attender = model.partition("+")
        usual = ("", "none" if objective in ("supervised", "untrained") else "physical")
        variant = [] if augmentation in usual else [augmentation]
        variant += ["masked"] if masking else []
        variant += [f"rate {rate:g}"] if rate is not None else []
        return cls(
            encoder.removesuffix(_SMALL), attender or "none", objective, " ".join(variant), _SMALL not in encoder
        )


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
    full: Mapping[NetworkKey, Network]
    """Networks of the published size, which enter no comparison."""

    @property
    def trainings(self) -> list[Training]:
        """All trainings of networks, none of baselines."""
        return [training for network in self.networks.values() for training in network.trainings.values()]


def read_campaign(folder: Path) -> Campaign:
    """Read a folder with ``trainings.jsonl`` and ``records/``.

    Raises:
        DataError: a record is damaged, two are of one network and seed, or trainings had other sweeps.
    """
    lines = msgspec.json.Decoder(Training).decode_lines((folder / "trainings.jsonl").read_bytes())
    data = {str(line.data.get("hash")) for line in lines if line.data}
    if len(data) > 1:
        raise DataError(f"Trainings on different sweeps cannot be compared: {', '.join(sorted(data))}.")
    stored = read_records(folder / "records")
    if problem := next((item.problem for item in stored if item.problem), None):
        raise DataError(f"A record of the campaign cannot be used: {problem}")
    return join_campaign(lines, [item.record for item in stored if item.record is not None])


def join_campaign(lines: Sequence[Training], records: Sequence[ResultRecord]) -> Campaign:
    """Join trainings and records by network and seed.

    Raises:
        DataError: two trainings, or two records on a board, are of the same network and seed.
    """
    networks: dict[NetworkKey, Network] = defaultdict(lambda: Network({}, {}))
    for line in lines:
        if line.objective != "baseline":
            key = NetworkKey.of(line.model, line.objective, line.augmentation, line.masking, line.rate)
            _put(networks[key].trainings, line.seed, line, line.name)
    boards = rank([_completed(record, networks) for record in records])
    boards.sort(key=lambda board: (bool(board.lacks), "ridge" in board_name(board)))
    for place, board in enumerate(boards):
        for record in _records(board):
            key, seed = _identity(record)
            _put(networks[key].records.setdefault(place, {}), seed, record, record.score.name)
    return Campaign(
        {key: networks[key] for key in sorted(networks) if not key.full},
        {line.name: line for line in lines if line.objective == "baseline"},
        tuple(boards),
        {key: networks[key] for key in sorted(networks) if key.full},
    )


def board_name(board: Board) -> str:
    """Return recordings and metric, as ``demo, rsa``."""
    metric = _records(board)[0].score.provenance.settings.get("metric") or board.metric
    return f"{board.recordings}, {metric}"


def _records(board: Board) -> list[ResultRecord]:
    return [record for entry in board.entries for record in entry.records]


def _put(found: dict[int, Any], seed: int, item: Any, name: str) -> None:
    if found.setdefault(seed, item) is not item:
        raise DataError(f"There is another one of the same network and seed as {name!r}; keep one of the two.")


def _identity(record: ResultRecord) -> tuple[NetworkKey, int]:
    """Return the network and its seed as the record's card states them."""
    card = record.card
    if card is None or card.objective is None or (card.twin is None and card.objective != "untrained"):
        raise DataError(f"The record of {record.score.name!r} has no card that names its objective and architecture.")
    # The card of a masked training names both: "physical + 75% masking".
    augmentation = (card.augmentation or "").partition(" + ")[0]
    model, masking = card.twin or record.score.name, card.training.get("masking") or 0
    return NetworkKey.of(model, card.objective, augmentation, masking), card.seed or 0


def _completed(record: ResultRecord, networks: Mapping[NetworkKey, Network]) -> ResultRecord:
    """Return a record whose card states the accuracies of its training, and of its twin, where it does not."""
    key, seed = _identity(record)
    line, twin = (networks[one].trainings.get(seed) if one in networks else None for one in (key, key.untrained))
    stated: dict[str, Any] = {}
    if line is not None and (found := line.result) is not None:
        interval = wilson_interval(found.top1 * found.count, found.count, over="sweeps")
        stated |= {"top1": found.top1, "top5": found.top5, "collapsed": found.collapsed, "accuracy_interval": interval}
    if twin is not None and twin is not line and twin.result is not None:
        stated["twin_top1"] = twin.result.top1
    missing = {name: value for name, value in stated.items() if getattr(record.card, name) is None}
    return replace(record, card=replace(record.card, **missing))
