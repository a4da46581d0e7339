"""Ring-downs that are fitted from a start out of step, or from rare readings: with and without the scan of starts.

``python -m benchmarks.whiskers.fitting_starts [--write]``
"""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli.fitting import FitOptions, Trial, fit, least_squares
from brainbench.stimuli.fitting.synthetic import blank_wrenches, measure_wrenches, simulate_trial
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.array import WhiskerArray

TITLE = "Ring-downs fitted from a wrong start"
KNOWN = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.05)
PERIOD = 1 / float(references.natural_frequencies(KNOWN, 1)[0])
OPTIONS = FitOptions(links=8, steps_per_period=200.0, time_step=1e-3)
TRUTHS, GAPS, READINGS, NOISE = (0.2, 0.4, 2.0, 4.0), (0.1, 0.6, 0.9, 1.3), 40, 0.01


def measured(share: float, gap: float) -> Trial:
    """Return the trial of a whisker of ``share`` times the published stiffness, read every ``gap`` periods."""
    truth = replace(KNOWN, young_modulus=share * KNOWN.young_modulus)
    experiment = Trial.ringdown(truth, blank_wrenches(np.arange(1, READINGS + 1) * gap * PERIOD), 1e-3)
    # Truth and fit share the time step, which the fit takes from the whisker that it starts from.
    same = replace(OPTIONS, steps_per_period=4.0, time_step=PERIOD / OPTIONS.steps_per_period)
    trace = simulate_trial(experiment, options=same)
    return Trial.ringdown(KNOWN, measure_wrenches(experiment, trace, NOISE, np.random.default_rng(0)).measured, 8e-4)


def main() -> None:
    options = script_parser(__doc__).parse_args()
    rows, wrong = [], {"start alone": [0, 0], "scan": [0, 0]}
    for share in TRUTHS:
        for gap in GAPS:
            trial, cells = measured(share, gap), []
            for name, starts in (("start alone", lambda model: [np.zeros(len(model.free))]), ("scan", None)):
                with patch.object(least_squares, "find_starts", starts or least_squares.find_starts):
                    found = fit(trial, ["young_modulus", "deflection"], options=OPTIONS)
                ratio = found["young_modulus"].value / (share * KNOWN.young_modulus)
                miss = abs(ratio - 1) > 0.05
                wrong[name][0] += miss
                wrong[name][1] += miss and found.status == "ok"
                cells += [f"{ratio:.3f}", found.status]
            rows.append([f"{share:g}", f"{gap:g}", *cells])
            print(*rows[-1], sep=" | ", flush=True)
    told = "; ".join(
        f"{name}: {n} of {len(rows)} wrong by more than 5 %, {ok} of them `ok`" for name, (n, ok) in wrong.items()
    )
    text = (
        f"Mouse C2 (damping ratio .05, known) let go from 1 mm and read {READINGS} times with {100 * NOISE:g} % noise; "
        "Young's modulus and deflection are fitted from the published whisker and .8 mm. Columns: Young's modulus over "
        f"the published one, periods of the published whisker between readings, and estimate over truth. {told}.\n\n"
    )
    head = ["truth / start", "periods a reading", "start alone", "status", "scan", "status"]
    print(told)
    publish(options, TITLE, text + table(head, rows))


if __name__ == "__main__":
    main()
