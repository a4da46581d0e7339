"""What is read: labels of trials and their fixed order, rules that select trials and units, and windows."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import SequenceMatcher
from itertools import combinations
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core import contracts
from brainbench.core.errors import DataError, UsageError, brief, check_once, listing, nearest, repeats, unknown_name
from brainbench.core.limits import Limit, limited
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import Session, SessionTable


@dataclass(frozen=True)
class Conditions:
    """Columns of an interval table whose values, joined with "-", label each trial."""

    table: str
    columns: tuple[str, ...]

    @classmethod
    def parse(cls, source: str) -> Conditions:
        """Read ``TABLE:COLUMN[,COLUMN…]``.

        >>> Conditions.parse("trials:stimulus,servo_position").columns
        ('stimulus', 'servo_position')
        """
        table, colon, rest = source.rpartition(":")
        columns = tuple(item.strip() for item in rest.split(","))
        if not colon or not table.strip() or not all(columns):
            raise UsageError(
                f"The conditions {brief(source)} cannot be read; write TABLE:COLUMN or TABLE:COLUMN,COLUMN, such as "
                f"'trials:stimulus'. `brainbench recordings inspect FILE` proposes some."
            )
        check_once(f"The text {brief(source)} for the conditions", columns)
        return cls(table.strip(), columns)

    def __str__(self) -> str:
        return f"{self.table}:{','.join(self.columns)}"

    def values(self, table: SessionTable) -> NDArray[np.str_]:
        """Return the condition values of every row as text [rows, columns]; "" where missing."""
        return np.stack([contracts.as_labels(table.column(name)) for name in self.columns], axis=1)

    def forms(self, table: SessionTable) -> dict[tuple[str, str], set[str]]:
        """Return how the file writes each value: (column, its label) → the forms, of which most values have one."""
        forms: dict[tuple[str, str], set[str]] = {}
        for name in self.columns:
            values = np.unique(table.column(name))
            for value, label in zip(values.tolist(), contracts.as_labels(values).tolist(), strict=True):
                written = ascii(value) if isinstance(value, str) else repr(value)
                if isinstance(value, (int, float)) and abs(value) < 2**53:
                    written = repr(float(value))
                forms.setdefault((name, label), set()).add(written)
        return forms


def label_doubts(forms: Mapping[tuple[str, str], Collection[str]], vocabulary: Iterable[str]) -> Iterator[str]:
    """Say which labels were merged, which differ by little, and which may be missing values.

    Args:
        forms: (column, label) → how files write it, joined over all files.
        vocabulary: all labels that have trials.
    """
    merged = [(name, label, sorted(written)) for (name, label), written in forms.items() if label and len(written) > 1]
    if merged:
        texts = (f"{label} of {name} ({', '.join(written[:3])})" for name, label, written in merged)
        yield f"values that are written differently count as one label: {listing(texts, limit=3, quoted=False)}"
    if near := [listing(twins) for twins in contracts.near_labels(vocabulary)]:
        texts = "; ".join(near[:3]) + f" and {len(near) - 3} more" * (len(near) > 3)
        yield f"labels that differ only in case, blanks, signs or digits count as different stimuli: {texts}"
    words = sorted({part for label in vocabulary for part in (label, *label.split("-")) if contracts.is_doubtful(part)})
    if words:
        yield f"the label {listing(words)} may mean a missing value, and counts as a stimulus"


def divided_labels(pairs: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Say which labels, of pairs (animal, label), differ in one letter and are in no animal both: misspelt ones."""
    animals: dict[str, set[str]] = {}
    for animal, label in pairs:
        animals.setdefault(label, set()).add(animal)
    everyone = set[str]().union(*animals.values())
    partial = sorted(label for label, names in animals.items() if len(label) > 2 and names != everyone)
    for left, right in combinations(partial, 2):
        letters, others = (re.sub(r"\d", "", label).lower() for label in (left, right))
        near = SequenceMatcher(None, left, right).ratio() >= 1 - 1 / min(len(left), len(right))
        if near and letters != others and max(len(left), len(right)) > 3 and not animals[left] & animals[right]:
            yield f"{left!r} and {right!r} are spelt alike and in no animal both, and count as different stimuli"


def joined_labels(values: NDArray[np.str_]) -> list[str]:
    """Return the label of each row of condition values [rows, columns]; "" where any value is missing."""
    return ["-".join(row) if all(row) else "" for row in values.tolist()]


def natural_vocabulary(values: Iterable[tuple[str, ...]]) -> tuple[str, ...]:
    """Order the labels of condition values: column by column, numbers numerically, text naturally."""
    # Sorted, not in order of appearance: that depends on the session that comes first, and RDMs would not share axes.
    ordered = sorted(set(values), key=lambda row: [contracts.natural_key(item) for item in row])
    labels = ["-".join(row) for row in ordered]
    if twice := repeats(labels):
        raise DataError(f"Two combinations of condition values both read {twice[0]!r}; choose fewer columns.")
    return tuple(labels)


_TRUTH = (("true", "1"), ("false", "0"))
_RULE = re.compile(r"^\s*(?:(?P<scope>trials|units)\.)?(?P<column>[^=!<>]+?)\s*(?P<sign>!=|=)\s*(?P<values>.+?)\s*$")
_RANGE = re.compile(r"^(?P<low>[-+.\deE]*)\.\.(?P<high>[-+.\deE]*)$")


@limited(of="{} of a rule")
class Rule:
    """One condition on one column; rows that fail it are removed and counted.

    Values are compared as labels: ``1`` and ``1.0`` agree, and ``true`` and ``1``; texts of one column stay apart.
    A row without a value fails ``allow``, ``low`` and ``high`` and passes ``refuse``, unless the value is ``nan``.
    """

    column: str
    allow: tuple[str, ...] = ()
    """Keep only rows with one of these values."""
    refuse: tuple[str, ...] = ()
    """Remove rows with one of these values."""
    low: float | None = None
    """Smallest value kept."""
    high: float | None = None
    """Largest value kept."""
    required: bool = True
    """False: a table without the column passes, and the result says that the rule did not apply."""

    def __post_init__(self) -> None:
        values = (*self.allow, *self.refuse)
        if not all(values) or (not values and self.low is None and self.high is None):
            raise UsageError(f"The rule on {self.column!r} has an empty value; write a|b or low..high.")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise UsageError(f"The rule {self} keeps nothing: the lower end of a range stands first.")

    def __str__(self) -> str:
        parts = []
        if self.allow:
            parts.append(f"{self.column}={'|'.join(self.allow)}")
        if self.refuse:
            parts.append(f"{self.column}!={'|'.join(self.refuse)}")
        if self.low is not None or self.high is not None:
            low, high = ("" if bound is None else contracts.as_label(float(bound)) for bound in (self.low, self.high))
            parts.append(f"{self.column}={low}..{high}")
        return " and ".join(parts)

    def keep(self, table: SessionTable, seen: dict[Hashable, set[str]] | None = None) -> NDArray[np.bool_] | None:
        """Return which rows of ``table`` pass [rows], or None where an optional column is absent.

        ``seen`` takes the values that the column has, and those of the rule that some row has in another spelling, for
        :func:`check_values`.
        """
        if self.column not in table:
            if self.required:
                table.require(self.column)
            return None
        values = table.column(self.column)
        labels = contracts.as_labels(values)
        if seen is not None and (self.allow or self.refuse):
            seen.setdefault(self, set()).update(labels.tolist())
        labels = np.char.lower(labels)
        present = {*labels.tolist()}
        has = {
            value: np.isin(labels, _spellings(value, values.dtype, present)) for value in (*self.allow, *self.refuse)
        }
        if seen is not None:
            seen.get(self, set()).update(value for value, rows in has.items() if rows.any())
        keep = np.ones(len(labels), dtype=bool)
        if self.allow:
            keep &= np.any([has[value] for value in self.allow], axis=0)
        if self.refuse:
            keep &= ~np.any([has[value] for value in self.refuse], axis=0)
        if self.low is not None or self.high is not None:
            numbers = table.times(self.column)
            # Comparisons with NaN are false, so a row without a value fails even a bound that is open.
            keep &= numbers >= (-np.inf if self.low is None else self.low)
            keep &= numbers <= (np.inf if self.high is None else self.high)
        return keep


@limited
class Selection:
    """Rules for trials and units. Each row is counted under the first rule that removes it."""

    trials: tuple[Rule, ...] = ()
    units: tuple[Rule, ...] = ()
    min_spikes: Annotated[int, Limit(least=0)] = 1
    """A unit needs this many spikes in its file; 0 keeps silent units."""
    subjects: tuple[str, ...] = ()
    """Keep only these subjects; empty keeps all."""
    name: str = "custom"

    @classmethod
    def parse(cls, source: str) -> Selection:
        """Read a selection from text, as the command line takes it.

        Rules are separated by ``;``. ``COLUMN=a|b`` keeps values, ``COLUMN!=a|b`` removes them,
        ``COLUMN=low..high`` keeps a range; a column is of the trial table unless it starts with
        ``units.``. ``min_spikes=N`` and ``subjects=a|b`` are their own rules.

        >>> Selection.parse("outcome=correct|error; units.layer=4; min_spikes=50").min_spikes
        50
        """
        trials: list[Rule] = []
        units: list[Rule] = []
        rule_texts: list[str] = []
        selection = cls(name=source.strip())
        if not source.strip(" ;"):
            raise UsageError(f"The selection {brief(source)} states no rule; leave it out for the usual one.")
        for part in filter(None, (item.strip() for item in source.split(";"))):
            match = _RULE.match(part)
            if match is None:
                raise UsageError(
                    f"The selection rule {brief(part)} cannot be read; write COLUMN=a|b, COLUMN!=a|b or "
                    f"COLUMN=low..high, with units. before columns of the units table, and ';' between rules."
                )
            column, values = match["column"], match["values"]
            if match["scope"] is None and column in ("min_spikes", "subjects"):
                rule_texts.append(column)
                if match["sign"] != "=":
                    raise UsageError(f"{column} is written {column}=…, and cannot be refused; received {brief(part)}.")
            if column == "min_spikes":
                if not (values.isdecimal() and len(values) < 16):
                    raise UsageError(f"min_spikes is a whole number from 0; received {brief(values)}.")
                selection = replace(selection, min_spikes=int(values))
            elif column == "subjects":
                if not all(subjects := _values(values)):
                    raise UsageError(f"subjects are names with | between them; received {brief(values)}.")
                selection = replace(selection, subjects=subjects)
            else:
                rule = _rule(column, match["sign"], values)
                (units if match["scope"] == "units" else trials).append(rule)
        check_once("The selection", rule_texts)
        return replace(selection, trials=tuple(trials), units=tuple(units))

    def __str__(self) -> str:
        """Return its name, or the text from which :meth:`parse` reads its rules."""
        rules = [*map(str, self.trials), *(f"units.{rule}" for rule in self.units), f"min_spikes={self.min_spikes}"]
        rules += [f"subjects={'|'.join(self.subjects)}"] if self.subjects else []
        return "; ".join(rules) if self.name == type(self).name else self.name

    def lines(self) -> Iterator[str]:
        """Yield every rule, one line each."""
        yield from (f"trials: {rule}" for rule in self.trials)
        yield from (f"units: {rule}" for rule in self.units)
        if self.min_spikes:
            yield f"units: at least {self.min_spikes} spike{'s' * (self.min_spikes > 1)} in the file"
        if self.subjects:
            yield f"subjects: {', '.join(self.subjects)}"


EVERYTHING = Selection(min_spikes=0, name="none")  # no rule at all, silent units included
DEFAULT = Selection(name="default")  # all trials; units with at least one spike


def select_rows(table: SessionTable, rules: Sequence[Rule], kind: str, ledger: Ledger) -> NDArray[np.bool_]:
    """Apply rules in order to all rows of a table of ``trials`` or ``units``; returns which remain [rows]."""
    keep = np.ones(len(table), dtype=bool)
    for rule in rules:
        passes = rule.keep(table, ledger.seen)
        if passes is None:
            ledger.doubts.append(f"{table.label}: no column {rule.column!r}, so the rule {rule} did not apply")
        else:
            keep = ledger.apply(keep, passes, kind, str(rule))
    return keep


def check_values(ledger: Ledger) -> list[str]:
    """Check the values of rules against those of all sessions, whose balance a ledger is.

    Returns:
        A note for each value to remove that no row has but that is spelt nearly as one that rows have.
    """
    notes = []
    for rule, values in ledger.seen.items():
        assert isinstance(rule, Rule)
        present = sorted(values - {""}, key=contracts.natural_key)
        for value in (*rule.allow, *rule.refuse):
            if value in values:
                continue
            if value in rule.allow:
                raise unknown_name(f"{rule.column} value", value, present)
            if guess := nearest(value, present):
                notes.append(f"no row has the value {value!r} that the rule {rule} removes; did you mean {guess!r}?")
    return notes


def _spellings(value: str, dtype: np.dtype[Any], present: Collection[str]) -> list[str]:
    """Return the texts, in lower case, that rows of a column may have for the value of a rule; NaN is a missing one."""
    spellings = [value.lower()]
    if dtype.kind == "U":
        spellings += [] if value.lower() in present else [contracts.as_label(value).lower()]
    elif math.isfinite(number := contracts.as_number(value)) or value.lower() in contracts.MISSING_WORDS:
        spellings.append(contracts.as_label(number))
    return spellings + [one for pair in _TRUTH for one in pair if {*pair} & {*spellings}]


def _rule(column: str, sign: str, values: str) -> Rule:
    span = _RANGE.match(values)
    if span is None:
        return Rule(column, allow=_values(values)) if sign == "=" else Rule(column, refuse=_values(values))
    if sign == "!=":
        raise UsageError(f"A range cannot be refused ({column}!={values}); state the range to keep.")
    return Rule(column, low=_number(span["low"]), high=_number(span["high"]))


def _values(source: str) -> tuple[str, ...]:
    return tuple(item.strip() for item in source.split("|"))


def _number(source: str) -> float | None:
    try:
        if source and not math.isfinite(float(source)):
            raise ValueError("not finite")
        return float(source) if source else None
    except ValueError as error:
        raise UsageError(f"{brief(source)} is not a number; a range is written low..high.") from error


FIRST_CONTACT = "first-contact"
CONTACTS = re.compile(r"^(?:.*/)?contacts_by_whisker_(?P<whisker>\w+)$")
"""Names of the interval tables that hold one whisker's contacts."""
_ANCHORS = {"start": "start_time", "stop": "stop_time", "choice": "choice_time"}
# The name is matched lazily, so that it may hold a hyphen (first-contact) and yet leaves a signed number at the end.
_EDGE = re.compile(r"(?P<name>.*?)(?P<offset>[+-](\d+\.?\d*|\.\d+)(e[+-]?\d+)?)?", re.IGNORECASE | re.DOTALL)
_NO_NAME = re.compile(r"[+−–]|\.\.|^-|-(inf|infinity|nan)$", re.IGNORECASE)
"""Signs of a number that was not read: no event has them in its name."""

_BAND = re.compile(r"(?P<low>\d*\.?\d+)\.\.(?P<high>\d*\.?\d+)")
_UNITS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}
_WITH_UNIT = re.compile(r"(?P<number>[+-]\d*\.?\d+) ?(?P<unit>s|sec|ms|us|µs)$", re.IGNORECASE)


@limited(of="A window's {}")
class Window:
    """The part of each trial that is read, [anchor + offset, end), in seconds.

    An anchor is ``start``, ``stop``, ``choice`` (the trial table's start_time, stop_time and
    choice_time), ``first-contact`` or any column of the trial table that holds times. The end is
    ``length`` after the beginning, or ``stop`` + ``stop_offset``; with both, whichever comes first.

    ``first-contact`` is the earliest contact of any whisker (tables ``contacts_by_whisker_*``) that
    starts inside the trial and before the window's end.
    """

    anchor: str = "start"
    offset: Annotated[float, Limit(unit="s")] = 0.0
    stop: str | None = None
    stop_offset: Annotated[float, Limit(unit="s")] = 0.0
    length: Annotated[float, Limit(above=0, unit="s")] | None = None
    fallback: Window | None = None
    """Used for all trials of a session that has no contact tables at all, and said in the notes."""
    baseline: Window | None = None
    """Its mean is taken from that of the window: rates of spikes, or a signal."""
    signal: str = ""
    """Place of the signal that is read, such as ``DfOverF``; by default spikes, else the only signal."""
    band: tuple[float, float] | None = None
    """Power of the signal in this band (Hz), for voltages."""

    def __post_init__(self) -> None:
        if self.stop is None and self.length is None:
            raise UsageError(f"The window from {self.anchor!r} has no end; give stop (an anchor) or length (s).")
        if self.stop is None and self.stop_offset:
            raise UsageError("stop_offset is after an event, and this window has no stop; give length alone.")
        if self.anchor != FIRST_CONTACT and self.fallback is not None:
            raise UsageError(f"A fallback is of a window from {FIRST_CONTACT!r}; leave it out.")
        if self.stop == FIRST_CONTACT:
            raise UsageError("A window cannot end at the first contact, which is sought before its end.")
        if self.baseline is not None and (self.baseline.baseline or self.baseline.signal or self.baseline.band):
            raise UsageError("A baseline is a plain window, with neither a baseline nor a signal of its own.")
        if self.band is not None and not 0 < self.band[0] < self.band[1] < np.inf:
            raise UsageError(f"A band is two frequencies above 0 Hz, the lower first; received {brief(self.band)}.")

    @classmethod
    def parse(cls, source: str) -> Window:
        """Read a window from text ``FROM[±s]..TO[±s]``, ``FROM[±s]..+LENGTH`` or ``FROM[±s]..TO[±s] or +LENGTH``.

        `` minus WINDOW`` behind it names a baseline, and `` of SIGNAL``, `` of SIGNAL@LOW..HIGH`` or `` of @LOW..HIGH``
        (Hz) what is read.

        >>> str(Window.parse("first-contact..choice"))
        'first-contact..choice'
        >>> Window.parse("start+0.2..+0.5").length
        0.5
        >>> Window.parse("start..+0.5 minus start-0.5..start of LFP@70..150").band
        (70.0, 150.0)
        """
        source, of, signal = source.partition(" of ")
        source, minus, baseline = source.partition(" minus ")
        if minus or of:
            place, at, frequencies = (part.strip() for part in signal.partition("@"))
            band = _BAND.fullmatch(frequencies)
            if (of and not place and not band) or (at and not band):
                raise UsageError(
                    f"The signal {brief(signal)} of a window cannot be read; write its place in the file and, of "
                    "voltages, a band in Hz, such as 'DfOverF', 'LFP@70..150' or '@70..150'."
                )
            return replace(
                cls.parse(source),
                baseline=cls.parse(baseline) if minus else None,
                signal=place,
                band=(float(band["low"]), float(band["high"])) if band else None,
            )
        first, dots, last = (part.strip() for part in source.partition(".."))
        last, _, most = (part.strip() for part in last.partition(" or "))
        if with_unit := _WITH_UNIT.search(first) or _WITH_UNIT.search(last):
            seconds = float(with_unit["number"]) * _UNITS[with_unit["unit"].lower()]
            raise UsageError(
                f"The window {brief(source)} has a time with a unit, {with_unit[0]!r}; times are seconds without a "
                f"unit, here {seconds:+g}."
            )
        (anchor, offset), (stop, stop_offset), (most_anchor, length) = map(_edge, (first, last, most))
        if not dots or not anchor or not last or most_anchor or (most and not stop):
            raise UsageError(
                f"The window {brief(source)} cannot be read; write FROM..TO or FROM..+SECONDS, such as "
                f"'first-contact..choice' or 'start+0.2..+0.5'."
            )
        for name in (anchor, stop):
            if _NO_NAME.search(name):
                raise UsageError(
                    f"The window {brief(source)} has {brief(name)} where an event stands, such as 'choice', or a "
                    f"finite number of seconds after its sign, such as 'choice-0.5' or '+0.5'."
                )
        if not stop:
            return cls(anchor, float(offset or 0), length=float(stop_offset))
        longest = float(length) if length else None
        return cls(anchor, float(offset or 0), stop, float(stop_offset or 0), longest)

    def __str__(self) -> str:
        ends = [f"{self.stop}{_signed(self.stop_offset)}"] if self.stop else []
        ends += [_signed(self.length)] if self.length is not None else []
        more = f" minus {self.baseline}" if self.baseline else ""
        band = f"@{self.band[0]:g}..{self.band[1]:g}" if self.band else ""
        more += f" of {self.signal}{band}" if self.signal or band else ""
        return f"{self.anchor}{_signed(self.offset)}..{' or '.join(ends)}{more}"

    def edges(self, session: Session, table: SessionTable, notes: list[str]) -> NDArray[np.float64]:
        """Return begin and end of the window of every row [rows, 2] (s); NaN where an event is missing."""
        contacts = {name: item for name, item in session.tables.items() if CONTACTS.match(name)}
        if self.anchor == FIRST_CONTACT and not contacts:
            if self.fallback is None:
                raise DataError(
                    f"{session.source} has no tables contacts_by_whisker_*, so there is no first contact; choose "
                    f"another window, such as 'start..stop'."
                )
            notes.append(f"{session.source}: no contact tables; window {self.fallback} for its {len(table)} trials")
            return self.fallback.edges(session, table, notes)
        limit = np.full(len(table), np.inf)
        if self.stop is not None:
            limit = _event(table, self.stop) + self.stop_offset
        if self.anchor == FIRST_CONTACT:
            # fmin skips NaN: without the event at the end, contacts are sought until the trial stops.
            until = np.fmin(limit, _event(table, "stop")) if "stop_time" in table else limit
            begin = self._first_contacts(session.source, contacts, _event(table, "start"), until, notes)
        else:
            begin = _event(table, self.anchor)
        begin = begin + self.offset
        if self.length is not None:
            # minimum keeps NaN: where the event at the end is missing, the row has no window at all.
            limit = np.minimum(limit, begin + self.length)
        return np.stack([begin, limit], axis=1)

    def _first_contacts(
        self,
        source: str,
        contacts: dict[str, SessionTable],
        start: NDArray[np.float64],
        until: NDArray[np.float64],
        notes: list[str],
    ) -> NDArray[np.float64]:
        begin = np.concatenate([table.times("start_time") for table in contacts.values()])
        end = np.concatenate([table.times("stop_time") for table in contacts.values()])
        lasting = end > begin  # rows of zero duration are empty intervals
        if not np.all(lasting):
            notes.append(f"{source}: {np.sum(~lasting)} of {len(begin)} contacts too brief to be the first")
        times = np.sort(begin[lasting])
        where = np.searchsorted(times, start, side="left")
        # The first contact not before the start of each trial; after the last contact of the session it is infinity.
        first = np.append(times, np.inf)[where]
        return np.where(first < until, first, np.nan)


WHOLE = Window("start", stop="stop")  # the whole interval of each row


def _event(table: SessionTable, anchor: str) -> NDArray[np.float64]:
    column = _ANCHORS.get(anchor, anchor)
    if column not in table:
        anchors = [name for name, other in _ANCHORS.items() if other in table]
        raise unknown_name(f"event of a window in {table.label}", anchor, (*anchors, FIRST_CONTACT, *table.columns))
    return table.times(column)


def _edge(text: str) -> tuple[str, str]:
    """Return the name of an event and the signed number behind it; either may be empty."""
    match = _EDGE.fullmatch(text)
    assert match is not None, text
    return match["name"], match["offset"] or ""


def _signed(seconds: float) -> str:
    return f"{'+' if seconds > 0 else ''}{contracts.as_label(float(seconds))}" if seconds else ""
