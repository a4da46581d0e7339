"""Check that spikes and behaviour share a clock: neurons answer touch within 5 to 30 ms.

The response to touch at a lag τ is the spike rate 5 to 30 ms after (touch + τ) minus the rate in the
60 ms before (touch + τ), averaged over touches. On a common clock it peaks at τ = 0; if spikes are
late by ten seconds, it peaks there. It is computed at all lags within ±10 minutes through one cross-correlation,
and judged against its own spread over lags (median absolute deviation).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import as_labels
from brainbench.core.errors import BrainbenchError, repeats
from brainbench.datasets.checks.findings import LONGEST_SESSION, Finding, Severity, share, some
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.counting import recorded_span
from brainbench.datasets.trials.windows import CONTACTS, FIRST_CONTACT, Window

BIN = 0.005
"""Resolution, s."""
RESPONSE = (0.005, 0.030)
"""Time after a touch in which neurons answer, s."""
BEFORE = 0.060
"""Baseline before it, s."""
LARGEST = 600.0
"""Largest shift that is searched for, s."""
CLEAR = 6.5
"""Standard deviations from which a response at any of 240,000 lags is taken for real; Poisson noise of
one to thirty units reached 6 in 450 sessions."""
PRESENT, ABSENT = 3.5, 2.5
"""Standard deviations from which, and below which, there is (not) a response at the touch itself; noise
exceeds the first in one session of 450."""
RHYTHM = 2.0
"""Time (s) around a first touch in which other touches are answered too."""
TOLERANCE = 0.020
"""Shift (s) up to which the clock is taken for right."""
_FEWEST_EVENTS = 20
# Longest span of spikes that is searched, s: 8.6 million bins, of which the correlation makes several arrays.
_LONGEST = 12 * 3600.0


def check_clock(
    session: Session, spikes: list[NDArray[np.float64]], layout: RecordingLayout | None
) -> Iterator[Finding]:
    """Yield what can be said about the clock of one session."""
    contacts = touches(session, layout)
    if contacts is None:
        message = "no touch times (tables contacts_by_whisker_*, or a layout's event), so the clock cannot be checked"
        yield Finding("note", "clock", message, "Look at spike rates around a known event before scoring.")
        return
    times, event = contacts
    every = np.concatenate(spikes) if spikes else np.zeros(0)
    span = float(np.ptp(every)) if len(every) else 0.0
    if len(every) and span <= _LONGEST:
        times = times[(times > every.min() - LARGEST) & (times < every.max() + LARGEST)]
    if len(times) < _FEWEST_EVENTS or len(every) < _FEWEST_EVENTS or span > _LONGEST:
        why = f"over {span / 3600:.0f} hours" if span > _LONGEST else "are too few"
        message = f"{len(times)} touches near the recording and {len(every)} spikes {why}: the clock was not checked"
        yield Finding("warning", "clock", message)
        return
    lags, response, size = response_by_lag(every, times)
    near = np.abs(lags) <= TOLERANCE
    at_touch = float(size[near].max())
    lag, elsewhere = _other_lag(lags, size, at_touch)
    values = {"event": event, "touches": len(times), "response_hz": float(response[near].max())}
    values |= {"sd_at_touch": at_touch, "lag": lag, "sd_at_lag": elsewhere}
    if lag:
        message = (
            f"spikes follow touch ({event}) by about {_seconds(lag)} s instead of 5 to 30 ms (response "
            f"{elsewhere:.0f} SD there, {at_touch:.1f} SD at the touch)"
        )
        yield Finding("error", "clock", message, _advice(session, lag), values)
    elif at_touch >= PRESENT:
        message = f"spikes answer touch ({event}) within 5 to 30 ms ({at_touch:.1f} SD, {len(times)} touches)"
        yield Finding("note", "clock", message, "", values)
    else:
        message = (
            f"no response to touch ({event}) stands out at any lag within ±{-lags[0]:.0f} s ({at_touch:.1f} SD at "
            f"the touch); the clock cannot be confirmed"
        )
        yield Finding("warning", "clock", message, "Few or untuned units, or a clock that drifts.", values)


def _other_lag(lags: NDArray[np.float64], size: NDArray[np.float64], at_touch: float) -> tuple[float, float]:
    """Return the lag (s) of a response that shows another clock and its size (SD); 0 if there is none.

    A first touch is followed by others, so a response up to ``RHYTHM`` away counts only if there is
    none at the touch itself, and one further away only if it is clearly larger than any nearby.
    """
    close = np.abs(lags) <= RHYTHM
    # In a recording of a few seconds all lags are close, and none is far.
    far = int(np.argmax(np.where(close, -np.inf, size))) if not close.all() else 0
    near = int(np.argmax(np.where(close, size, -np.inf)))
    if not close.all() and size[far] >= CLEAR and size[far] > 1.5 * size[near]:
        best = far
    elif size[near] >= CLEAR and at_touch < ABSENT:
        best = near
    else:
        return 0.0, 0.0
    # Later touches may be answered more; the first clear answer is that to the first touch.
    before = (lags >= lags[best] - RHYTHM) & (lags <= lags[best]) & (size >= 0.5 * size[best])
    return float(lags[np.flatnonzero(before)[0]]), float(size[best])


def touches(session: Session, layout: RecordingLayout | None) -> tuple[NDArray[np.float64], str] | None:
    """Return touch times (s) of a session and what they are, or None where it has none.

    First contacts of the trials if there are contact tables, else the event that the layout names.
    """
    trials = session.tables.get(layout.conditions.table if layout else "trials")
    contacts = any(CONTACTS.match(name) for name in session.tables)
    event = FIRST_CONTACT if contacts else layout.touch if layout else ""
    if trials is None or not event or (event == FIRST_CONTACT and not contacts):
        return None
    try:
        edges = Window(event, length=1.0).edges(session, trials, [])
    except BrainbenchError:
        return None
    return np.sort(edges[np.isfinite(edges[:, 0]), 0]), event


def response_by_lag(
    spikes: NDArray[np.float64], touches: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Cross-correlate touches and spikes.

    Returns lags [L] (s), response [L] (Hz, all units together), and its size [L] in robust standard deviations over
    lags.
    """
    from scipy.signal import fftconvolve

    # Room for the largest shift on both sides, so that every touch + lag lies on the grid.
    low = min(float(spikes.min()), float(touches[0])) - LARGEST - 1.0
    high = max(float(spikes.max()), float(touches[-1])) + LARGEST + 1.0
    number = int((high - low) / BIN) + 1
    # Rate of all units together in each bin, Hz.
    rate = np.bincount(((spikes - low) / BIN).astype(np.int64), minlength=number) / BIN
    after = np.zeros(number)
    begin, end = round(RESPONSE[0] / BIN), round(RESPONSE[1] / BIN)
    before = round(BEFORE / BIN)
    total = np.concatenate([[0.0], np.cumsum(rate)])
    index = np.arange(before, number - end)
    # Mean rate in RESPONSE after each bin less that in BEFORE, Hz: differences of running sums, for all bins at once.
    after[index] = (total[index + end] - total[index + begin]) / (end - begin)
    after[index] -= (total[index] - total[index - before]) / before
    events = np.bincount(((touches - low) / BIN).astype(np.int64), minlength=number).astype(np.float64)
    # The correlation at lag τ is the sum of ``after`` at touch + τ; lag 0 stands in the middle.
    correlation = fftconvolve(after, events[::-1], mode="full")
    # Further away, fewer than half of the touches would still fall into the recording.
    reach = round(min(LARGEST, 0.5 * float(np.ptp(spikes))) / BIN)
    lags = np.arange(-reach, reach + 1, dtype=np.float64) * BIN
    # Number of touches at each lag whose shifted time lies between the first and the last spike.
    first, last = np.searchsorted(touches, spikes.min() - lags), np.searchsorted(touches, spikes.max() - lags)
    inside = np.maximum(last - first, 1)
    response = correlation[number - 1 - reach : number + reach] / inside
    # A mean of fewer touches is noisier; at equal numbers the noise of all lags can be pooled.
    scaled = (response - np.median(response)) * np.sqrt(inside)
    # 1.4826 × the median absolute deviation is the standard deviation of normal noise; unlike that, it is not
    # widened by the few lags at which there is a response.
    spread = max(1.4826 * float(np.median(np.abs(scaled))), 1e-9)
    return lags, response, scaled / spread


def _advice(session: Session, lag: float) -> str:
    for series in session.series.values():
        if series.start and abs(abs(lag) - series.start) < 0.05:
            return (
                f"That is the starting_time of {series.name} ({series.start:g} s): it was "
                f"{'added' if lag > 0 else 'subtracted'} though spikes are on the session's clock already."
            )
    return f"Subtract about {_seconds(lag)} s from all spike times, or find out their clock, before scoring."


def _seconds(lag: float) -> str:
    """Write a lag (s) as exactly as it is known, which is the width of the response."""
    return f"{lag:+.1f}" if abs(lag) >= 1 else f"{lag:+.2f}"


Spikes = list[NDArray[np.float64]]

COINCIDENT = 2e-4
"""Spikes of two units this close (s) are taken for one: a spike lasts about a millisecond."""
SAME, SIMILAR = 0.95, 0.5
"""Share of the smaller unit's spikes that coincide with the other's, beyond chance."""
REFRACTORY = 1.5e-3
"""No neuron fires again within this time (s)."""
VIOLATIONS, MANY_VIOLATIONS = 0.01, 0.1
"""Share of intervals below the refractory time in a unit that is not one neuron, or no neuron at all."""
_FEWEST_SPIKES = 50
"""Spikes that a unit needs to be judged."""


def check_spikes(session: Session, spikes: Spikes) -> Iterator[Finding]:
    """Yield the findings about spike times [U] of one session."""
    ids = as_labels(session.units.ids()).tolist() if session.units is not None else []
    names = [f"unit {name}" for name in ids]
    yield from _silent(spikes, names)
    yield from _impossible(spikes, names)
    yield from _refractory(spikes, names)
    yield from _duplicates(spikes, names)
    if repeated := repeats(ids):
        message = f"{len(repeated)} unit ids occur more than once ({some(repeated)})"
        yield Finding("warning", "units", message, "Fine for several probes; else units were merged wrongly.")


def _silent(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    silent = [name for name, times in zip(names, spikes, strict=True) if not len(times)]
    if silent:
        message = f"{share(len(silent), len(names))} units have no spike ({some(silent)})"
        advice, values = "They are left out unless the selection says otherwise.", {"silent": len(silent)}
        severity: Severity = "error" if len(silent) == len(names) else "note"
        yield Finding(severity, "silent", message, advice, {**values, "units": len(names)})


def _impossible(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    span = recorded_span(spikes)
    if span is None:
        return
    low, high = span
    if low < 0:
        early = [name for name, times in zip(names, spikes, strict=True) if len(times) and times[0] < 0]
        message = f"{share(len(early), len(names))} units have spikes before the session began (first at {low:.3f} s)"
        yield Finding("warning", "times", message, "Was a starting time subtracted twice?", {"first": low})
    # Times in seconds hardly ever fall on whole numbers, numbers of samples always do.
    whole = all(np.all(times == np.round(times)) for times in spikes)
    if whole and sum(map(len, spikes)) >= _FEWEST_SPIKES:
        message = f"all spike times are whole numbers, up to {high:g}"
        yield Finding("error", "times", message, "They look like samples, not seconds: divide by the sampling rate.")
    elif high - low > LONGEST_SESSION:
        message = f"spikes span {(high - low) / 3600:.0f} hours ({low:g} to {high:g} s)"
        yield Finding("error", "times", message, "They look like milliseconds or samples, not seconds.")


def _refractory(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    rates = {
        name: float(np.mean(np.diff(times) < REFRACTORY))
        for name, times in zip(names, spikes, strict=True)
        if len(times) >= _FEWEST_SPIKES
    }
    bands: tuple[tuple[Severity, float, float, str], ...] = (
        ("error", MANY_VIOLATIONS, np.inf, "These are no single neurons: exclude them or sort again."),
        ("warning", VIOLATIONS, MANY_VIOLATIONS, "They mix neurons; RDMs stand, claims about single neurons do not."),
    )
    for severity, low, high, advice in bands:
        bad = {name: rate for name, rate in rates.items() if low <= rate < high}
        if bad:
            examples = some(
                [f"{name}: {100 * bad[name]:.1f} %" for name in sorted(bad, key=lambda name: -bad[name])], 3
            )
            message = f"{share(len(bad), len(names))} units fire again within {1e3 * REFRACTORY:g} ms ({examples})"
            yield Finding(severity, "refractory", message, advice, {"share": bad})


def _duplicates(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    pairs_alike = coincidences(spikes)
    bands: tuple[tuple[Severity, float, float, str], ...] = (
        ("error", SAME, np.inf, "Remove one of each pair: twins count twice in every RDM."),
        ("warning", SIMILAR, SAME, "Was one neuron split, or sorted on two channels? Twins count twice in every RDM."),
    )
    for severity, low, high, advice in bands:
        pairs = [(one, two, part) for one, two, part in pairs_alike if low <= part < high]
        if pairs:
            examples = some([f"{names[one]} = {names[two]}: {100 * part:.0f} %" for one, two, part in pairs], 3)
            what = f"{len(pairs)} pair{'s' * (len(pairs) > 1)} of units"
            message = f"{what} have the same spikes within {1e3 * COINCIDENT:g} ms ({examples})"
            values = {"pairs": [[names[one], names[two], part] for one, two, part in pairs]}
            yield Finding(severity, "duplicates", message, advice, values)


def coincidences(spikes: Spikes) -> list[tuple[int, int, float]]:
    """Find pairs of units whose spikes coincide more than chance.

    Every spike is compared with the next ones of all units together, so the cost grows with the number of spikes and
    not with that of pairs. Returns (unit, unit, share of the smaller one's spikes beyond chance) of all pairs above
    ``SIMILAR``.
    """
    lengths = np.array([len(times) for times in spikes])
    judged = np.flatnonzero(lengths >= _FEWEST_SPIKES)
    if len(judged) < 2:
        return []
    times = np.concatenate([spikes[unit] for unit in judged])
    units = np.repeat(judged, lengths[judged])
    order = np.argsort(times, kind="stable")
    times, units = times[order], units[order]
    size = len(spikes)
    codes, step = [], 1
    while step < len(times):
        # Times are sorted: once no two spikes `step` places apart are close, none further apart are.
        near = np.flatnonzero(times[step:] - times[:-step] <= COINCIDENT)
        if not len(near):
            break
        left, right = units[near], units[near + step]
        distinct = left != right
        # One number per pair of units in either order; how often it occurs is how often they coincide.
        codes.append(np.minimum(left, right)[distinct] * size + np.maximum(left, right)[distinct])
        step += 1
    if not codes:
        return []
    pairs, number = np.unique(np.concatenate(codes), return_counts=True)
    left, right = pairs // size, pairs % size
    fewer, more = np.minimum(lengths[left], lengths[right]), np.maximum(lengths[left], lengths[right])
    span = max(float(times[-1] - times[0]), COINCIDENT)
    # An unrelated train of n spikes in T seconds has one within ±δ of a given time with probability 2 δ n/T or so.
    chance = np.minimum(2 * COINCIDENT * more / span, 1.0)
    # Corrected for chance as Cohen's kappa (1960) is: about 0 for unrelated units, 1 where every spike coincides.
    part = (number / fewer - chance) / np.maximum(1 - chance, 1e-9)
    similar = np.flatnonzero(part >= SIMILAR)
    similar = similar[np.argsort(-part[similar], kind="stable")]
    return [(int(left[index]), int(right[index]), float(min(part[index], 1.0))) for index in similar]
