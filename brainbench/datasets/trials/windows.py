"""Windows in which responses are read: from one event of each trial to another."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_label
from brainbench.core.errors import DataError, UsageError, brief, unknown_name
from brainbench.core.reading.ranges import check_fields
from brainbench.datasets.sessions import Session, SessionTable

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


@dataclass(frozen=True)
class Window:
    """The part of each trial that is read, [anchor + offset, end), in seconds.

    An anchor is ``start``, ``stop``, ``choice`` (the trial table's start_time, stop_time and
    choice_time), ``first-contact`` or any column of the trial table that holds times. The end is
    ``length`` after the beginning, or ``stop`` + ``stop_offset``; with both, whichever comes first.

    ``first-contact`` is the earliest contact of any whisker (tables ``contacts_by_whisker_*``) that
    starts inside the trial and before the window's end.
    """

    anchor: str = "start"
    offset: float = 0.0
    stop: str | None = None
    stop_offset: float = 0.0
    length: float | None = None
    shortest_contact: float = 0.0
    """A contact counts if it lasts longer than this (s): rows of zero duration are empty intervals
    and do not. A negative value counts them too."""
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
        check_fields(self, "offset", "stop_offset", "shortest_contact", of="A window's {} (s)")
        check_fields(self, "length", above=0, of="A window's {} (s)")
        if self.stop is None and self.stop_offset:
            raise UsageError("stop_offset is after an event, and this window has no stop; give length alone.")
        if self.anchor != FIRST_CONTACT and (self.shortest_contact or self.fallback is not None):
            raise UsageError(f"shortest_contact and fallback are of a window from {FIRST_CONTACT!r}; leave them out.")
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
        lasting = end - begin > self.shortest_contact
        if not np.all(lasting):
            notes.append(f"{source}: {np.sum(~lasting)} of {len(begin)} contacts too brief to be the first")
        times = np.sort(begin[lasting])
        where = np.searchsorted(times, start, side="left")
        # The first contact not before the start of each trial; after the last contact of the session it is infinity.
        first = np.append(times, np.inf)[where]
        return np.where(first < until, first, np.nan)


WHOLE = Window("start", stop="stop")
"""The whole interval of each row."""


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
    return f"{'+' * (seconds > 0)}{as_label(float(seconds))}" if seconds else ""
