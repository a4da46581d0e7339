"""Scores over time: when a model's layers and animals represent stimuli alike, and how far one lags behind the other.

``course`` makes an RDM for every time bin, of layers and of animals, compares each layer with the animals at every lag
(its latency), and corrects the score at each time for having looked at many times. An optional room, which nothing
else imports; ``--over-time`` is its entry point.
"""

from brainbench.scoring.over_time.course import (
    AnimalMovie,
    LayerLatency,
    TimeCourse,
    TimePoint,
    animal_movie,
    in_bins,
    layer_movie,
    score_over_time,
)

__all__ = [
    "AnimalMovie",
    "LayerLatency",
    "TimeCourse",
    "TimePoint",
    "animal_movie",
    "in_bins",
    "layer_movie",
    "score_over_time",
]
