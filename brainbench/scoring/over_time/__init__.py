"""Scores over time: when a model's layers and animals represent stimuli alike, and how far one lags behind the other.

Data pass in this order: ``movies`` (an RDM for every time bin, of layers and of animals) → ``lags`` (each layer against
the animals at every lag, and its latency) → ``course`` (the score at each time, corrected for having looked at many
times). An optional room, which nothing else imports; ``--over-time`` is its entry point.
"""

from brainbench.scoring.over_time.course import TimeCourse, TimePoint, score_over_time
from brainbench.scoring.over_time.lags import LayerLatency
from brainbench.scoring.over_time.movies import AnimalMovie, animal_movie, in_bins, layer_movie

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
