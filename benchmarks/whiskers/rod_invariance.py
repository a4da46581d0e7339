"""What should change nothing in ``rod``, and what it costs: untouched objects, distance, length of a run, cadence.

python -m benchmarks.whiskers.rod_invariance [--write]

A mouse whisker whisks at 20 Hz (±20°) for 200 ms against three small balls, one whisker at a time, one thread.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import publish, script_parser, table
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.protocol import Job, Trace
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.objects.obstacle import Obstacle, Sphere
from brainbench.stimuli.whiskers.array import WhiskerArray

TIMES = np.arange(1, 201) * 1e-3
TOUCHED = ((0.012, 0.003, 0.0), (0.011, -0.003, 0.0), (0.013, 0.003, 1e-3))
TRIES = 5


@dataclass(frozen=True)
class Whisk:
    """Whisking in the plane, displaced."""

    by: tuple[float, float, float] = (0.0, 0.0, 0.0)
    finest: float = 0.05

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        angle = 0.35 * np.sin(40 * np.pi * times) + np.pi / 2
        euler = np.column_stack([angle, np.zeros_like(times), np.full_like(times, -np.pi / 2)])
        return np.tile(self.by, (len(times), 1)), euler


def ball(place: Sequence[float], radius: float = 5e-4) -> Obstacle:
    x, y, z = map(float, place)
    return Obstacle((Sphere((x, y, z), radius),))


def touched(by: Sequence[float] = (0.0, 0.0, 0.0)) -> tuple[Obstacle, ...]:
    return tuple(ball(np.add(place, by)) for place in TOUCHED)


def others(count: int, low: float, high: float) -> tuple[Obstacle, ...]:
    """Balls at distances from ``low`` to ``high`` (m) from the base, 2 mm or more from the plane of whisking."""
    rng = np.random.default_rng(0)
    found: list[Obstacle] = []
    while len(found) < count:
        place = rng.uniform(-high, high, 3)
        if low <= np.linalg.norm(place) <= high and abs(place[2]) > 2e-3:
            found.append(ball(place, 2e-4))
    return tuple(found)


def run(
    obstacles: tuple[Obstacle, ...], fidelity: Fidelity, *, tries: int = 1, **changes: object
) -> tuple[Trace, float]:
    """Return the trace and the least processor time (s) of some tries."""
    given = {"whisker": WhiskerArray.mouse()["C2"].whisker, "follicle": Whisk(), "times": TIMES, **changes}
    spent = []
    for _ in range(tries):
        started = time.process_time()
        (trace,) = RodEngine().run([Job(obstacles=obstacles, **given)], fidelity, workers=1)
        spent.append(time.process_time() - started)
    return trace, min(spent)


def change(found: NDArray[np.float64], expected: NDArray[np.float64]) -> str:
    """Return the largest difference of force and of moment in % of the largest of each."""
    parts = (slice(3), slice(3, 6))
    misses = [np.abs(found - expected)[:, part].max() / np.abs(expected[:, part]).max() for part in parts]
    return " / ".join(f"{100 * miss:.2g}" for miss in misses)


def main() -> None:
    arguments = script_parser(__doc__).parse_args()
    balanced = Fidelity.preset("balanced")
    alone, least = run(touched(), balanced, tries=TRIES)
    rows = [["three balls", f"{1e3 * least:.1f}", "1", "0 / 0"]]
    crowds = {
        "three, and 997 within reach": (997, 0.0, 0.0153),
        "three, and 997 out of reach": (997, 0.03, 0.3),
        "three, and 9,997 out of reach": (9997, 0.03, 0.3),
    }
    for name, crowd in crowds.items():
        trace, spent = run((*touched(), *others(*crowd)), balanced, tries=TRIES)
        rows.append([name, f"{1e3 * spent:.1f}", f"{spent / least:.2f}", change(trace.wrench, alone.wrench)])
    text = [table(["scene", "processor ms", "× three", "change of force / moment %"], rows), ""]
    rows = []
    for metres in (1.0, 10.0, 100.0):
        by = (metres, 0.5003 * metres, -0.3331 * metres)
        trace, _ = run(touched(by), balanced, follicle=Whisk(by))
        rows.append([f"{metres:g} m from the origin", change(trace.wrench, alone.wrench)])
    for end in (10.0, 100.0):
        whisk = np.arange(1, 51) * 1e-3
        trace, _ = run(touched(), balanced, times=np.concatenate([0.2 + whisk, end + whisk]))
        rows.append([f"after {end:g} s, against after .2 s", change(trace.wrench[50:], trace.wrench[:50])])
    for preset in ("fast", "balanced", "accurate"):
        fidelity = Fidelity.preset(preset)
        often, _ = run(touched(), fidelity)
        seldom, _ = run(touched(), fidelity, times=TIMES[6::7])
        rows.append([f"read every 7 ms instead of every 1 ms, `{preset}`", change(seldom.wrench, often.wrench[6::7])])
    text += [table(["change", "of force / moment, % of the largest"], rows), ""]
    text.append(
        f"Least processor time of {TRIES} tries. Steps are equal parts of the time between two readings, so another "
        "cadence makes other steps; nothing else may change them but what is touched."
    )
    body = "\n".join(text)
    publish(arguments, "What changes nothing in rod, and what it costs", body)


if __name__ == "__main__":
    main()
