"""How well calibration recovers synthetic devices that a ball presses: python -m benchmarks.tactile.devices [--write]

Coverage of 95 % intervals, errors on presses that were held out, and planted faults that are named.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from brainbench.core.runs.jobs import run_jobs
from robotics_bridge.sensors.calibration.devices import fit_device
from tests.factories.pressed_devices import FAULTS, KINDS, false_faults, outcomes, plant, tilts

STANDARD, *OTHERS = KINDS
HEADS = ["device", "status ok", "law, median", "worst", "normal, median °", "worst °", "intervals hold", "accused",
         "of them within tolerance"]  # fmt: skip


def fitted(job: tuple[int, str, str]) -> dict[str, Any]:
    """Return what intervals hold, law, worst normal, status, faults and false ones of a device with a planted one."""
    planted = plant(job[0], job[1], **KINDS[job[2]])
    fit = fit_device(planted.presses)
    return {"holds": outcomes(planted, fit), "law": fit.held_out, "normal": float(tilts(planted, fit).max()),
            "doubts": fit.doubts, "faults": [entry.kind for entry in fit.faults],
            "false": false_faults(planted, fit)}  # fmt: skip


def main() -> None:
    parser = script_parser(__doc__)
    for name, count in {"devices": 200, "faults": 60, "others": 8}.items():
        parser.add_argument(f"--{name}", type=int, default=count)
    parser.add_argument("--workers", type=int, help="processes; all processors by default")
    options = parser.parse_args()
    jobs = [(seed, "", STANDARD) for seed in range(options.devices)]
    jobs += [(10_000 + index, FAULTS[index % len(FAULTS)], STANDARD) for index in range(options.faults)]
    jobs += [(20_000 + index, "", kind) for index in range(options.others) for kind in OTHERS]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {job[1:]: [] for job in jobs}
    for place, result in run_jobs(fitted, jobs, workers=options.workers):
        groups[jobs[place][1:]].append(result)
    rows, hits, verdicts = [], [], []
    for (fault, kind), group in groups.items():
        sure = [result for result in group if not result["doubts"]]
        if fault:
            verdicts.append([fault, f"{sum(fault in result['faults'] for result in group)}", f"{len(group)}"])
            continue
        law, normal = (np.array([result[name] for result in sure] or [np.nan]) for name in ("law", "normal"))
        holds = {name: np.concatenate([result["holds"][name] for result in sure] or [[np.nan]])
                 for name in group[0]["holds"]}  # fmt: skip
        share = np.mean([values.mean() for values in holds.values()])
        accused = [f"{sum(bool(result[name]) for result in group)}" for name in ("faults", "false")]
        cells = [kind, f"{len(sure)} of {len(group)}", f"{np.median(law):.2%}", f"{law.max():.2%}",
                 f"{np.median(normal):.2f}", f"{normal.max():.2f}", f"{share:.1%}", *accused]  # fmt: skip
        rows.append([cell if "nan" not in cell else "–" for cell in cells])
        if kind == STANDARD:
            hits = [[name, f"{values.mean():.1%}", f"{len(values)}"] for name, values in holds.items()]
    body = (
        "24 touches of each device if not said otherwise, the last fifth held out. Errors and coverage are those of "
        "fits whose status is ok; normals are the worst of each device.\n\n"
        + "\n\n".join([table(HEADS, rows), table([f"number of {STANDARD}", "intervals that hold it", "of"], hits),
                       table(["planted fault", "named", "of"], verdicts)])
    )  # fmt: skip
    words = f"--devices {options.devices} --faults {options.faults} --others {options.others}"
    publish(options, "Tactile: devices that a ball presses", body, words)


if __name__ == "__main__":
    main()
