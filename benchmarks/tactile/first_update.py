"""Processor time of the first update of nine sensors on a machine that never compiled them, clean and noisy.

python -m benchmarks.tactile.first_update --write
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace

from benchmarks.report import publish, script_parser, table
from benchmarks.tactile.scene import CLASSES, FULL, engine_of, scene_of, sensors
from robotics_bridge.sensors import SensorSuite


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--measure", choices=["clean", "noisy"], help="print it for the caches as they are")
    args = parser.parse_args()
    if args.measure:
        print(*seconds(noisy=args.measure == "noisy"))
        return
    rows = []
    for kind in ("clean", "noisy"):
        with tempfile.TemporaryDirectory() as cache:
            words = [sys.executable, "-m", "benchmarks.tactile.first_update", "--measure", kind]
            own = {"WARP_CACHE_PATH": f"{cache}/kernels", "BRAINBENCH_CACHE": f"{cache}/own"}
            for caches in ("empty", "filled"):
                told = subprocess.check_output(words, env={**os.environ, **own}, text=True)
                rows.append([kind, caches, *told.split()[-2:]])
                print(*rows[-1], flush=True)
    body = (
        "Nine sensors on the pyramid: one of each class, and taxels with friction and engine totals. Goal: 15 s with "
        "empty caches.\n\n"
    )
    body += table(["sensors", "caches", "suite built (processor s)", "first update (processor s)"], rows)
    publish(args, "First update of nine sensors", body)


def seconds(*, noisy: bool) -> tuple[str, str]:
    """Return the processor time [s] of building a suite and of its first update, which compiles."""
    config = {name: made for kind in CLASSES for name, made in sensors(kind).items()}
    config["friction"] = replace(config["kinematic"], total="engine", friction=1.0)
    if noisy:
        for name in ("kinematic", "depth", "contact", "proximity", "elastomer", "friction"):
            config[name] = replace(config[name], noise=replace(FULL, radius=0.0) if name == "elastomer" else FULL)
        config["distance"] = replace(config["distance"], noise=replace(type(FULL)(), white=1e-3, walk=1e-4))
    engine, scene = engine_of(2, "cpu"), scene_of()
    engine.step(2)
    before = time.process_time()
    suite = SensorSuite(scene, config, num_envs=2)
    built = time.process_time() - before
    suite.update(engine.state, 0.01)
    return f"{built:.1f}", f"{time.process_time() - before - built:.1f}"


if __name__ == "__main__":
    main()
