"""Contact forces from noisy shapes against the elastica.

``python -m benchmarks.whiskers.fitting_contacts [--shapes 160]``. Whiskers of mouse and rat are pressed by a
frictionless point at random places and depths (:func:`brainbench.stimuli.references.elastica`, which shares no code
with the fit), traced with 20 µm of noise, and their contact is estimated. Errors stand beside those of an estimator at
the Cramér-Rao bound, from the Fisher information of the shape at the truth; and small deflections are traced in several
frames as well, in which the point goes on.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any

import numpy as np
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import erf

from benchmarks.report import table, write_section
from brainbench.core.errors import UsageError
from brainbench.core.statistics import wilson_interval
from brainbench.stimuli import Whisker, WhiskerArray, references
from brainbench.stimuli.fitting import ContactOptions, find_contacts, new_shapes
from brainbench.stimuli.fitting.contacts import ContactSolver

TITLE = "Contact forces from shapes"
NOISE, POINTS, TRACED = 20e-6, 60, 0.97
WHISKERS = ("mouse B1", "mouse C2", "mouse D4", "rat B1", "rat C2", "rat D4")
DEPTHS = ((0.03, 0.06), (0.06, 0.12), (0.12, 0.25))
GOAL = 0.1
FRAMES, ADVANCE, VIDEOS = 9, 0.1, 24
"""Frames of a video, how much its depth changes either way, and how many videos."""
ALONE, KNOWN, OF_VIDEO, VIDEO = "shape alone", "contact point known", "one frame of nine", "nine frames"


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


def bound(whisker: Whisker, contact: references.Contact, force: float, points: np.ndarray) -> float:
    """Return the least relative standard deviation of the force that an unbiased estimate of a shape can have."""
    solver, length, step = ContactSolver(whisker, ContactOptions(noise=NOISE)), whisker.arc_length, 1e-5
    unit = float(solver.force(np.array([contact.arc]), np.array([length]))[0])
    truth = np.array([0.0, 0.0, 0.0, contact.arc / length, force / unit])
    moves = step * np.concatenate([np.eye(5), -np.eye(5)])
    values = solver.residuals(truth + moves, points, np.full(2, np.nan), NOISE)
    jacobian = (values[:5] - values[5:]).T / (2 * step)
    sizes = solver.force((truth + moves)[:, 3] * length, (truth + moves)[:, 4] * length)
    slope = (sizes[:5] - sizes[5:]) / (2 * step)
    return float(np.sqrt(slope @ np.linalg.solve(jacobian.T @ jacobian, slope)) / abs(force))


def draw(rng: np.random.Generator, index: int, depths: tuple[float, float], changes: np.ndarray) -> tuple | None:
    """Return a whisker and its contacts as of :func:`pressed`, of depths that change; None where it slips off."""
    species, name = WHISKERS[index % len(WHISKERS)].split()
    whisker = WhiskerArray.of(species)[name].whisker
    at, depth = float(rng.uniform(0.25, 0.9)), float(rng.uniform(*depths)) * float(rng.choice([-1, 1]))
    try:
        shots = [pressed(whisker, at, depth * float(change)) for change in changes]
    except UsageError:
        return None
    kept = all(contact.arc <= 0.97 * whisker.arc_length for contact, *_ in shots)
    return (species, whisker, shots) if kept else None


def judge(one: xr.Dataset, frame: int, contact: references.Contact, force: float, length: float) -> dict:
    """Return errors of one frame, and whether its interval covers."""
    found = {name: one[name].values[frame] for name in ("force", "arc", "force_deviation", "status")}
    return {
        "force": abs(float(found["force"]) / force - 1),
        "arc": abs(float(found["arc"]) - contact.arc) / length,
        "covered": abs(float(found["force"]) - force) < 1.96 * float(found["force_deviation"]),
        "status": str(found["status"]),
    }


def measure(count: int) -> list[dict]:
    """Return errors of ``count`` shapes, without and with the contact point known to 20 µm."""
    rng, found = np.random.default_rng(25), []
    while len(found) < count:
        depths = DEPTHS[len(found) // len(WHISKERS) % len(DEPTHS)]
        drawn = draw(rng, len(found), depths, np.ones(1))
        if drawn is None:
            continue
        species, whisker, [(contact, force, points)] = drawn
        angle = float(rng.uniform(-math.pi, math.pi))
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        traced = new_shapes([0.0], (points @ turn.T + rng.normal(size=points.shape) * NOISE)[None])
        place = np.array([contact.point]) @ turn.T + rng.normal(size=(1, 2)) * NOISE
        row = {"depths": depths, "species": species, "bound": bound(whisker, contact, force, points)}
        for key, known in ((ALONE, None), (KNOWN, place)):
            started = time.process_time()
            options = ContactOptions(noise=NOISE, contact_noise=NOISE)
            one = find_contacts(traced, whisker, contact_points=known, options=options)
            row[key] = judge(one, 0, contact, force, whisker.arc_length)
            row[key]["seconds"] = time.process_time() - started
        found.append(row)
        if len(found) % 40 == 0:
            print(len(found), flush=True)
    return found


def measure_videos(count: int) -> list[dict]:
    """Return errors of the middle frame of ``count`` videos of small deflections, by itself and with the others."""
    rng, found = np.random.default_rng(26), []
    while len(found) < count:
        drawn = draw(rng, len(found), DEPTHS[0], np.linspace(1 - ADVANCE, 1 + ADVANCE, FRAMES))
        if drawn is None:
            continue
        _, whisker, shots = drawn
        noisy = [points + rng.normal(size=points.shape) * NOISE for *_, points in shots]
        traced = new_shapes(np.arange(FRAMES) * 2e-3, np.stack(noisy))
        contact, force, points = shots[FRAMES // 2]
        row: dict = {"bound": bound(whisker, contact, force, points)}
        options = ContactOptions(noise=NOISE, frames=FRAMES)
        middle = slice(FRAMES // 2, FRAMES // 2 + 1)
        alone = find_contacts(traced.isel(time=middle), whisker, options=ContactOptions(noise=NOISE))
        row[OF_VIDEO] = judge(alone, 0, contact, force, whisker.arc_length)
        together = find_contacts(traced, whisker, options=options)
        row[VIDEO] = judge(together, FRAMES // 2, contact, force, whisker.arc_length)
        found.append(row)
        print("video", len(found), flush=True)
    return found


def at_bound(found: list[dict], share: float) -> float:
    """Return the error below which a share of the estimates would be, were all normal with their bound as deviation."""
    deviation = np.array([item["bound"] for item in found])
    found_error: Any = brentq(lambda error: np.mean(erf(error / deviation / math.sqrt(2))) - share, 1e-6, 10)
    return float(found_error)


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
    told = key in (ALONE, OF_VIDEO)
    return [
        key,
        title,
        str(len(some)),
        f"{percent[0]:.1f} / {percent[1]:.1f}",
        f"{100 * at_bound(found, 0.5):.1f} / {100 * at_bound(found, 0.9):.1f}" if told else "",
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
    for key in (ALONE, KNOWN):
        rows.append(row_of(found, key, "all"))
        rows += [row_of([item for item in found if item["species"] == one], key, one) for one in ("mouse", "rat")]
        rows += [
            row_of([item for item in found if item["depths"] == one], key, f"d/L {one[0]:g} to {one[1]:g}")
            for one in DEPTHS
        ]
    videos = measure_videos(VIDEOS)
    small = f"d/L {DEPTHS[0][0]:g} to {DEPTHS[0][1]:g}"
    rows += [row_of(videos, key, small) for key in (OF_VIDEO, VIDEO)]
    columns = [
        "known", "shapes", "n", "error, median / 90 %", "at the bound", "ok", "of these, median / 90 %",
        f"within {100 * GOAL:g} %", "error of the arc, % of L", "95 % interval covers",
    ]  # fmt: skip
    seconds = np.median([item[ALONE]["seconds"] for item in found])
    body = (
        f"{', '.join(WHISKERS)}; a frictionless point at 25 to 90 % of the length pushes either way by d. {POINTS} "
        f"points on {100 * TRACED:g} % of the whisker with {1e6 * NOISE:g} µm of noise in each coordinate; the pose of "
        "the base is unknown. Truth: `references.elastica`. Errors of the force in %. A force is `ok` when its "
        "standard deviation is told as below 15 %. *At the bound*: what an unbiased estimate of the same shapes would "
        "show at the least deviation that the Fisher information allows. Nine frames: the depth grows by "
        f"{200 * ADVANCE:g} % over them, place and force are taken to change evenly, and the middle one is judged. "
        f"{1e3 * seconds:.0f} ms of processor time a shape (median).\n\n" + table(columns, rows)
    )
    write_section(TITLE, "python -m benchmarks.whiskers.fitting_contacts", body, subject="whiskers")


if __name__ == "__main__":
    main()
