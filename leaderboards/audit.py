"""Doubtful records of a set, and differences between two records or two builds of a board.

A record is **stale** when something newer exists than what made it: the default estimator, or the definition behind a
fidelity's name. A newer package alone makes none: what changes numbers raises the estimator's version. Two records
**conflict** when they state one identity (:class:`brainbench.core.identity.ScoreIdentity`) and different numbers. One
is **doubtful** when an interval of it misses the number that it is of.
"""

from __future__ import annotations

import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice, product
from pathlib import Path
from typing import Any, Literal, get_args

from brainbench.core.errors import look_alike
from brainbench.core.files import to_plain
from brainbench.core.identity import ScoreIdentity, plan_note
from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord, Score
from leaderboards.boards import rank
from leaderboards.entries import TOLERANCE, UNTRAINED, moment
from leaderboards.store import StoredRecord, read_records

MOST_NAMED = 3  # most contradicting records that are named for one


def remarks(stored: Iterable[StoredRecord]) -> dict[str, tuple[str, ...]]:
    """Return for each doubtful record, by its identity, one sentence per doubt.

    Every sentence begins with ``stale:``, ``conflict:``, ``doubtful:``, ``look-alike:`` or ``plan:``.
    """
    usable = [item.record for item in stored if item.record is not None]
    doubts: dict[str, list[str]] = defaultdict(list)
    newest = _newest_stimuli(usable)
    groups: dict[ScoreIdentity, list[ResultRecord]] = defaultdict(list)
    for record in usable:
        doubts[record.identity] += [f"stale: {reason}" for reason in _stale(record, newest)]
        doubts[record.identity] += [f"doubtful: {doubt}" for score in record.scores for doubt in score.doubts]
        if (note := plan_note(record)) and not note.startswith("follows"):
            doubts[record.identity].append(f"plan: {note}")
        groups[ScoreIdentity.of(record)].append(record)
    names: dict[tuple[str, str], set[str]] = defaultdict(set)
    for what, name in {pair for record in usable for pair in names_of(record)}:
        names[what, look_alike(name)].add(name)
    for record in usable:
        for what, name in names_of(record):
            rivals = sorted(names[what, look_alike(name)] - {name})[:MOST_NAMED]
            doubts[record.identity] += [f"look-alike: its {what} reads like {rival!a}" for rival in rivals]
    for group in groups.values():
        for record in group:
            # A few are enough to find out, and a set of many contradicting records stays readable.
            for rival in islice((rival for rival in group if not _agree(record, rival)), MOST_NAMED):
                doubts[record.identity].append(
                    f"conflict: the same computation gave {_value(record)} here and {_value(rival)} in the record "
                    f"{rival.identity}; find out which with: brainbench leaderboard verify"
                )
    return {identity: tuple(sentences) for identity, sentences in doubts.items() if sentences}


def names_of(record: ResultRecord) -> list[tuple[str, str]]:
    """Return what a record names that others may name too, each with what it is."""
    names = [("name", record.score.name), ("benchmark", record.score.provenance.benchmark_name)]
    return [(what, name) for what, name in names if name]


def conflicting(record: ResultRecord, others: Iterable[ResultRecord]) -> Iterator[ResultRecord]:
    """Yield those of ``others`` that state the same computation as ``record`` and other numbers."""
    rivals = (rival for rival in others if rival.identity != record.identity and not _agree(record, rival))
    return (rival for rival in rivals if ScoreIdentity.of(rival) == ScoreIdentity.of(record))


def _stale(record: ResultRecord, newest: dict[tuple[Any, ...], str]) -> list[str]:
    score, settings, reasons = record.score, record.score.provenance.settings, []
    estimator = settings.get("estimator_version")
    if score.estimator == "default" and isinstance(estimator, int) and estimator < ESTIMATOR_VERSION:
        reasons.append(f"version {estimator} of the default estimator, now {ESTIMATOR_VERSION}")
    latest = newest.get(_wording(record))
    if latest and latest != score.provenance.stimuli_hash:
        reasons.append(
            f"its stimuli ({score.provenance.stimuli_hash}) were made by another engine or an earlier definition of "
            f"fidelity {settings.get('fidelity')!r} than the newest records' ({latest})"
        )
    return reasons


def _wording(record: ResultRecord) -> tuple[Any, ...]:
    """Return the words by which the stimuli were asked for: they may mean others in another version."""
    origin = record.score.provenance
    return (origin.stimuli_name, *(str(origin.settings.get(name)) for name in ("stimuli", "whiskers", "fidelity")))


def _newest_stimuli(records: list[ResultRecord]) -> dict[tuple[Any, ...], str]:
    """Return for each wording of the stimuli the hash of the newest record."""
    newest: dict[tuple[Any, ...], str] = {}
    for record in sorted(records, key=lambda record: (moment(record), record.score.provenance.stimuli_hash or "")):
        origin = record.score.provenance
        if origin.stimuli_hash and origin.settings.get("fidelity"):
            newest[_wording(record)] = origin.stimuli_hash
    return newest


def _agree(left: ResultRecord, right: ResultRecord) -> bool:
    a, b = left.score, right.score
    return a.status == b.status and all(
        (math.isnan(x) and math.isnan(y)) or abs(x - y) <= TOLERANCE
        for x, y in ((a.value, b.value), (a.r, b.r), (a.reliability, b.reliability))
    )


def _value(record: ResultRecord) -> str:
    return "no number" if math.isnan(record.score.value) else f"{record.score.value:.4f}"


_CAUSES = ("recordings", "stimuli", "estimator version", "card.weights", "score.layer")


@dataclass(frozen=True)
class Difference:
    """One statement of two records that is not the same."""

    what: str
    """Place in the record, such as ``score.value``."""
    before: Any
    after: Any

    def __str__(self) -> str:
        return f"{self.what}: {in_short(self.before)} → {in_short(self.after)}"


Kind = Literal["added", "removed", "changed", "moved", "restated"]


@dataclass(frozen=True)
class Change:
    """A change of one model between two builds."""

    kind: Kind
    """``moved``: the record is the same, its rank or standing is not, because of others. ``restated``: another record
    with the same inputs and numbers, which says more or less beside them."""
    board: str
    name: str
    before: str
    """Value, standing and rank before; empty for an added one."""
    after: str
    causes: tuple[str, ...] = ()
    """Other differences between the records, such as the package's version or the stimuli."""


def differences(record: ResultRecord, again: ResultRecord, *, tolerance: float = TOLERANCE) -> list[Difference]:
    """Return what a repetition of a record's computation found otherwise, the inputs first.

    Compared are the hashes of recordings, stimuli and trained weights, and every number, layer, animal, baseline and
    status of the scores; and whatever else a record states that pages show (:data:`STATED`), which an earlier version
    may state less of. Numbers count as equal within ``tolerance``, distances of an RDM within this share of its
    largest. What only says when, where, with which packages and in which words is not compared, nor the content hash of
    simulated stimuli whose configuration is the same, nor that of weights that both drew from a seed: the last digits
    of both are the processor's.
    """
    stated, repeated = record.score.provenance, again.score.provenance
    versions = [origin.settings.get("estimator_version") for origin in (stated, repeated)]
    pairs: list[tuple[str, Any, Any]] = [
        ("recordings", stated.recordings_hash, repeated.recordings_hash),
        ("stimuli", stated.stimuli_hash, repeated.stimuli_hash),
        ("estimator version", versions[0], versions[1]),
    ]
    if record.card and again.card and not record.card.objective == again.card.objective == UNTRAINED:
        pairs.append(("card.weights", record.card.weights, again.card.weights))
    claims, claims_again = dict(_claims(record)), dict(_claims(again))
    before, after = dict(_statements(record)), dict(_statements(again))
    pairs += [(name, value, claims_again.get(name)) for name, value in claims.items()]
    pairs += [(name, before.get(name), after.get(name)) for name in dict.fromkeys([*before, *after])]
    # A count is equal or not; some claims are large numbers with a fraction, such as an effective number of units.
    limits = {name: tolerance * max(1.0, abs(value)) for name, value in claims.items() if isinstance(value, float)}
    for name, value in before.items():
        if "_rdm[" in name and isinstance(value, (int, float)):
            rdm = name.partition("[")[0]
            limits[rdm] = max(limits.get(rdm, 0.0), tolerance * abs(value))
    near = [limits.get(name, limits.get(name.partition("[")[0], tolerance)) for name, *_ in pairs]
    return [Difference(*pair) for pair, limit in zip(pairs, near, strict=True) if not _equal(*pair[1:], limit)]


def open_build(*sources: str | os.PathLike[str]) -> list[StoredRecord]:
    """Read the records of folders, files, or built sites (which hold those they were made from), each record once."""
    folders = [(source, Path(source) / "records") for source in sources]
    return read_records([records if records.is_dir() else source for source, records in folders])


def compare_builds(before: Iterable[StoredRecord], after: Iterable[StoredRecord]) -> list[Change]:
    """Return what changed between two sets of records: added, removed, changed, and ranks or standings moved by others.

    A model is the same when its name, weights seed, recordings' name, metric, estimator and time rule are.
    """
    old, new = _by_model(before), _by_model(after)
    changes = []
    for key in dict.fromkeys([*new, *old]):
        past, present = dict(old.get(key, {})), dict(new.get(key, {}))
        pairs = [(past.pop(identity), present.pop(identity)) for identity in sorted(past.keys() & present.keys())]
        changes += [left.change("moved", left.state, right.state) for left, right in pairs if left.state != right.state]
        while past and present:
            # A name may stand on boards of several stimuli: records that agree in most inputs are of one score.
            left, right = max(product(past.values(), present.values()), key=_likeness)
            del past[left.record.identity], present[right.record.identity]
            changed = differences(left.record, right.record, tolerance=0.0)
            causes = tuple(str(difference) for difference in changed if difference.what in _CAUSES)
            changes.append(right.change("changed" if changed else "restated", left.state, right.state, causes))
        changes += [left.change("removed", left.state, "") for left in past.values()]
        changes += [right.change("added", "", right.state) for right in present.values()]
    order = get_args(Kind).index
    return sorted(changes, key=lambda change: (order(change.kind), change.board, change.name, change.before))


@dataclass(frozen=True)
class _Placed:
    """A record on a board."""

    board: str
    name: str
    state: str  # value, standing and rank in print
    record: ResultRecord

    def change(self, kind: Kind, before: str, after: str, causes: tuple[str, ...] = ()) -> Change:
        """Return a change of this model, from one state in print to another."""
        return Change(kind, self.board, self.name, before, after, causes)


def _likeness(pair: tuple[_Placed, _Placed]) -> int:
    """Return in how many inputs two records agree, in words and by hashes."""
    inputs = ([*vars(ScoreIdentity.of(placed.record)).values(), *_wording(placed.record)] for placed in pair)
    return sum(left == right for left, right in zip(*inputs, strict=True))


def _by_model(stored: Iterable[StoredRecord]) -> dict[tuple[Any, ...], dict[str, _Placed]]:
    placed: dict[tuple[Any, ...], dict[str, _Placed]] = defaultdict(dict)
    for board in rank(item.record for item in stored if item.record is not None):
        label = f"{board.recordings}, {board.metric or 'metric not stated'}, {board.estimator}"
        for entry, record in ((one, record) for one in board.entries for record in one.records):
            seed, value = record.card.seed if record.card else None, record.score.value
            name = f"{entry.name} (seed {seed})" if seed is not None else entry.name
            # What a score is worth may change with the other records, though neither score nor rank does.
            state = f"{'' if math.isnan(value) else f'{value:.3f}, '}{entry.standing}, rank {entry.rank}"
            key = (entry.name, seed, board.recordings, board.metric, record.score.estimator, board.time)
            placed[key][record.identity] = _Placed(label, name, state, record)
    return placed


def _statements(record: ResultRecord) -> Iterator[tuple[str, Any]]:
    scores: dict[str, Score | None] = {"score": record.score, "animal_to_animal": record.animal_to_animal}
    scores |= {f"baselines.{name}": score for name, score in record.baselines.items()}
    for where, score in scores.items():
        if score is not None:
            yield from _leaves(where, {**to_plain(score), "provenance": {}})


STATED = ("synthetic", "card", "benchmark", "recordings", "statistics")
"""What pages show of a record beside its scores."""
_WORDS = ("method", "p_method", "reasons", "reason", "citation")  # another version words them otherwise
_APART = {"card": ("weights",), "recordings": ("source", "title", "skipped", "content_hash", "config_hash")}
"""Entries that are the user's, or are compared by themselves."""


def _claims(record: ResultRecord) -> Iterator[tuple[str, Any]]:
    """Yield what is stated of :data:`STATED`, by its place."""
    stated = {**to_plain(record.score.provenance), "synthetic": record.synthetic, "card": to_plain(record.card)}
    for name, apart in _APART.items():
        stated[name] = {key: value for key, value in (stated.get(name) or {}).items() if key not in apart}
    for name in STATED:
        yield from ((place, value) for place, value in _leaves(name, stated.get(name)) if value is not None)


def _leaves(where: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        layer = value.get("layer") if where.endswith("]") and "layer" in value and "subject" not in value else None
        for name, part in value.items():
            if name not in _WORDS:
                yield from _leaves(f"{where}.{name}" if layer is None else f"{where}({layer}).{name}", part)
    elif isinstance(value, list):
        for index, part in enumerate(value):
            yield from _leaves(f"{where}[{index}]", part)
    else:
        yield where, value


def _equal(left: Any, right: Any, tolerance: float) -> bool:
    numbers = all(isinstance(item, (int, float)) and not isinstance(item, bool) for item in (left, right))
    return abs(left - right) <= tolerance if numbers else left == right


def in_short(value: Any) -> str:
    """Write a statement of a record in few characters."""
    return f"{value:.5g}" if isinstance(value, float) else "none" if value is None else str(value)
