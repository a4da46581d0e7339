"""Result of simulating some sweeps together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError


@dataclass(frozen=True, eq=False)
class SweepBatch:
    """Wrenches and contacts of some sweeps, in the order in which they were asked for."""

    wrench: NDArray[np.float32]
    """[sweep, frame, whisker, 6] N and N·m, in the axes that the frames of the grid name; NaN where unstable."""
    contact: NDArray[np.float32]
    """[sweep, whisker] fraction of the frames in which the whisker touched the object."""
    unstable: NDArray[np.bool_]
    """[sweep, whisker] True where the simulation failed; these numbers must not be used."""
    reasons: tuple[str, ...]
    """[sweep] why, in words; empty for a sweep that is ok."""
    steps: int
    """Time steps of single whiskers that were computed."""
    steps_in_full: int
    """Time steps that simulating every whisker of every sweep from start to end takes."""
    retried: int = 0
    """Sweeps with a whisker that was simulated again with finer steps, because it could not be trusted at first."""
    unsolved: int = 0
    """Time steps whose contact forces were not solved (:attr:`brainbench.stimuli.motion.jobs.Trace.unsolved`)."""

    def __post_init__(self) -> None:
        count, _, whiskers, channels = np.shape(self.wrench)
        if channels != 6 or self.contact.shape != (count, whiskers) or self.unstable.shape != (count, whiskers):
            raise UsageError(
                f"A batch of sweeps has wrenches [n, frame, whisker, 6] and [n, whisker] for contact and unstable; "
                f"received {self.wrench.shape}, {self.contact.shape} and {self.unstable.shape}."
            )
        if [bool(reason) for reason in self.reasons] != np.asarray(self.unstable.any(axis=1)).tolist():
            raise UsageError("Every sweep of a batch has a reason, which is empty exactly when no whisker is unstable.")


def describe_unstable(
    names: Sequence[str], unstable: NDArray[np.bool_], reasons: NDArray[np.object_]
) -> tuple[str, ...]:
    """Return the reason of each sweep: that of its first unstable whisker, and how many more there are.

    ``names`` are those of the whiskers; ``unstable`` and ``reasons`` (in words) have shape [sweep, whisker].
    """
    sentences = []
    for bad, words in zip(unstable, reasons, strict=True):
        first = int(np.argmax(bad))
        more = f" (and {bad.sum() - 1} more whiskers)" if bad.sum() > 1 else ""
        sentences.append(f"{names[first]}: {words[first]}{more}" if bad.any() else "")
    return tuple(sentences)


def join_batches(parts: Sequence[SweepBatch]) -> SweepBatch:
    """Return several batches as one."""
    if len(parts) == 1:
        return parts[0]
    names = ("wrench", "contact", "unstable"), ("steps", "steps_in_full", "retried", "unsolved")
    arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names[0]}
    counts: dict[str, Any] = {name: sum(getattr(part, name) for part in parts) for name in names[1]}
    return SweepBatch(**arrays, reasons=tuple(reason for part in parts for reason in part.reasons), **counts)
