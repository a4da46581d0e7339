"""Whiskers that are simulated again come to what the rule says."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.stimuli.engines.rod.launch import run_with_retries
from brainbench.stimuli.engines.trust import LARGEST_STRUCK_CHANGE, Verdict, halved

FINE, SUSPICIOUS, STRUCK, MENDABLE, HOPELESS = range(5)
DIVISORS = [1, 2, 3, 4, 5, 6, 8, 10, 12, 20]
FATES = st.fixed_dictionaries({divisor: st.tuples(st.integers(FINE, HOPELESS), st.booleans()) for divisor in DIVISORS})
"""What a whisker comes to with steps over each of these, and which of two forces it has then."""


class _Runs:
    """Whiskers simulated with fates that are known."""

    def __init__(self, fates, finer):
        found = [fate[finer] for fate in fates]
        self.state, self.force = (np.array(values, dtype=int) for values in (zip(*found, strict=True)))
        self.finer, self.steps = np.full(len(fates), finer), np.full(len(fates), 100 * finer)
        bad = self.state >= MENDABLE
        words = np.where(bad, f"bad at {finer}", "").astype(object)
        allowed = np.select([self.state == SUSPICIOUS, self.state == STRUCK], [0.2, LARGEST_STRUCK_CHANGE], np.inf)
        self.verdict = Verdict(np.where(bad, 0.0, np.inf), self.state == MENDABLE, words, allowed)

    def _arrays(self):
        return {"force": self.force, "finer": self.finer, "steps": self.steps, **vars(self.verdict)}

    def picked(self, which):
        some = object.__new__(_Runs)
        values = {name: array[which] for name, array in self._arrays().items()}
        some.force, some.finer, some.steps = (values.pop(name) for name in ("force", "finer", "steps"))
        some.verdict = Verdict(**values)
        self.steps[which] = 0
        return some

    def replaced(self, which, finer):
        finer.steps += self.steps[which]
        for name, array in self._arrays().items():
            array[which] = finer._arrays()[name]
        return self

    def compared(self, which, half):
        change = np.full(len(which), np.nan)
        change[which] = np.where(half.verdict.unstable, np.nan, half.force != self.force[which])
        self.verdict = halved(self.verdict, change, which)
        self.steps[which] += half.steps
        return self


def _one_after_the_other(fate, retry):
    """The rule for one whisker, as docs/unstable-whiskers.md tells it: divisor that counts, flagged, simulated."""
    simulated = {1}
    for finer in (1, retry, 2 * retry) if retry > 1 else (1,):
        simulated.add(finer)
        state, force = fate[finer]
        changed = False
        if state in (SUSPICIOUS, STRUCK) and retry > 1:
            divisor = max(retry, 2 * finer) if state == STRUCK else 2 * finer
            simulated.add(divisor)
            half, half_force = fate[divisor]
            changed = half >= MENDABLE or half_force != force
        if state != MENDABLE and not changed:
            break
    return finer, state >= MENDABLE or changed, simulated


@pytest.mark.parametrize("retry", [1, 2, 3, 5])
@settings(max_examples=30)
@given(fates=st.lists(FATES, min_size=1, max_size=6))
def test_whiskers_are_simulated_as_often_as_the_rule_says(retry, fates):
    seen = Counter()
    launches = []

    def simulate(tries):
        launches.append([finer for _, finer in tries])
        masks = [(np.ones(len(fates), dtype=bool) if which is None else which, finer) for which, finer in tries]
        seen.update((whisker, finer) for which, finer in masks for whisker in np.flatnonzero(which))
        return [
            _Runs([fate for fate, chosen in zip(fates, which, strict=True) if chosen], finer) for which, finer in masks
        ]

    result = run_with_retries(simulate, retry)
    expected = [_one_after_the_other(fate, retry) for fate in fates]
    assert result.finer.tolist() == [finer for finer, *_ in expected]
    assert result.verdict.unstable.tolist() == [bool(reason) for reason in result.verdict.reasons]
    assert result.verdict.unstable.tolist() == [unstable for _, unstable, _ in expected]
    # Steps are those of the tries that the rule asks for, however many there were.
    assert result.steps.tolist() == [100 * sum(simulated) for *_, simulated in expected]
    needed = {(whisker, finer) for whisker, (*_, simulated) in enumerate(expected) for finer in simulated}
    # Nothing is simulated twice, and nothing that is not needed.
    assert set(seen.values()) == {1}
    assert needed == set(seen)
    assert len(launches) <= 5
