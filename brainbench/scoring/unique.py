"""What a network explains of the animals beyond raw input and contact kinematics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Score

if TYPE_CHECKING:
    from brainbench.metrics.measures.unique import UniquePart

RAW_INPUT = "raw input"
"""Name of the first control, among the baselines too."""


def contact_kinematics(dataset: Any) -> dict[str, NDArray[np.float64]]:
    """Return what a stimulus set states of contacts by name, [K, W]; nothing of a set without contacts.

    *First contact* (s) is the end of the stimulus for a whisker that touches nothing, whose *contact arc* (m along the
    whisker, mean over the contact) is 0; *contact duration* is a share of the stimulus.
    """
    if not {"contact", "contact_arc", "first_contact"} <= set(getattr(dataset, "data_vars", ())):
        return {}
    contact = dataset["contact"].values.astype(bool)
    count = contact.sum(axis=1)
    arc = np.nansum(np.where(contact, dataset["contact_arc"].values, 0.0), axis=1, dtype=np.float64)
    first, time = dataset["first_contact"].values, dataset["time"].values
    return {
        "first contact": np.where(np.isfinite(first), first, float(time[-1])),
        "contact duration": count / contact.shape[1],
        "contact arc": arc / np.maximum(count, 1),
    }


def unique_of(
    score: Score,
    metric: Any,
    animals: Sequence[Any],
    features: Mapping[str, Any],
    controls: Mapping[str, Any],
    *,
    committed: str | None = None,
    seed: int = 0,
) -> UniquePart | None:
    """Return the unique part of the model whose score is given; None where nothing is compared by RDMs.

    Args:
        animals: what the metric made of each.
        features: features [K, F] of each layer.
        controls: features [K, F] of each control.
        committed, seed: as of the score.
    """
    from brainbench.metrics.animals import gather
    from brainbench.metrics.measures.rsa import RSA
    from brainbench.metrics.measures.unique import UniquePart, unique_part

    if not isinstance(metric, RSA) or score.estimator != "default" or not controls:
        return None
    if score.status == "undefined":
        return UniquePart("undefined", ("the score is undefined",))
    gathered = gather(metric, animals, len(score.stimuli))
    scored = [gathered.subjects[index] for index in gathered.scored]
    factors = gathered.factors(gathered.scored)
    part = unique_part(
        {name: metric.layer(values) for name, values in features.items()},
        {name: metric.layer(values) for name, values in controls.items()},
        scored,
        comparison=metric.comparison,
        factors=factors,
        factors_without=metric.factors_without(scored, factors),
        attainable=score.attainable,
        committed=committed,
        seed=seed,
    )
    if part.status == "ok" and score.status != "ok":
        return replace(part, status="unreliable", reasons=("the score is not ok", *part.reasons))
    return part
