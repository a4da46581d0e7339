"""Contact forces from noisy shapes against the elastica.

``python -m benchmarks.whiskers.fitting_contacts [--shapes 160]``. Whiskers of mouse and rat are pressed by a
frictionless point at random places and depths (:func:`brainbench.stimuli.references.elastica`, which shares no code
with the fit), traced with 20 µm of noise, and their contact is estimated.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
from scipy.integrate import solve_ivp

from benchmarks.report import table, write_section
from brainbench.core.errors import UsageError
from brainbench.core.statistics import wilson_interval
from brainbench.stimuli import Whisker, WhiskerArray, references
from brainbench.stimuli.fitting import ContactOptions, find_contacts, new_shapes

TITLE = "Contact forces from shapes"
NOISE, POINTS, TRACED = 20e-6, 60, 0.97
WHISKERS = ("mouse B1", "mouse C2", "mouse D4", "rat B1", "rat C2", "rat D4")
DEPTHS = ((0.03, 0.06), (0.06, 0.12), (0.12, 0.25))
GOAL = 0.1


def pressed(whisker: Whisker, at: float, depth: float) -> tuple[references.Contact, float, np.ndarray]:
    """Return the contact, its force (N, positive to the left) and points of the shape by SciPy's integration."""
    place = at * whisker.arc_length
    contact = references.elastica(whisker, place, depth * whisker.arc_length + whisker.curvature * place**2)
    fx, fy = contact.force

    def slope(s: float, y: np.ndarray) -> list[float]:
        rest = 2 * whisker.curvature * math.cos(float(whisker.tangent_angle(s))) ** 3
        moment = (contact.point[0] - y[0]) * fy - (contact.point[1] - y[1]) * fx if s < contact.arc else 0.0
        return [math.cos(y[2]), math.sin(y[2]), rest + moment / float(whisker.bending_stiffness(s))]

    s = np.linspace(0, TRACED * whisker.arc_length, POINTS)
    found = solve_ivp(slope, (0, s[-1]), np.zeros(3), t_eval=s, rtol=1e-9, atol=1e-12, max_step=s[-1] / 200)
    return contact, math.copysign(math.hypot(fx, fy), contact.moment), found.y[:2].T


def measure(count: int) -> list[dict]:
    """Return errors of ``count`` shapes, without and with the contact point known to 20 µm."""
    rng, found = np.random.default_rng(25), []
    while len(found) < count:
        species, name = WHISKERS[len(found) % len(WHISKERS)].split()
        whisker = WhiskerArray.of(species)[name].whisker
        depths = DEPTHS[len(found) // len(WHISKERS) % len(DEPTHS)]
        at, depth = float(rng.uniform(0.25, 0.9)), float(rng.uniform(*depths)) * float(rng.choice([-1, 1]))
        try:
            contact, force, points = pressed(whisker, at, depth)
        except UsageError:  # it slips off
            continue
        if contact.arc > 0.97 * whisker.arc_length:
            continue
        angle = float(rng.uniform(-math.pi, math.pi))
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        traced = new_shapes([0.0], (points @ turn.T + rng.normal(size=points.shape) * NOISE)[None])
        place = np.array([contact.point]) @ turn.T + rng.normal(size=(1, 2)) * NOISE
        options, row = ContactOptions(noise=NOISE, contact_noise=NOISE), {"depths": depths, "species": species}
        for key, known in (("shape alone", None), ("contact point known", place)):
            started = time.process_time()
            one = find_contacts(traced, whisker, contact_points=known, options=options)
            row[key] = {
                "force": abs(float(one["force"][0]) / force - 1),
                "arc": abs(float(one["arc"][0]) - contact.arc) / whisker.arc_length,
                "covered": abs(float(one["force"][0]) - force) < 1.96 * float(one["force_deviation"][0]),
                "status": str(one["status"].values[0]),
                "seconds": time.process_time() - started,
            }
        found.append(row)
        if len(found) % 40 == 0:
            print(len(found), flush=True)
    return found


def row_of(found: list[dict], key: str, title: str) -> list[str]:
    """Return a row: count, force error of all and of those that are ok, place, coverage."""
    some = [item[key] for item in found]
    good = [one for one in some if one["status"] == "ok"]
    every, trusted = (np.array([one["force"] for one in part] or [np.nan]) for part in (some, good))
    inside = wilson_interval(int(np.sum(trusted <= GOAL)), max(len(good), 1))
    covered = wilson_interval(sum(one["covered"] for one in some), len(some))
    percent = [100 * np.median(every), 100 * np.quantile(every, 0.9), 100 * np.median(trusted)]
    percent += [100 * np.quantile(trusted, 0.9), 100 * np.mean(trusted <= GOAL), 100 * inside.low, 100 * inside.high]
    shares = [100 * np.mean([one["covered"] for one in some]), 100 * covered.low, 100 * covered.high]
    return [
        key,
        title,
        str(len(some)),
        f"{percent[0]:.1f} / {percent[1]:.1f}",
        str(len(good)),
        f"{percent[2]:.1f} / {percent[3]:.1f}",
        f"{percent[4]:.0f} [{percent[5]:.0f}, {percent[6]:.0f}]",
        f"{100 * np.median([one['arc'] for one in some]):.2f}",
        f"{shares[0]:.0f} [{shares[1]:.0f}, {shares[2]:.0f}]",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shapes", type=int, default=162)
    found = measure(parser.parse_args().shapes)
    rows = []
    for key in ("shape alone", "contact point known"):
        rows.append(row_of(found, key, "all"))
        rows += [row_of([item for item in found if item["species"] == one], key, one) for one in ("mouse", "rat")]
        rows += [
            row_of([item for item in found if item["depths"] == one], key, f"d/L {one[0]:g} to {one[1]:g}")
            for one in DEPTHS
        ]
    columns = [
        "known", "shapes", "n", "force error, median / 90 %", "ok", "of these, median / 90 %", f"within "
        f"{100 * GOAL:g} %",
        "error of the arc, % of L", "95 % interval covers",
    ]  # fmt: skip
    seconds = np.median([item["shape alone"]["seconds"] for item in found])
    body = (
        f"{', '.join(WHISKERS)}; a frictionless point at 25 to 90 % of the length pushes either way by d. {POINTS} "
        "points on "
        f"{100 * TRACED:g} % of the whisker with {1e6 * NOISE:g} µm of noise in each coordinate; the pose of the base "
        "is "
        "unknown. Truth: `references.elastica`. Errors in %. A force is `ok` when its standard deviation is told as "
        "below "
        f"15 %. {1e3 * seconds:.0f} ms of processor time a shape (median).\n\n" + table(columns, rows)
    )
    write_section(TITLE, "python -m benchmarks.whiskers.fitting_contacts", body, subject="whiskers")


if __name__ == "__main__":
    main()
