"""Checks of the units: silent ones, the same unit twice, refractory violations, impossible times."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import repeats
from brainbench.datasets.checks.findings import LONGEST_SESSION, Finding, Severity, share, some
from brainbench.datasets.sessions import Session, as_labels
from brainbench.datasets.trials.counting import recorded_span

Spikes = list[NDArray[np.float64]]

COINCIDENT = 2e-4
"""Spikes of two units this close (s) are taken for one: a spike lasts about a millisecond."""
SAME, SIMILAR = 0.95, 0.5
"""Share of the smaller unit's spikes that coincide with the other's, beyond chance."""
REFRACTORY = 1.5e-3
"""No neuron fires again within this time (s)."""
VIOLATIONS, MANY_VIOLATIONS = 0.01, 0.1
"""Share of intervals below the refractory time in a unit that is not one neuron, or no neuron at all."""
_FEWEST = 50
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
    if whole and sum(map(len, spikes)) >= _FEWEST:
        message = f"all spike times are whole numbers, up to {high:g}"
        yield Finding("error", "times", message, "They look like samples, not seconds: divide by the sampling rate.")
    elif high - low > LONGEST_SESSION:
        message = f"spikes span {(high - low) / 3600:.0f} hours ({low:g} to {high:g} s)"
        yield Finding("error", "times", message, "They look like milliseconds or samples, not seconds.")


def _refractory(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    rates = {
        name: float(np.mean(np.diff(times) < REFRACTORY))
        for name, times in zip(names, spikes, strict=True)
        if len(times) >= _FEWEST
    }
    bands: tuple[tuple[Severity, float, float, str], ...] = (
        ("error", MANY_VIOLATIONS, np.inf, "These are no single neurons: exclude them or sort again."),
        ("warning", VIOLATIONS, MANY_VIOLATIONS, "They mix neurons; RDMs stand, claims about single neurons do not."),
    )
    for severity, low, high, advice in bands:
        bad = {name: rate for name, rate in rates.items() if low <= rate < high}
        if bad:
            shown = some([f"{name}: {100 * bad[name]:.1f} %" for name in sorted(bad, key=lambda name: -bad[name])], 3)
            message = f"{share(len(bad), len(names))} units fire again within {1e3 * REFRACTORY:g} ms ({shown})"
            yield Finding(severity, "refractory", message, advice, {"share": bad})


def _duplicates(spikes: Spikes, names: list[str]) -> Iterator[Finding]:
    found = coincidences(spikes)
    bands: tuple[tuple[Severity, float, float, str], ...] = (
        ("error", SAME, np.inf, "Remove one of each pair: twins count twice in every RDM."),
        ("warning", SIMILAR, SAME, "Was one neuron split, or sorted on two channels? Twins count twice in every RDM."),
    )
    for severity, low, high, advice in bands:
        pairs = [(one, two, part) for one, two, part in found if low <= part < high]
        if pairs:
            shown = some([f"{names[one]} = {names[two]}: {100 * part:.0f} %" for one, two, part in pairs], 3)
            what = f"{len(pairs)} pair{'s' * (len(pairs) > 1)} of units"
            message = f"{what} have the same spikes within {1e3 * COINCIDENT:g} ms ({shown})"
            values = {"pairs": [[names[one], names[two], part] for one, two, part in pairs]}
            yield Finding(severity, "duplicates", message, advice, values)


def coincidences(spikes: Spikes) -> list[tuple[int, int, float]]:
    """Find pairs of units whose spikes coincide more than chance.

    Every spike is compared with the next ones of all units together, so the cost grows with the number of spikes and
    not with that of pairs. Returns (unit, unit, share of the smaller one's spikes beyond chance) of all pairs above
    ``SIMILAR``.
    """
    lengths = np.array([len(times) for times in spikes])
    judged = np.flatnonzero(lengths >= _FEWEST)
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
        one, two = units[near], units[near + step]
        other = one != two
        # One number per pair of units in either order; how often it occurs is how often they coincide.
        codes.append(np.minimum(one, two)[other] * size + np.maximum(one, two)[other])
        step += 1
    if not codes:
        return []
    pairs, number = np.unique(np.concatenate(codes), return_counts=True)
    one, two = pairs // size, pairs % size
    fewer, more = np.minimum(lengths[one], lengths[two]), np.maximum(lengths[one], lengths[two])
    span = max(float(times[-1] - times[0]), COINCIDENT)
    # An unrelated train of n spikes in T seconds has one within ±δ of a given time with probability 2 δ n/T or so.
    chance = np.minimum(2 * COINCIDENT * more / span, 1.0)
    # Corrected for chance as Cohen's kappa (1960) is: about 0 for unrelated units, 1 where every spike coincides.
    part = (number / fewer - chance) / np.maximum(1 - chance, 1e-9)
    kept = np.flatnonzero(part >= SIMILAR)
    kept = kept[np.argsort(-part[kept], kind="stable")]
    return [(int(one[index]), int(two[index]), float(min(part[index], 1.0))) for index in kept]
