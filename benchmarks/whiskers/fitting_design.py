"""Whisks that chosen motions need over those of the default motion, to tell objects apart.

``python -m benchmarks.whiskers.fitting_design``
"""

from __future__ import annotations

import math
import time

import numpy as np

from benchmarks.report import table, write_section
from brainbench.stimuli import PlacedObject, Scene, WhiskerArray, Whisking
from brainbench.stimuli.design import DesignOptions, design
from brainbench.stimuli.objects.primitives import box, cylinder

TITLE = "Motions that tell objects apart"
PLACE = (0.0105, 0.002, 0.003)
ROUND = {radius: cylinder(radius, 0.02) for radius in (3e-4, 4.5e-4, 5e-4, 6e-4)}
SQUARE, OBLONG = box((0.001, 0.001, 0.02)), box((0.0012, 8e-4, 0.02))
SETS = {
    "cylinders of .3, .45 and .6 mm": {"a": ROUND[3e-4], "b": ROUND[4.5e-4], "c": ROUND[6e-4]},
    "round and square post": {"round": ROUND[5e-4], "square": SQUARE},
    "square and oblong post": {"square": SQUARE, "oblong": OBLONG},
}
CHOICES = {
    "protraction and retraction": ("protraction", "retraction"),
    "these and the frequency": ("frequency", "protraction", "retraction"),
    "place of the object": ("object_x", "object_y"),
}
GOAL = 0.5


def main() -> None:
    rows, seconds, options = [], [], DesignOptions(iterations=8)
    array = WhiskerArray.of("mouse", whiskers="C1-C3")
    for name, solids in SETS.items():
        scenes = [
            Scene(k, array, (PlacedObject(solid, position=PLACE),), whisking=Whisking(frequency=10))
            for k, solid in solids.items()
        ]
        for what, variables in CHOICES.items():
            began = time.process_time()
            found = design(scenes, variables, options=options)
            seconds.append(time.process_time() - began)
            words = {"frequency": "{:.1f} Hz", "object_x": "x {:+.2e} m", "object_y": "y {:+.2e} m"}
            told = ", ".join(
                words[key].format(value) if key in words else f"{key} {math.degrees(value):.0f}°"
                for key, value in found.values.items()
            )
            least = [min(pair[k] for pair in found.distances.values()) for k in (0, 1)]
            rows.append(
                [
                    name,
                    what,
                    told,
                    f"{least[0]:.3g}",
                    f"{least[1]:.3g}",
                    f"{found.whisks:.3f}",
                    f"{found.time:.3f}",
                    found.status,
                ]
            )
            print(rows[-1], flush=True)
    kept = sum(float(row[5]) <= GOAL for row in rows)
    sensor = f"{1e6 * options.force_noise:g} µN and {1e9 * options.moment_noise:g} nN·m at {options.rate:g} readings"
    body = (
        f"Mouse whiskers C1 to C3, posts at {PLACE} m, default motion 10 Hz, 30° forward and 10° backward of rest. "
        f"Sensor noise {sensor} per second. D² of the closest pair in a whisk, and whisks and time over those of the "
        f"default motion for the same D², at `{options.check}`. Goal: {GOAL:g} of the whisks; reached in {kept} "
        f"of {len(rows)}. `unreliable`: no better motion was found. A design takes {np.median(seconds):.0f} s of "
        "processor time (median).\n\n"
    )
    body += table(["objects", "chosen", "motion", "D² before", "D² after", "whisks", "time", "status"], rows)
    write_section(TITLE, "python -m benchmarks.whiskers.fitting_design", body, subject="whiskers")


if __name__ == "__main__":
    main()
