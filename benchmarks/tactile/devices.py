"""How well calibration recovers synthetic devices that a ball presses: python -m benchmarks.tactile.devices [--write]

Coverage of 95 % intervals, errors on presses that were held out, and planted faults that are named.
"""

from __future__ import annotations

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.core.runs.jobs import run_jobs
from robotics_bridge.sensors.calibration.devices import fit_device
from tests.factories.pressed_devices import FAULTS, outcomes, plant, tilts


def fitted(job: tuple[int, str]) -> tuple[dict[str, list[bool]], float, float, set[str]]:
    """Return what intervals hold, error on held-out presses, worst normal and faults of a device with a planted one."""
    planted = plant(*job)
    fit = fit_device(planted.presses)
    kinds: set[str] = {entry.kind for entry in fit.faults}
    return outcomes(planted, fit), fit.held_out, float(tilts(planted, fit).max()), kinds


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--devices", type=int, default=200)
    parser.add_argument("--faults", type=int, default=60)
    parser.add_argument("--workers", type=int, help="processes; all processors by default")
    options = parser.parse_args()
    jobs = [(seed, "") for seed in range(options.devices)]
    jobs += [(10_000 + index, FAULTS[index % len(FAULTS)]) for index in range(options.faults)]
    found = dict(run_jobs(fitted, jobs, workers=options.workers))
    hits: dict[str, list[bool]] = {}
    verdicts: dict[str, list[bool]] = {}
    errors, angles, accused = [], [], 0
    for place, (_, fault) in enumerate(jobs):
        held, error, angle, kinds = found[place]
        if fault:
            verdicts.setdefault(fault, []).append(fault in kinds)
            continue
        for name, values in held.items():
            hits.setdefault(name, []).extend(values)
        errors.append(error)
        angles.append(angle)
        accused += bool(kinds)
    share = np.mean([np.mean(values) for values in hits.values()])
    rows = [[name, f"{np.mean(values):.1%}", f"{len(values)}"] for name, values in hits.items()]
    body = (
        f"{options.devices} devices of 3 × 3 taxels, 24 touches each; the last fifth held out.\n\n"
        f"{table(['number', 'intervals that hold it', 'of'], [*rows, ['mean', f'{share:.1%}', '']])}\n\n"
        f"Law on held-out presses: median {np.median(errors):.2%}, worst {np.max(errors):.2%}. Worst normal of a "
        f"device: median {np.median(angles):.2f}°, worst {np.max(angles):.2f}°. Accused without a fault: {accused}.\n\n"
        + table(["planted fault", "named", "of"],
                [[fault, f"{sum(values)}", f"{len(values)}"] for fault, values in verdicts.items()])
    )  # fmt: skip
    publish(
        options, "Tactile: devices that a ball presses", body, f"--devices {options.devices} --faults {options.faults}"
    )


if __name__ == "__main__":
    main()
