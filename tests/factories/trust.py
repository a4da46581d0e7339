"""Facts of simulated whiskers, to be judged."""

import numpy as np

from brainbench.stimuli.engines.trust import OK, RunFacts


def facts(**changed):
    """Facts of one whisker in good order but for what is changed."""
    values = {
        "status": OK, "failed": 0.0, "strength": 0.0, "strong_at": np.inf, "strongest": 30.0, "travel": 0.0,
        "farthest": 8e-4, "fast_at": np.inf, "struck": False,
        "residual": 0.01, "crowded": 0, "steps": 100, "depth": 1e-5, "peak": 1e-3, "third": 9e-4,
    }  # fmt: skip
    return RunFacts(**{name: np.array([value]) for name, value in (values | changed).items()})
