"""Exported policies beside the policy itself: how far their actions differ, their size and their step.

PYTHONPATH=. OMP_NUM_THREADS=1 python -m benchmarks.policies.exports [--write]
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.report import publish, script_parser, table
from robotics_bridge.policies.encoders.arms import ARMS, EncoderConfig
from robotics_bridge.policies.export import STEPS, TOLERANCE, export_policy, read_policy
from robotics_bridge.policies.student import TactilePolicy

NETWORKS = ("zhuang-intersection-ln-small.simclr", "s4-small", "zhuang-small+mamba")
_FLAT = {"proprio": (29,), "goal": (1,)}
_CALLS = 200


def student(name: str | None) -> TactilePolicy:
    """Return a student of in_palm_rotate with drawn weights, and force and torque on the whole hand."""
    tactile = None if name is None else {"name": name, "placement": "hand", "resolution": "med"}
    shapes: dict[str, tuple[int, ...]] = dict(_FLAT)
    if tactile is not None:
        shapes["tactile"] = EncoderConfig.of(tactile).build().shape
    torch.manual_seed(0)
    seen = TensorDict({group: 0.1 * torch.randn(64, *shape) for group, shape in shapes.items()}, [64])
    policy = TactilePolicy(seen, {"s": list(shapes)}, "s", 5, tactile=tactile)
    policy.update_normalization(seen)
    return policy.eval()


def main() -> None:
    options = script_parser(__doc__).parse_args()
    torch.set_num_threads(1)
    lines = []
    with tempfile.TemporaryDirectory() as folder:
        for name in (None, *ARMS, *NETWORKS):
            policy = student(name)
            row = {group: np.zeros(shape, np.float32) for group, shape in policy.shapes.items()}
            found = export_policy(policy, Path(folder) / f"{name}.onnx")
            run = read_policy(found.path, policy.shapes, threads=1)
            spent = []
            for call in range(_CALLS):
                begun = time.process_time()
                run(row, call == 0)
                spent.append(1e3 * (time.process_time() - begun))
            size = found.path.stat().st_size / 1e6
            figures = [f"{found.difference:.1e}", str(found.state_size), f"{size:.1f}"]
            lines.append([name or "none", *figures, f"{statistics.median(spent):.2f}"])
            print(*lines[-1], flush=True)
    text = (
        f"Largest difference of an action from the policy's over {STEPS} steps with resets, relative to the largest "
        f"action (a file beyond {TOLERANCE:g} is not kept); numbers of memory per row; median of {_CALLS} steps of "
        "one row. Students of `in_palm_rotate` with `force_torque` on the whole hand (none: without touch); "
        "normalisers, taxel grid, encoder, head and memory in one file.\n\n"
    )
    body = text + table(["encoder", "difference", "memory", "MB", "processor ms a step"], lines)
    publish(options, "Exported policies", body)


if __name__ == "__main__":
    main()
