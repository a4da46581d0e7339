"""How well calibration recovers synthetic devices that a ball presses: python -m benchmarks.tactile.devices [--write]

Coverage of 95 % intervals, errors on presses that were held out, and planted faults that are named.
"""

from __future__ import annotations

import numpy as np

from benchmarks.report import publish, script_parser, table
from robotics_bridge.sensors.calibration.devices import fit_device
from tests.factories.pressed_devices import FAULTS, outcomes, plant, tilts


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--devices", type=int, default=200)
    parser.add_argument("--faults", type=int, default=60)
    options = parser.parse_args()
    hits: dict[str, list[bool]] = {}
    errors, angles, accused = [], [], 0
    for seed in range(options.devices):
        planted = plant(seed)
        fit = fit_device(planted.presses)
        for name, values in outcomes(planted, fit).items():
            hits.setdefault(name, []).extend(values)
        errors.append(fit.held_out)
        angles.append(tilts(planted, fit).max())
        accused += bool(fit.faults)
    verdicts: dict[str, list[bool]] = {}
    for index in range(options.faults):
        fault = FAULTS[index % len(FAULTS)]
        faults = fit_device(plant(10_000 + index, fault).presses).faults
        verdicts.setdefault(fault, []).append(fault in {entry.kind for entry in faults})
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
    publish(options, "Tactile: devices that a ball presses", body, f"--devices {options.devices}")


if __name__ == "__main__":
    main()
