"""The control tick of a deployed policy with a brain-scored encoder, on the simulated XHand1 behind a real socket.

PYTHONPATH=. OMP_NUM_THREADS=1 python -m benchmarks.policies.deploy [--write]
Quiet link, then faults one by one: what the controller did about each.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.report import publish, script_parser, table
from robotics_bridge import hands
from robotics_bridge.deploy.controller import read_deployed, realtime
from robotics_bridge.deploy.links.simulated_hand import Faults, simulated_hand
from robotics_bridge.deploy.links.udp import UdpDriver
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.student import TactilePolicy

FAULTS = {
    "none": {},
    "20 % of reports lost": {"drop": 0.2},
    "up to 30 ms of jitter (overtaking)": {"jitter": 0.03},
    "10 % damaged": {"damage": 0.1},
    "150 ms late from 2 s on": {"delay": 0.15, "delay_after": 2.0},
    "silent after 2 s": {"silent_after": 2.0},
    "frozen after 2 s": {"frozen_after": 2.0},
    "5 % absurd joints": {"absurd": 0.05},
    "5 % NaN": {"nan": 0.05},
}
GOAL = {"p50": 5.0, "p99": 20.0}


def export(model: str, folder: Path) -> Path:
    """Write an untrained student with this front end, as brainbench policy export does."""
    hand = hands.load("xhand1")
    shapes = {"proprio": (36,), "tactile": (5, 5, 3)}
    obs = TensorDict({name: torch.zeros(1, *shape) for name, shape in shapes.items()}, [1])
    torch.manual_seed(0)
    tactile = {"name": model, "observe": "agg_force", "placement": "tips"}
    policy = TactilePolicy(obs, {"s": list(shapes)}, "s", 12, tactile=tactile)
    limits = hand.model.jnt_range
    mapping = {
        "names": hand.joints, "default": [0.3] * 12, "scale": [0.3] * 12, "low": limits[:, 0], "high": limits[:, 1],
    }  # fmt: skip
    deployment = {
        "rate": 40, "hand": "xhand1", "observe": "agg_force", "joints": hand.joints, "action_map": mapping,
        "frozen": {}, "links": list(hand.layout("med", "tips")),
    }  # fmt: skip
    return export_policy(policy, folder / model, deployment=deployment).path


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--models", nargs="+", default=["zhuang-intersection-ln-small", "zhuang-intersection-ln"])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    lines, told = [], []
    # Models as they are, then the first one ahead of all other work; faults of the first one.
    runs = [(model, "none", False) for model in options.models] + [(options.models[0], "none", True)]
    runs += [(options.models[0], fault, True) for fault in FAULTS if fault != "none"]
    with tempfile.TemporaryDirectory() as folder:
        deployed = {model: read_deployed(export(model, Path(folder))) for model in options.models}
        for model, fault, ahead in runs:
            seconds = options.seconds if fault == "none" else 5.0
            with (
                simulated_hand(faults=Faults(**FAULTS[fault]), seconds=seconds + 60) as ends,
                UdpDriver(*ends) as link,
                realtime() if ahead else contextlib.nullcontext(),
            ):
                # A shared machine may lose time; what is measured here is the tick.
                control = deployed[model].controller(link, limits={"rate_share": 0.3}, threads=options.threads)
                report = control.run(seconds)
            if fault == "none":
                latency = report.latency
                figures = [f"{latency[key]:.2f}" for key in ("p50", "p90", "p99", "max")]
                figures += [f"{report.processor[key]:.2f}" for key in ("p50", "p99")]
                facts = [str(report.ticks), f"{report.rate:.1f}", *figures, str(report.overruns), report.reason or "no"]
                lines.append([model, "yes" if ahead else "no", f"{os.getloadavg()[0]:.1f}", *facts])
                print(*lines[-1], flush=True)
            else:
                what = f"{report.status}: {report.reason}" if report.reason else report.status
                told.append([fault, f"{report.seconds:.1f}", what])
                print(*told[-1], flush=True)
    columns = ["encoder", "ahead", "load", "ticks", "Hz", "p50 ms", "p90", "p99", "max", "processor p50", "p99"]
    columns += ["over 25 ms", "stopped"]
    body = (
        "Reading, checking, deciding (ONNX Runtime, one thread), limiting and sending; 40 Hz. Goal: p50 under "
        "5 ms, p99 under 20 ms with the `-small` encoder. The machine was shared: its load stands beside each "
        "run, and the loop's own processor time beside the clock's. `ahead`: with `--realtime`, before all "
        "ordinary work of the computer (the simulated hand remains ordinary work); the faults were run so.\n\n"
        f"{table(columns, lines)}\n\n{table(['fault (5 s asked for)', 'seconds', 'what happened'], told)}"
    )
    publish(options, "Control tick of a deployed policy", body)


if __name__ == "__main__":
    main()
