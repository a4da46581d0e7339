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

from brainbench.core.errors import BrainbenchError
from brainbench.datasets.checks.findings import Finding
from brainbench.datasets.layouts.registry import RecordingLayout
from brainbench.datasets.sessions import Session
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
_FEWEST = 20
# Longest span of spikes that is searched, s: 8.6 million bins, of which the correlation makes several arrays.
_LONGEST = 12 * 3600.0


def check_clock(
    session: Session, spikes: list[NDArray[np.float64]], layout: RecordingLayout | None
) -> Iterator[Finding]:
    """Yield what can be said about the clock of one session."""
    found = touches(session, layout)
    if found is None:
        message = "no touch times (tables contacts_by_whisker_*, or a layout's event), so the clock cannot be checked"
        yield Finding("note", "clock", message, "Look at spike rates around a known event before scoring.")
        return
    times, event = found
    every = np.concatenate(spikes) if spikes else np.zeros(0)
    span = float(np.ptp(every)) if len(every) else 0.0
    if len(every) and span <= _LONGEST:
        times = times[(times > every.min() - LARGEST) & (times < every.max() + LARGEST)]
    if len(times) < _FEWEST or len(every) < _FEWEST or span > _LONGEST:
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
