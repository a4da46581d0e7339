"""What friction at rest costs kinematic taxels: one update of a hand that holds a ball, beside the plain law.

    python -m benchmarks.tactile.friction_cost --write
    python -m benchmarks.tactile.friction_cost --device cuda --write

``--from FILE`` lays out what ``--out FILE`` kept elsewhere.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.tactile.scene import restore, snapshot
from benchmarks.tactile.throughput import measure
from brainbench.cli.tactile.scenes import Grip
from brainbench.core.devices import pick_device
from robotics_bridge import hands
from robotics_bridge.hands.scenes import holding
from robotics_bridge.physics import TouchScene
from robotics_bridge.sensors import KinematicTaxel, SensorSuite

HAND = "xhand1"
SETTINGS: dict[str, dict[str, Any]] = {
    "law": {},
    "law, springs": {"friction": 1.0},
    "engine totals": {"total": "engine"},
    "engine totals, springs (default of the tasks)": {"total": "engine", "friction": 1.0},
}
CASES = {"cpu": (("high", 256), ("low", 16)), "cuda": (("high", 4096), ("low", 4096), ("low", 256))}
ROUNDS = {"cpu": 15, "cuda": 5}


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--device", choices=list(CASES), default="cpu")
    parser.add_argument("--from", type=Path, dest="records")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if args.records:
        found = json.loads(args.records.read_text("utf-8"))
    else:
        state = settled(args.device)
        where = pick_device(args.device)
        rows = [row for density, envs in CASES[args.device] for row in cost(state, density, envs, args.device)]
        found = {"device": where.name if where.is_cuda else "", "rows": rows, "rounds": ROUNDS[args.device]}
    if args.out:
        args.out.write_text(json.dumps(found), "utf-8")
    time = "time on the device" if found["device"] else "processor time"
    body = f"{HAND} holds a ball; {time} of an update, least of {found['rounds']} rounds, settings in turn.\n\n"
    body += table(["taxels × environments", "forces", "µs", "× law"], found["rows"])
    title, words, where = "What friction at rest costs", "", ""
    if device := found["device"]:
        title, words, where = f"{title} ({device})", "--device cuda", f"one {device}"
    publish(args, title, body, words, where=where)


def settled(device: str) -> dict[str, np.ndarray]:
    """Return the state of one hand that has closed around the ball, on the engine of a device."""
    grip = Grip(HAND, device=device)
    grip.run(260)
    return snapshot(grip.engine.state)


def cost(state: dict[str, np.ndarray], density: str, envs: int, device: str) -> list[list[str]]:
    """Return one row of the table for each setting."""
    hand = hands.load(HAND)
    scene, layout = TouchScene.from_mujoco(holding(hand, radius=0.028, reach=0.9)), hand.layout(density, "hand")
    everywhere = restore(state, envs, device)
    suites = [
        SensorSuite(
            scene,
            {link: KinematicTaxel(link=link, probes=p, track=("object",), **knobs) for link, p in layout.items()},
            num_envs=envs,
            device=device,
        )
        for knobs in SETTINGS.values()
    ]
    least = [float("inf")] * len(suites)
    for _ in range(ROUNDS[device]):
        for number, suite in enumerate(suites):
            # The time step stays the same, so that a graph is replayed.
            update = lambda suite=suite: suite.update(everywhere, 0.002)  # noqa: E731
            least[number] = min(least[number], measure(update, device, groups=1))
    subject = f"{sum(len(probes) for probes in layout.values())} × {envs:,}"
    return [
        [subject, name, f"{value * 1e6:.0f}", f"{value / least[0]:.2f}"]
        for name, value in zip(SETTINGS, least, strict=True)
    ]


if __name__ == "__main__":
    main()
