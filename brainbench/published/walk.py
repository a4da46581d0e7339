"""The walk from the published estimator to the default one, one switch per fault, one line per step.

Faults of the published estimator (each a field of :class:`Switches`; True is as published):

``best_target``      the maximum over targets (every animal and their pool) is the score
``best_layer``       the maximum over layers, on the data that are scored
``drop_splits``      splits whose halves correlate below .5 are left out (models), which keeps the lucky ones
``median``           ratios are summarised by their median (raw input), by their mean (models): bars of one
                     figure came from two estimators
``ratio_per_split``  every split is corrected by its own reliability before averaging; splits with negative
                     reliability have no real value and vanish
``negative_pairs``   two negative reliabilities have a positive product and pass
``no_gate``          animals are averaged however unreliable they are

Faults that happen before the estimator (other stimuli filled with zeros, stimuli numbered by first
appearance) are in ``brainbench.datasets.synthetic`` and their damage is in docs/calibration.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import DataError, UsageError, brief
from brainbench.core.files import to_plain
from brainbench.core.progress import Progress
from brainbench.core.reading.archives import read_npz
from brainbench.core.records import Status
from brainbench.metrics.evaluation import gather, held_out
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import compare
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.rdms.pairs import Floats, rdm_stack, stimulus_count
from brainbench.metrics.reliability.noise_correction import (
    ANIMAL_GATE,
    RELIABILITY_GATE,
    THESIS_FILTER,
    corrected_splits,
    spearman_brown,
)
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat


@dataclass(frozen=True)
class Switches:
    """Published faults that are on; the text of this module says what each does."""

    best_target: bool = True
    best_layer: bool = True
    drop_splits: bool = True
    median: bool = False
    negative_pairs: bool = True
    ratio_per_split: bool = True
    no_gate: bool = True


PUBLISHED = Switches()
"""The bars of models."""
PUBLISHED_INPUT = Switches(drop_splits=False, median=True)
"""The bar of the raw input."""
CORRECTED = Switches(*(False for _ in fields(Switches)))
_AVERAGED = "split halves averaged before the correction instead of after"


@dataclass(frozen=True)
class WalkStep:
    """One line of the walk."""

    change: str
    """The switch, in words."""
    value: float
    status: Status
    detail: str
    """Number of splits and animals that entered, or why there is no value."""
    switches: Switches


def corrected_value(
    r_xy: ArrayLike, r_yy: ArrayLike, switches: Switches, *, r_xx: ArrayLike | None = None
) -> tuple[float, int]:
    """Return one comparison corrected for noise under the switches, and the splits that entered.

    ``r_xy`` is the raw comparison [S] or a number, ``r_yy`` are the raw split-half comparisons [S] of the brain and
    ``r_xx`` those of the other side; 1 (a model) by default. Of the switches ``drop_splits``, ``median``,
    ``negative_pairs`` and ``ratio_per_split`` matter here.
    """
    halves = np.asarray(r_yy, dtype=np.float64).ravel()
    others = np.ones(len(halves)) if r_xx is None else np.broadcast_to(np.asarray(r_xx, dtype=np.float64), halves.shape)
    raw = np.broadcast_to(np.asarray(r_xy, dtype=np.float64), halves.shape)
    # Splits without a correlation (a half with a flat RDM) have no say under any switch.
    keep = np.isfinite(halves) & np.isfinite(others) & np.isfinite(raw)
    if switches.drop_splits:
        keep &= halves >= THESIS_FILTER
    if not keep.any():
        return math.nan, 0
    if not switches.ratio_per_split:
        # The default: splits are averaged before one ratio is formed.
        sides = [float(spearman_brown(side[keep].mean())) for side in (halves, others)]
        value = float(raw[keep].mean()) / math.sqrt(math.prod(sides)) if min(sides) > 0 else math.nan
        return value, int(keep.sum())
    ratios = corrected_splits(raw[keep], halves[keep], others[keep])
    real = ratios[np.isfinite(ratios) & (switches.negative_pairs | (halves[keep] > 0))]
    if not real.size:
        return math.nan, 0
    return float(np.median(real) if switches.median else real.mean()), real.size


def add_walk(inputs: Any, *, progress: Progress | None = None) -> dict[str, Any]:
    """Return what ``--explain-estimator`` adds to the statistics of a record.

    ``inputs`` are those of :class:`brainbench.scoring.scores.ScoreInputs`.
    """
    rdms = {layer: rdm(values) for layer, values in inputs.features.items()}
    return {"estimator_walk": to_plain(explain_score(rdms, inputs.animals))}


def explain_file(path: str | Path) -> tuple[WalkStep, ...]:
    """Walk through the split halves in an ``.npz`` file: arrays ``r_xy``, ``r_yy`` and maybe ``r_xx``.

    Raises:
        DataFileNotFoundError: there is no such file.
    """
    arrays = read_npz(path, ".npz file of plain arrays")
    if missing := {"r_xy", "r_yy"} - arrays.keys():
        raise DataError(f"{path} lacks the array {sorted(missing)[0]!r}; it has {sorted(arrays)}.")
    for name in ("r_xy", "r_yy", "r_xx"):
        array = arrays.get(name, np.zeros(()))
        fits = array.ndim == 0 or array.shape == (arrays["r_yy"].size,)
        if array.dtype.kind not in "fiu" or not fits or (np.abs(array) > 1 + 1e-6).any():
            raise DataError(
                f"{name!r} in {brief(str(path))} is {list(array.shape)} of {array.dtype}; needed are as many "
                "correlations (-1 to 1, NaN for none) as 'r_yy' has."
            )
    return explain_splits(arrays["r_xy"], arrays["r_yy"], r_xx=arrays.get("r_xx"))


def explain_splits(r_xy: ArrayLike, r_yy: ArrayLike, *, r_xx: ArrayLike | None = None) -> tuple[WalkStep, ...]:
    """Walk through stored split halves of one model and one target, from the published bars to the default.

    Arguments are those of :func:`corrected_value`.
    """
    halves = np.asarray(r_yy, dtype=np.float64).ravel()
    if not np.isfinite(halves).any():
        raise UsageError("There are no split halves to explain; give r_yy with one correlation per split.")
    reliability = float(spearman_brown(halves[np.isfinite(halves)].mean()))
    negative = int((halves < 0).sum())
    walk = (
        ("as published for the raw input: median of the splits' ratios", PUBLISHED_INPUT),
        ("mean instead of median of the ratios", Switches(drop_splits=False)),
        (f"splits with a raw correlation below {THESIS_FILTER} left out: as published for models", PUBLISHED),
        (
            "all splits again, two negative reliabilities no longer pass",
            Switches(drop_splits=False, negative_pairs=False),
        ),
        (_AVERAGED, replace(CORRECTED, no_gate=True)),
    )
    steps = []
    for change, switches in walk:
        value, used = corrected_value(r_xy, halves, switches, r_xx=r_xx)
        detail = f"{used:,} of {len(halves):,} splits"
        if switches.ratio_per_split and not switches.drop_splits:
            detail += f"; {negative} with negative reliability have no real ratio and vanish"
        steps.append(WalkStep(change, value, "ok" if math.isfinite(value) else "undefined", detail, switches))
    value, status = steps[-1].value, "ok" if reliability >= RELIABILITY_GATE else "unreliable"
    detail = f"reliability {reliability:.2f}"
    if not reliability > 0:
        value, status = math.nan, "undefined"
    elif status == "ok":
        detail += f" is at least {RELIABILITY_GATE}"
    else:
        detail += f" is below {RELIABILITY_GATE}: no correction of these data is trustworthy"
    return (*steps, WalkStep("gate on reliability: the default", value, status, detail, CORRECTED))


def explain_score(layer_rdms: Mapping[str, ArrayLike], subjects: Sequence[SubjectRDM]) -> tuple[WalkStep, ...]:
    """Walk a model's score from the published estimator to the default one, on the same RDMs, by Pearson's r.

    The published pool of all animals' units is represented by their mean RDM and halves.
    """
    rdms = rdm_stack(list(layer_rdms.values()), "layer_rdms")
    rdms = rdms[~is_flat(rdms)]
    animals = gather(RSA(comparison="pearson"), subjects, stimulus_count(rdms.shape[-1]), estimator="thesis-input")
    # Without the published estimators' own demands: whoever has an RDM takes part.
    usable = [subject for subject in animals.subjects if subject.problem is None and not is_flat(subject.rdm)]
    if not len(rdms) or not usable:
        raise UsageError("There is nothing to explain: no layer or no animal has a usable RDM.")
    averaged = replace(PUBLISHED, best_target=False)
    unfiltered = replace(averaged, drop_splits=False)
    walk = (
        ("as published: maximum over layers and over targets", PUBLISHED),
        ("mean over animals instead of the best target", averaged),
        ("no split is left out", unfiltered),
        ("two negative reliabilities no longer pass", replace(unfiltered, negative_pairs=False)),
        (_AVERAGED, replace(CORRECTED, best_layer=True, no_gate=True)),
        (f"animals with a reliability below {ANIMAL_GATE} left out", replace(CORRECTED, best_layer=True)),
        ("layer chosen on the other animals: the default", CORRECTED),
    )
    return tuple(_step(change, switches, rdms, usable) for change, switches in walk)


def _step(change: str, switches: Switches, rdms: Floats, subjects: list[SubjectRDM]) -> WalkStep:
    targets = [(subject.subject, subject.rdm, subject.split_half_by("pearson")) for subject in subjects]
    if not switches.no_gate:
        trusted = [float(spearman_brown(r[np.isfinite(r)].mean())) >= ANIMAL_GATE for _, _, r in targets]
        targets = [target for target, keep in zip(targets, trusted, strict=True) if keep]
    if switches.best_target and len(subjects) > 1:
        # The published pool joined units, which are not kept here; the animals' mean RDM stands for it.
        splits = min(len(subject.halves) for subject in subjects)
        halves = np.mean([subject.halves[:splits] for subject in subjects], axis=0)
        # Halves are averaged split by split over animals, so the pool's halves hold different trials too.
        agreement = compare(halves[:, 0], halves[:, 1])
        targets.append(("the pool", np.mean([subject.rdm for subject in subjects], axis=0), agreement))
    if not targets:
        return WalkStep(change, math.nan, "undefined", "no animal is reliable", switches)
    r = compare(rdms[:, None], np.stack([target[1] for target in targets])[None])
    # A correction is a factor of the raw comparison: one per target.
    corrections = [corrected_value(1.0, target[2], switches) for target in targets]
    factors = np.array([item[0] for item in corrections])
    finite = np.isfinite(factors)
    if not finite.any():
        return WalkStep(change, math.nan, "undefined", "no split half has a positive reliability", switches)
    names = [target[0] for target, keep in zip(targets, finite, strict=True) if keep]
    used = sum(item[1] for item in corrections)
    values = (r * factors)[:, finite]
    detail = f"{len(names)} of {len(targets)} targets, {used:,} splits"
    if switches.best_target:
        place = int(np.argmax(values.max(axis=0)))
        return WalkStep(change, float(values.max()), "ok", f"{detail}; the best is {names[place]}", switches)
    if switches.best_layer or len(rdms) == 1:
        return WalkStep(change, float(values.mean(axis=1).max()), "ok", detail, switches)
    if len(names) == 1:
        return WalkStep(
            change, math.nan, "undefined", "one animal: the default chooses on halves of its trials", switches
        )
    value = float((held_out(r[:, finite]) * factors[finite]).mean())
    return WalkStep(change, value, "ok", detail, switches)
