"""How much better chosen motions tell two networks apart, on objects and animals that did not choose them.

``python -m benchmarks.whiskers.network_design [--write]``
"""

from __future__ import annotations

import math
import time

from benchmarks.report import publish, script_parser, table
from brainbench.scoring.recovery import design_for_networks
from brainbench.stimuli import PlacedObject, Scene, WhiskerArray, Whisking
from brainbench.stimuli.design import DesignOptions
from brainbench.stimuli.objects.primitives import box, cylinder
from brainbench.stimuli.scenes.frames import Frames

TITLE = "Motions that tell networks apart"
PLACE = (0.0105, 0.002, 0.003)
POSTS = {f"round {radius}": cylinder(radius * 1e-4, 0.02) for radius in (2, 3, 4, 5, 6, 7)} | {
    f"square {width}": box((width * 1e-4, width * 1e-4, 0.02)) for width in (5, 8, 11, 14)
}
FRAMES = Frames(first=0.051, interval=3e-3, count=60)
PAIRS = (
    ("zhuang-small.simclr", "resnet18-small.supervised"),
    ("zhuang-small.simclr", "zhuang-small.supervised"),
)
CHOICES = {"whisking": ("frequency", "protraction", "retraction"), "place of the object": ("object_x", "object_y")}
OPTIONS = DesignOptions(fidelity="fast", check="balanced", iterations=5, starts=8, searches=2)


def main() -> None:
    args = script_parser(__doc__).parse_args()
    array = WhiskerArray.of("mouse", whiskers="C1-C3")
    scenes = [
        Scene(name, array, (PlacedObject(solid, position=PLACE),), Whisking(frequency=10), frames=FRAMES)
        for name, solid in POSTS.items()
    ]
    rows = []
    for pair in PAIRS:
        for what, variables in CHOICES.items():
            began = time.process_time()
            found = design_for_networks(scenes, pair, variables, options=OPTIONS)
            seconds = time.process_time() - began
            motion = ", ".join(
                f"{name} {math.degrees(value):.0f}°" if name.endswith("traction") else f"{name} {value:.3g}"
                for name, value in found.values.items()
            )
            gain = f"[{found.gain.low:.3f}, {found.gain.high:.3f}]" if found.gain else "–"
            rows.append([
                " / ".join(pair), what, motion,
                *(f"{a:.3f} → {b:.3f}" for a, b in (found.contrast, found.held_out, found.leads)),
                gain, f"{found.won[0]:.2f} → {found.won[1]:.2f}", found.status, f"{seconds:.0f}",
            ])  # fmt: skip
            print(rows[-1], flush=True)
    text = (
        f"{len(POSTS)} posts at {PLACE} m, every other one held out; mouse whiskers C1 to C3, given motion 10 Hz, 30° "
        f"forward and 10° backward of rest; {FRAMES.count} frames of 3 ms. Contrast: 1 − CKA of the networks' last "
        "layers, given → chosen motion. Lead of the true network over the other in scores, on boards of ten animals "
        "drawn from each network for the held-out posts, with the 95 % interval of its growth (t over 20 boards with "
        "equal noise), and the share of boards that the true network wins. Processor seconds (PyTorch and Warp "
        f"together) at `{OPTIONS.fidelity}`, compared at `{OPTIONS.check}`.\n\n"
    )
    head = ["networks", "chosen", "motion", "contrast", "held-out posts", "lead", "growth", "won", "status", "s"]
    text += table(head, rows)
    publish(args, TITLE, text)


if __name__ == "__main__":
    main()
