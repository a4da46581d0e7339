"""Measure error and cost of the whisker simulation over links × time step, and write the table that ships.

Run from the repository root: ``python benchmarks/whisker_fidelity.py [--out FILE]``. Subject: mouse whisker C2
(15.265 mm, radius 48.4 → 8.8 µm, 5 GPa). Per setting:

- ``static_error``: worst of the base-moment and base-force errors against the elastica over five frictionless pegs;
- ``dynamic_error``: base moment while whisking at 20 Hz against a frictionless post, root-mean-square difference
  from a fine simulation (40 links, 10 µs) over its root mean square, read every millisecond;
- ``sliding_error``: the same with friction .48;
- ``flick_error``: the same with friction while the whisker sweeps past the post and springs free in every whisk;
- ``error``: the worst of these four; ``Fidelity.auto`` chooses by it;
- ``cost``: processor seconds per simulated second of one whisker in contact, over the three whisking runs.
"""

from __future__ import annotations

import argparse
import itertools
import math
import platform
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainbench.errors import BrainbenchError
from brainbench.files import write_json
from brainbench.stimuli.backends import get_backend
from brainbench.stimuli.backends.protocol import Job, Trace
from brainbench.stimuli.fidelity import Fidelity
from brainbench.stimuli.obstacle import Capsule, Obstacle
from brainbench.stimuli.validation import peg
from brainbench.stimuli.whisker import Whisker

C2 = Whisker(
    0.015265, 48.365e-6, 8.78e-6, young_modulus=5e9, density=(1260.0, 1690.0), damping_ratio=0.32, friction=0.48
)
PEGS = ((0.3, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.2), (0.9, 0.1))
LINKS = (4, 6, 8, 10, 14, 20, 30)
TIME_STEPS = (2e-4, 1e-4, 5e-5, 2e-5)
FINE = Fidelity(links=40, time_step=1e-5)
FRAMES = np.arange(1.0, 151.0) * 1e-3


@dataclass(frozen=True)
class Whisk:
    """Whisking at 20 Hz by ± ``amplitude`` (rad) from a retracted start without a jump."""

    amplitude: float

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        ramp = np.clip(times / 0.025, 0, 1)
        swing = self.amplitude * (1 - np.cos(2 * np.pi * 20 * times) * (ramp**3 * (10 - 15 * ramp + 6 * ramp**2)))
        euler = np.tile([math.pi / 2, 0.0, -math.pi / 2], (len(times), 1))
        euler[:, 0] += swing - swing[0]
        return np.zeros((len(times), 3)), euler


def whisk(fidelity: Fidelity, friction: float, degrees: float = 12) -> Trace:
    post = Obstacle((Capsule((0.0107, 0.0012, -0.02), (0.0107, 0.0012, 0.02), 1e-3),), friction=friction)
    return get_backend("mujoco").run([Job(C2, Whisk(math.radians(degrees)), (post,), FRAMES)], fidelity, workers=1)[0]


def difference(trace: Trace, reference: Trace) -> float:
    gap = trace.wrench[:, 3:] - reference.wrench[:, 3:]
    return float(np.sqrt(np.mean(gap**2) / np.mean(reference.wrench[:, 3:] ** 2)))


def scenes(fidelity: Fidelity) -> tuple[Trace, Trace, Trace]:
    """Smooth, sliding and flicking contact."""
    return whisk(fidelity, 0.0), whisk(fidelity, C2.friction), whisk(fidelity, C2.friction, degrees=25)


def measure(links: int, time_step: float, fine: tuple[Trace, ...]) -> dict[str, object]:
    fidelity = Fidelity(links=links, time_step=time_step)
    static, note = 0.0, ""
    for at, offset in PEGS:
        try:
            result = peg(C2, at * C2.arc_length, offset * C2.arc_length, fidelity=fidelity)
            static = max(static, result.moment_error, result.force_error)
        except BrainbenchError as error:
            static, note = math.inf, str(error)
    traces = scenes(fidelity)
    dynamic, sliding, flick = (difference(trace, other) for trace, other in zip(traces, fine, strict=True))
    return {
        "links": links,
        "time_step": time_step,
        "error": max(static, dynamic, sliding, flick),
        "static_error": static,
        "dynamic_error": dynamic,
        "sliding_error": sliding,
        "flick_error": flick,
        "cost": float(sum(trace.seconds for trace in traces) / (len(traces) * FRAMES[-1])),
        "note": note,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    default = Path("brainbench/stimuli/fidelity_table.json")
    parser.add_argument("--out", type=Path, default=default)
    out = parser.parse_args().out
    fine = scenes(FINE)
    print(
        "flick, 40 links: 10 µs against 5 µs",
        difference(scenes(Fidelity(links=40, time_step=5e-6))[2], fine[2]),
        flush=True,
    )
    points = []
    for links, step in itertools.product(LINKS, TIME_STEPS):
        points.append(measure(links, step, fine))
        print(
            {key: round(value, 6) if isinstance(value, float) else value for key, value in points[-1].items()},
            flush=True,
        )
    import mujoco

    write_json(
        out,
        {
            "made_by": "benchmarks/whisker_fidelity.py",
            "subject": "mouse whisker C2",
            "error": "worst of static (elastica, five pegs), dynamic, sliding and flick (whisking on a post)",
            "cost": "processor seconds per whisker-second",
            "mujoco": mujoco.__version__,
            "machine": platform.machine(),
            "points": points,
        },
    )


if __name__ == "__main__":
    main()
