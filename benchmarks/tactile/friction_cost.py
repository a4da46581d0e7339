"""What friction at rest costs kinematic taxels: one update of a hand that holds a ball, beside the plain law.

python -m benchmarks.tactile.friction_cost --write
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from benchmarks.report import table, write_section
from brainbench.cli.tactile.scenes import Grip
from robotics_bridge.sensors import KinematicTaxel, SensorSuite

SETTINGS: dict[str, dict[str, Any]] = {
    "law": {},
    "law, springs": {"friction": 1.0},
    "engine totals": {"total": "engine"},
    "engine totals, springs (default of the tasks)": {"total": "engine", "friction": 1.0},
}
CASES = (("high", 256), ("low", 16))
ROUNDS, UPDATES = 40, 5


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    rows = [row for density, envs in CASES for row in measure(density, envs)]
    body = "xhand1 holds a ball; processor time of an update, least of 40 rounds of five, settings in turn.\n\n"
    body += table(["taxels × environments", "forces", "µs", "× law"], rows)
    print(body)
    if args.write:
        command = "python -m benchmarks.tactile.friction_cost --write"
        write_section("What friction at rest costs", command, body, subject="tactile")


def measure(density: str, envs: int) -> list[list[str]]:
    """Return one row of the table for each setting."""
    grip = Grip("xhand1", envs=envs)
    grip.run(260)
    layout = grip.hand.layout(density, "hand")
    state, step = grip.engine.state, grip.engine.timestep
    suites = [
        SensorSuite(
            grip.engine.scene,
            {link: KinematicTaxel(link=link, probes=p, track=("object",), **knobs) for link, p in layout.items()},
            num_envs=envs,
        )
        for knobs in SETTINGS.values()
    ]
    least = [float("inf")] * len(suites)
    for _ in range(ROUNDS):
        for number, suite in enumerate(suites):
            before = time.process_time()
            for _ in range(UPDATES):
                suite.update(state, step)
            least[number] = min(least[number], (time.process_time() - before) / UPDATES)
    subject = f"{sum(len(probes) for probes in layout.values())} × {envs}"
    return [
        [subject, name, f"{value * 1e6:.0f}", f"{value / least[0]:.2f}"]
        for name, value in zip(SETTINGS, least, strict=True)
    ]


if __name__ == "__main__":
    main()
