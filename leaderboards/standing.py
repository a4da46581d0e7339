"""The ladder of words for what a score is worth, and whether anybody can compute it again."""

from __future__ import annotations

import math
from typing import Literal

from brainbench.core.records import ResultRecord, Score
from leaderboards.ranking import CHANCE_LEVEL

Standing = Literal[
    "above raw input", "above chance", "not told apart from chance", "not tested", "unreliable", "undefined"
]
MEANINGS: dict[Standing, str] = {
    "above raw input": "Told apart from chance, and above the raw input of the models.",
    "above chance": "Told apart from chance, but not above the raw input of the models.",
    "not told apart from chance": "A model that knows nothing of these stimuli could score as high.",
    "not tested": "The record states no test against chance.",
    "unreliable": "Computed, but not to be trusted: the data are too noisy or too few.",
    "undefined": "No number exists.",
}
"""Statements about a score, from the most to the least: every page uses these words and no others."""
STANDINGS = tuple(MEANINGS)
DOUBTFUL: tuple[Standing, ...] = ("unreliable", "undefined")
"""Standings of scores that no conclusion is drawn from."""
BUILT_IN_METRICS = (
    "rsa", "rsa-correlation", "rsa-crossnobis", "rsa-partial", "cka", "decoding", "procrustes", "ridge"
)  # fmt: skip
"""Names of the metrics that come with the package (this package cannot import them)."""


def standing_of(score: Score, *, above_raw: bool) -> Standing:
    """Return what can be said of a score, given whether it is told apart above the raw input."""
    if score.status != "ok":
        return score.status
    if math.isnan(score.p):
        return "not tested"
    if score.p > CHANCE_LEVEL:
        return "not told apart from chance"
    return "above raw input" if above_raw else "above chance"


def not_repeatable(record: ResultRecord) -> str:
    """Return why a record cannot be computed again from this package alone, empty when it can.

    >>> from brainbench.core.records import ModelCard
    >>> not_repeatable(ResultRecord(Score("features", 0.9, "ok"), card=ModelCard("features", family="user module")))
    'its code is not in the registry'
    """
    card, name = record.card, record.score.name
    if card is None or card.family in ("", "features computed elsewhere"):
        return "its features were computed elsewhere"
    if card.family == "user module":
        return "its code is not in the registry"
    metric = record.score.provenance.settings.get("metric")
    if card.family != "policy" and metric is not None and metric not in BUILT_IN_METRICS:
        return "its metric does not come with the package"
    return "its weights do not come with the package" if name.startswith(("local-dir:", "hf-hub:")) else ""
