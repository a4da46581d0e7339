"""Truth of fitted whiskers: errors, coverage of intervals, and whether a wrong model is noticed.

``python -m benchmarks.whiskers.fitting [--simulations 200] [--keep FOLDER] [--only wrench-own]``.

Whiskers of random stiffness, taper and
damping ring down; their base wrench or their shape is read with noise and fitted from the published whisker. Truths
are simulated at the setting of the fit, and others with twice the links and a step of two fifths.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.report import table, write_section
from brainbench.core.files import read_json, write_json
from brainbench.core.statistics import wilson_interval
from brainbench.stimuli.fitting import FitOptions, Trial, fit
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.whisker_measurements import (
    FINE,
    blank_wrenches,
    measure_shapes,
    measure_wrenches,
    simulate_trial,
)

TITLE = "Fitted whiskers: truth, coverage and wrong models"
NAMES = ("young_modulus", "tip_radius", "damping_ratio", "deflection")
GOAL = 0.05
WRENCH_NOISE, SHAPE_NOISE = 0.01, 20e-6
PER_PERIOD = {"wrench": 24, "shape": 12}
PERIODS, POINTS = 5, 20


QUICK = FitOptions(links=8, steps_per_period=80.0, time_step=1e-3)
"""Setting of the simulations that count coverage, of truth and fit alike: it cancels."""


def one(kind: str, species: str, seed: int, finer: bool) -> dict:
    """Draw a whisker, let it ring down, measure it, and fit it with the right and with a cylindrical model."""
    rng = np.random.default_rng([seed, len(species), len(kind)])
    known = replace(WhiskerArray.of(species)["C2"].whisker, damping_ratio=0.15)
    truth = replace(
        known,
        young_modulus=known.young_modulus * float(np.exp(rng.normal(0, 0.25))),
        tip_radius=known.tip_radius * float(np.exp(rng.normal(0, 0.25))),
        damping_ratio=float(rng.uniform(0.08, 0.25)),
    )
    deflection = truth.arc_length * float(rng.uniform(0.05, 0.1))
    period = 1 / float(references.natural_frequencies(known, 1)[0])
    times = np.arange(1, PERIODS * PER_PERIOD[kind] + 1) * period / PER_PERIOD[kind]
    trial = Trial.ringdown(truth, blank_wrenches(times), deflection)
    options = FitOptions() if finer else QUICK
    # Truth and fit share the time step, which the fit takes from the whisker that it starts from.
    same = replace(options, steps_per_period=4.0, time_step=min(period / options.steps_per_period, options.time_step))
    trace = simulate_trial(trial, options=FINE if finer else same)
    if kind == "wrench":
        measured = measure_wrenches(trial, trace, WRENCH_NOISE, rng).measured
    else:
        measured = measure_shapes(trial, trace, truth, SHAPE_NOISE, rng, points=POINTS).measured
    started = time.process_time()
    start = 0.08 * known.arc_length
    result = fit(Trial.ringdown(known, measured, start), NAMES, options=options)
    seconds = time.process_time() - started
    truths = {"young_modulus": truth.young_modulus, "tip_radius": truth.tip_radius,
              "damping_ratio": truth.damping_ratio, "deflection": deflection}  # fmt: skip
    error = {name: result[name].value / truths[name] - 1 for name in truths}
    slope = (truth.base_radius - truth.tip_radius) / truth.arc_length
    error["taper"] = (result.whisker.base_radius - result.whisker.tip_radius) / truth.arc_length / slope - 1
    radius = (known.base_radius + known.tip_radius) / 2
    cylinder = replace(known, base_radius=radius, tip_radius=radius)
    wrong = None
    if seed % 4 < 2:  # half of them, of both species
        names = ("young_modulus", "damping_ratio", "deflection")
        wrong = fit(Trial.ringdown(cylinder, measured, start), names, options=options)
    return {
        "species": species,
        "status": result.status,
        "alarm": any(not test.passed for test in result.tests),
        "seconds": seconds,
        "whiskers": result.provenance["simulated_whiskers"],
        "error": error,
        "covered": {
            name: bool(result[name].interval.low <= truths[name] <= result[name].interval.high) for name in truths
        },
        "width": {name: result[name].relative_deviation for name in truths},
        "wrong_alarm": None if wrong is None else any(not test.passed for test in wrong.tests),
    }


def rows_of(found: list[dict]) -> list[list[str]]:
    """Return a row for each parameter: errors, share within the goal, coverage."""
    rows = []
    for name in found[0]["error"]:
        errors = np.abs([item["error"][name] for item in found])
        told = ["", ""]
        if name in found[0]["covered"]:
            covered = sum(item["covered"][name] for item in found)
            interval = wilson_interval(covered, len(found))
            told = [f"{100 * covered / len(found):.1f} [{100 * interval.low:.1f}, {100 * interval.high:.1f}]",
                    f"{100 * np.median([item['width'][name] for item in found]):.2f}"]  # fmt: skip
        rows.append([
            name, f"{100 * np.median(errors):.2f}", f"{100 * np.quantile(errors, 0.9):.2f}",
            f"{100 * np.mean(errors <= GOAL):.1f}", *told,
        ])  # fmt: skip
    return rows


def share(found: list[dict], name: str) -> str:
    """Return how many of the fits raised an alarm."""
    asked = [item[name] for item in found if item[name] is not None]
    interval = wilson_interval(sum(asked), len(asked))
    percent, low, high = (100 * one for one in (sum(asked) / len(asked), interval.low, interval.high))
    return f"{sum(asked)} of {len(asked)} ({percent:.1f} % [{low:.1f}, {high:.1f}])"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--simulations", type=int, default=200)
    parser.add_argument("--keep", type=Path, default=Path("build/fitting"), help="Folder of the fits made so far.")
    parser.add_argument("--only", help="Make the fits of one case and write no section: wrench-own, shape-finer, …")
    options = parser.parse_args()
    cases = [
        ("wrench", False), ("shape", False), ("wrench", True), ("shape", True),
    ]  # fmt: skip
    options.keep.mkdir(parents=True, exist_ok=True)
    parts = [
        "Whiskers C2 of mouse and rat in turn, Young's modulus and tip radius drawn with a spread of 25 %, damping "
        "ratio .08 "
        "to .25, let go from a deflection of 5 to 10 % of the length and read over five periods. Base wrench 24 "
        "times a period "
        f"with {100 * WRENCH_NOISE:g} % noise of the largest force or moment, or shapes of {POINTS} points 12 times a "
        f"period with {1e6 * SHAPE_NOISE:g} µm. Fits start from the "
        "published whisker; the base radius and density are known. Errors in %; coverage of the 95 % intervals "
        "(Laplace) with "
        "Wilson intervals. `taper` is the slope of the radius, (base radius − tip radius)/length."
    ]
    for kind, finer in cases:
        name = f"{kind}-{'finer' if finer else 'own'}"
        file = options.keep / f"{name}.json"
        found = read_json(file) if file.is_file() else []
        if options.only not in (None, name):
            continue
        count = options.simulations // (8 if finer else 1)
        for seed in range(len(found), count):
            found.append(one(kind, ("mouse", "rat")[seed % 2], seed, finer))
            if len(found) % 10 == 0 or len(found) == count:
                write_json(file, found)
                print(name, len(found), flush=True)
        title = (
            f"truth with {FINE.links} links and {FINE.steps_per_period:g} steps a period, fit at its default "
            f"({FitOptions().links} and {FitOptions().steps_per_period:g})"
            if finer
            else f"truth and fit with {QUICK.links} links and {QUICK.steps_per_period:g} steps a period"
        )
        heading = {"wrench": "Base wrench", "shape": "Traced shape"}[kind]
        columns = ["parameter", "median error", "90 %", f"within {100 * GOAL:g} %", "coverage", "deviation told"]
        parts.append(f"#### {heading}, {title} ({len(found)} simulations)")
        parts.append(table(columns, rows_of(found)))
        parts.append(
            f"Residuals of the right model are called structured in {share(found, 'alarm')} (asked for: 1 %), those "
            f"of a cylinder of the mean radius in {share(found, 'wrong_alarm')}. A fit simulates "
            f"{np.median([item['whiskers'] for item in found]):.0f} whiskers in "
            f"{np.median([item['seconds'] for item in found]):.2f} s of processor time (median)."
        )
    if options.only is None:
        command = f"python -m benchmarks.whiskers.fitting --simulations {options.simulations}"
        write_section(TITLE, command, "\n\n".join(parts), subject="whiskers")


if __name__ == "__main__":
    main()
