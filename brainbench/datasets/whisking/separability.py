"""Separability of object classes by whisker forces: support vector machines on two, three and four classes.

The check of Figure 3.1(b) of the thesis. Sweeps of one object never stand on both sides of a test: what is measured
is telling a new chair from a new mug, not recognising a chair that was met before.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.errors import DataError, UsageError, check_each, check_number, check_once, needing
from brainbench.core.progress import Progress
from brainbench.core.records import Interval, Status

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.datasets.whisking.dataset import WhiskingDataset

FEW_OBJECTS = 5  # with fewer objects of a class than this the accuracy is called unreliable
FOLDS = 5
RESAMPLES = 2000
_PENALTY = 10.0


@dataclass(frozen=True)
class Separability:
    """Accuracy with which classes are told apart, so many at a time."""

    count: int
    """Classes that are told apart at a time."""
    accuracy: float
    """Mean over the classes of each choice, then over the choices."""
    interval: Interval
    """From resampling the objects of every class; binomial where all objects are right."""
    chance: float
    """1 / count."""
    choices: tuple[tuple[str, ...], ...]
    """The choices of ``count`` classes that were averaged."""
    accuracies: tuple[float, ...]
    """Accuracy of each choice."""
    sweeps: int
    objects: int
    status: Status = "ok"
    reason: str = ""

    @property
    def above_chance(self) -> bool:
        """True when the whole interval lies above chance."""
        return self.interval.low > self.chance


def separability(
    data: WhiskingDataset,
    *,
    classes: Sequence[str] | None = None,
    counts: Sequence[int] = (2, 3, 4),
    sweeps_per_class: int = 400,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Separability, ...]:
    """Measure how well classes are told apart by the forces and moments of all whiskers.

    A sweep's features are its forces and moments averaged over steps of five frames, all whiskers side by side, divided
    by the root mean square of each channel; the machine is an SVC with radial kernel (C = 10, its width from the
    variance of the features, as scikit-learn's ``gamma='scale'``), tested by five-fold cross-validation over objects.
    Nothing was tuned. Memory grows with the square of the number of sweeps: 10 MB for 1,600. ``classes`` are the four
    with the most objects by default; all choices of each number in ``counts`` of them are averaged.
    ``sweeps_per_class`` are drawn evenly from the objects of each.
    """
    objects = data.objects
    chosen = _choose_classes(data.classes, data.labels, objects, classes, max(counts))
    generator = np.random.default_rng(seed)
    owned = (np.flatnonzero(data.labels == data.classes.index(name)) for name in chosen)
    rows = [_draw(mine, objects, sweeps_per_class, generator) for mine in owned]
    where = np.concatenate(rows)
    labels = np.repeat(np.arange(len(chosen)), [len(part) for part in rows])
    report = progress or (lambda done, total, what: None)
    features, results = _features(data, where, report), []
    for count in counts:
        results.append(separate(features, labels, objects[where], count=count, names=chosen, seed=seed))
        report(len(results), len(counts), "training support vector machines")
    return tuple(results)


def separate(
    features: NDArray[np.floating],
    labels: NDArray[np.integer],
    objects: NDArray[np.str_],
    *,
    count: int,
    names: Sequence[str],
    seed: int = 0,
) -> Separability:
    """Measure how well classes are told apart by features [n, F], for all choices of ``count`` of them.

    ``names`` are those of the labels [n]. Sweeps of the same object (``objects`` [n]) stay on one side of every test.
    """
    with needing("scikit-learn", extra="learn", purpose="Separability"):
        from sklearn.metrics.pairwise import rbf_kernel
        from sklearn.model_selection import StratifiedGroupKFold, cross_val_predict
        from sklearn.svm import SVC
    check_number("number of classes to tell apart", count, least=2, most=len(names), whole=True)
    members = [np.unique(objects[labels == number]) for number in range(len(names))]
    fewest = min(map(len, members))
    if fewest < 2:
        poor = names[[len(found) for found in members].index(fewest)]
        raise DataError(
            f"The class {poor!r} has {fewest} object{'s' * (fewest != 1)}; telling classes apart needs two of each: "
            "one to learn from and one to be tested with."
        )
    values = np.asarray(features, dtype=np.float32)
    # As gamma="scale" would take it, but once for all choices and folds.
    kernel = rbf_kernel(values, gamma=1 / (max(float(values.var()), np.finfo(np.float32).tiny) * values.shape[1]))
    folds = StratifiedGroupKFold(min(FOLDS, fewest), shuffle=True, random_state=seed)
    choices = list(itertools.combinations(range(len(names)), count))
    tallies = []
    for choice in choices:
        mine = np.flatnonzero(np.isin(labels, choice))
        kind, machine = labels[mine], SVC(C=_PENALTY, kernel="precomputed")
        predicted = cross_val_predict(machine, kernel[np.ix_(mine, mine)], kind, groups=objects[mine], cv=folds)
        hit = np.asarray(predicted == kind)
        tallies.append({number: _by_object(objects[mine[kind == number]], hit[kind == number]) for number in choice})
    shares = ([rows[:, 0].sum() / rows[:, 1].sum() for rows in tally.values()] for tally in tallies)
    accuracies = tuple(float(np.mean(share)) for share in shares)
    reason = f"a class has only {fewest} objects; {FEW_OBJECTS} are the least to trust an interval"
    predicted = Separability(
        count=count,
        accuracy=float(np.mean(accuracies)),
        interval=_interval(tallies, [len(found) for found in members], seed),
        chance=1 / count,
        choices=tuple(tuple(names[number] for number in choice) for choice in choices),
        accuracies=accuracies,
        sweeps=len(labels),
        objects=sum(map(len, members)),
    )
    return replace(predicted, status="unreliable", reason=reason) if fewest < FEW_OBJECTS else predicted


def _choose_classes(
    names: Sequence[str], labels: NDArray[np.int64], objects: NDArray[np.str_], chosen: Sequence[str] | None, most: int
) -> tuple[str, ...]:
    if chosen is not None:
        check_each("class", chosen, names)
        check_once("The list of classes", chosen)
        if len(chosen) < most:
            raise UsageError(f"{most} classes at a time need {most} different classes; received {', '.join(chosen)}.")
        return tuple(chosen)
    sizes = {name: len(np.unique(objects[labels == number])) for number, name in enumerate(names)}
    largest = sorted(names, key=lambda name: (-sizes[name], name))[: max(4, most)]
    if len(largest) < most:
        raise UsageError(f"The data set has {len(names)} classes; {most} at a time cannot be told apart.")
    return tuple(sorted(largest))


def _draw(
    mine: NDArray[np.intp], objects: NDArray[np.str_], count: int, generator: np.random.Generator
) -> NDArray[np.intp]:
    """Draw sweeps of one class, as evenly from its objects as they allow."""
    shuffled = generator.permutation(mine)
    turns: defaultdict[str, Iterator[int]] = defaultdict(itertools.count)
    ranks = [next(turns[name]) for name in objects[shuffled].tolist()]
    return np.sort(shuffled[np.argsort(ranks, kind="stable")[:count]])


def _features(data: WhiskingDataset, where: NDArray[np.intp], progress: Progress) -> NDArray[np.float32]:
    """Return [n, F]: steps of five frames, channels of unit root mean square."""
    parts = []
    for first in range(0, len(where), 64):
        raw = data.read(where[first : first + 64])
        count, frames, whiskers, channels = raw.shape
        steps = max(1, frames // 5)
        cut = raw[:, : frames // steps * steps].reshape(count, steps, -1, whiskers, channels)
        parts.append(cut.mean(axis=2))
        progress(min(first + 64, len(where)), len(where), "reading sweeps")
    steps = np.concatenate(parts)
    scale = np.sqrt(np.mean(np.square(steps, dtype=np.float64), axis=(0, 1, 2)))
    return (steps / np.where(scale > 0, scale, 1.0)).astype(np.float32).reshape(len(where), -1)


def _by_object(objects: NDArray[np.str_], hit: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Count the sweeps told right and all sweeps of each object [object, 2]."""
    owner = np.unique(objects, return_inverse=True)[1]
    return np.array([np.bincount(owner, weights=hit), np.bincount(owner)], dtype=np.float64).T


def _interval(tallies: Sequence[Mapping[int, NDArray[np.float64]]], sizes: Sequence[int], seed: int) -> Interval:
    """Resample the objects of each class, the same ones in every choice, and take the middle 95 %.

    ``tallies`` has for each choice: class → right and all sweeps of its objects [object, 2]; ``sizes`` the number of
    objects of each class.
    """
    generator = np.random.default_rng([seed, 1])
    drawn = [generator.integers(size, size=(RESAMPLES, size)) for size in sizes]
    means = np.zeros(RESAMPLES)
    for tally in tallies:
        for number, rows in tally.items():
            counts = rows[drawn[number]].sum(axis=1)
            means += counts[:, 0] / counts[:, 1] / len(tally) / len(tallies)
    low, high = np.quantile(means, [0.025, 0.975])
    if np.ptp(means) == 0 and means[0] in (0.0, 1.0):
        # Resampling shows no spread when every object is right: the exact bound of n of n does.
        bound = 0.025 ** (1 / sum(sizes))
        low, high = (bound, 1.0) if means[0] == 1 else (0.0, 1 - bound)
        return Interval(low, high, 0.95, "exact binomial (Clopper and Pearson) over objects, which are all alike")
    return Interval(float(low), float(high), 0.95, f"bootstrap over objects within classes, {RESAMPLES} resamples")
