"""Scores over time: the animals' bins and the model's steps brought to one clock and compared."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from brainbench.core.errors import DataError, UsageError, listing
from brainbench.core.progress import Progress, stages
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.time import AnimalMovie, TimeCourse, animal_movie, layer_movie, score_over_time
from brainbench.scoring.model_responses import ModelResponses
from brainbench.scoring.neural_responses import NeuralResponses
from brainbench.scoring.options import ScoreOptions


def time_course(
    brain: NeuralResponses,
    network: ModelResponses,
    metric: RSA,
    kept: tuple[str, ...],
    rows: list[int],
    options: ScoreOptions,
    *,
    progress: Progress | None = None,
) -> TimeCourse:
    """Return the score over time of a model against recordings in bins.

    The window of the recordings begins when the stimuli do. Where the stimuli do not state their duration, they last as
    long as the window of most trials (the median). Recordings have bins of one width; ``kept`` are the labels that are
    scored, in order, and ``rows`` those of the activations. The options hold the seed, and the reliability that units
    must have.
    """
    if "time" not in brain.dataset.coords or brain.dataset.sizes["time"] < 3:
        raise DataError(
            "Scores over time need recordings in at least 3 bins of time; give a smaller bin (--bin, seconds) or a "
            "longer window."
        )
    begins = brain.dataset["time"].values.astype(np.float64)
    width = float(np.median(np.diff(begins)))
    # Bins between which others were left out are shorter than the distances of their begins.
    longest = float(brain.dataset["duration"].values.max())
    if not np.allclose(begins, longest * np.arange(len(begins)), rtol=0, atol=1e-6 * longest):
        raise UsageError(
            "Scores over time need bins that follow one another from the begin of the window; those of these "
            f"recordings begin at {listing(f'{begin:g}' for begin in begins[:4])} … s: take the whole recordings, or "
            "another window (--window)."
        )
    seconds = network.seconds
    if seconds is None:
        # The last bin may be shorter than the others, and a single trial longer than the others.
        window, whole = float(np.median(brain.dataset["duration"].values.sum(axis=1))), width * len(begins)
        seconds = whole if math.isclose(window, whole, rel_tol=1e-6) else window
    sessions = brain.reliable_trials(kept, options)
    how: dict[str, Any] = {"method": metric.brain_method, "noise": metric.noise, "comparison": metric.comparison}
    stage_done = stages(len(sessions) + len(network.activations), "RDMs over time", progress)
    animals, layers = [], {}
    for subject, (blocks, note) in sessions.items():
        if blocks:
            animals.append(animal_movie(subject, blocks, len(kept), stimuli=kept, seed=options.seed, **how))
        else:
            nothing = np.full((len(begins), math.comb(len(kept), 2)), np.nan)
            animals.append(AnimalMovie(subject, nothing, nothing[:, 0], (note,) * len(begins)))
        stage_done()
    for name, values in network.activations.items():
        layers[name] = layer_movie(values[rows], seconds / values.shape[1], width, method=metric.model_method)
        stage_done()
    return score_over_time(layers, animals, width=width, comparison=metric.comparison, seed=options.seed)
