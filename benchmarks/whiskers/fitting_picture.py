"""Draw a fit of a traced ring-down and its residuals: the picture of docs/fitting.md.

``python -m benchmarks.whiskers.fitting_picture [docs/images/fit-shapes.png]``
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np

from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import Trial, fit
from brainbench.stimuli.fitting.figure import draw_fit
from brainbench.stimuli.fitting.synthetic import blank_wrenches, measure_shapes, simulate_trial

if __name__ == "__main__":
    known = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.15)
    truth = replace(known, young_modulus=4e9, tip_radius=7e-6, damping_ratio=0.1)
    period = 1 / float(references.natural_frequencies(known, 1)[0])
    experiment = Trial.ringdown(truth, blank_wrenches(np.arange(1, 61) * period / 12), 1.2e-3)
    traced = measure_shapes(experiment, simulate_trial(experiment), truth, 20e-6, np.random.default_rng(0), points=24)
    trial = Trial.ringdown(known, traced.measured, 1e-3)
    result = fit(trial, ["young_modulus", "tip_radius", "damping_ratio", "deflection"])
    print(
        result.status,
        *(f"{one.name} {one.value:.4g} [{one.interval.low:.4g}, {one.interval.high:.4g}]" for one in result.estimates),
    )
    draw_fit(trial, result, sys.argv[1] if len(sys.argv) > 1 else "docs/images/fit-shapes.png")
