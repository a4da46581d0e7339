"""What the intervals of a score say of it: too few animals or stimuli, and more than is attainable."""

from __future__ import annotations

from dataclasses import replace

from brainbench.core.records import Score
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI

BEYOND = 1.1
"""Scaled score that no interval should lie above: a tenth of the scale more than all that is reliable."""


def interval_reasons(animals: int, stimuli: int) -> tuple[str, ...]:
    """Say what the numbers of animals and stimuli mean for the interval and for comparisons of models."""
    if animals == 1:
        return ("one animal: no confidence interval, since nothing is known about other animals",)
    lacking = []
    if animals < FEWEST_ANIMALS:
        lacking.append(f"{animals} animals, at least {FEWEST_ANIMALS} are needed")
    if stimuli < FEWEST_STIMULI:
        lacking.append(f"{stimuli} stimuli, at least {FEWEST_STIMULI} are needed")
    return (f"too few to tell models apart: {'; '.join(lacking)}",) if lacking else ()


def held_to_scale(score: Score) -> Score:
    """Return the score, unreliable where it lies above what is attainable: nothing can explain more than that."""
    span = score.scaled_interval
    if score.status != "ok" or span is None or not span.low > BEYOND:
        return score
    reason = f"above all that is reliable (at least {span.low:.2f} of it): the scale of this metric does not hold here"
    return replace(score, status="unreliable", reasons=(reason, *score.reasons))
