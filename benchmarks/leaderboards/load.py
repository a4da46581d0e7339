"""How long a leaderboard of thousands of records takes to build, and how much memory.

    python -m benchmarks.leaderboards.load --records 10000

Every record is a shipped one with another network's numbers: values of animals and without each stimulus, and the RDMs
of network and random features, are drawn anew. Prints time, processor time and peak memory of ``brainbench leaderboard
build``, run as its users do, and of a second build into the same folder.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.report import publish, script_parser
from brainbench.core.records import ResultRecord, record_identity

RESULTS = Path(__file__).parents[2] / "leaderboards" / "results"


def write_records(folder: Path, count: int, *, seeds: int = 1) -> None:
    """Write records of ``count / seeds`` networks on one board."""
    folder.mkdir(parents=True, exist_ok=True)
    source = next(path for path in sorted(RESULTS.glob("*.json")) if "small" not in path.name)
    template, draw = json.loads(source.read_text(encoding="utf-8")), np.random.default_rng(0)
    for index in range(count):
        data = _drawn(template, f"network-{index // seeds:05d}", index % seeds, draw)
        text = msgspec.json.format(msgspec.json.encode(data, order="sorted"), indent=2)
        name = f"{data['score']['name']}--{record_identity(data)}.json"
        (folder / name).write_bytes(text + b"\n")
    ResultRecord.from_json(data)


def _drawn(template: dict[str, Any], name: str, seed: int, draw: np.random.Generator) -> dict[str, Any]:
    step = float(draw.normal(0, 0.05))

    def moved(score: dict[str, Any]) -> dict[str, Any]:
        ends = score["interval"] and {side: score["interval"][side] + step for side in ("low", "high")}
        animals = [part | {"value": part["value"] + step + float(draw.normal(0, 0.02))} for part in score["subjects"]]
        without = np.array(score["without_stimulus"])
        return score | {
            "value": score["value"] + step,
            "interval": ends and score["interval"] | ends,
            "subjects": animals,
            "without_stimulus": (without + step + draw.normal(0, 0.002, len(without))).tolist(),
            "model_rdm": draw.random(len(score["model_rdm"])).tolist(),
        }

    baselines = template["baselines"]
    return template | {
        "score": moved(template["score"]) | {"name": name},
        "baselines": baselines | {"random features": moved(baselines["random features"])},
        "card": template["card"] | {"name": name, "seed": seed, "weights": f"{name}-{seed}", "twin": name},
    }


def build(records: Path, site: Path) -> tuple[float, float, float]:
    """Return the time [s], that of the processors [s] and the peak memory [GB] of the command."""
    began = time.monotonic()
    words = [sys.executable, "-m", "brainbench", "leaderboard", "build", str(records), "--out", str(site)]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"the build ended with status {process.returncode}")
    scale = 1 if sys.platform == "darwin" else 1024
    return time.monotonic() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * scale / 1e9


def main() -> None:
    options = script_parser(__doc__)
    options.add_argument("--records", type=int, default=10_000)
    options.add_argument("--seeds", type=int, default=1, help="records of one network")
    options.add_argument("--folder", type=Path, help="where records and site are written, and stay")
    asked = options.parse_args()
    lines = [
        "| build | records | networks | time [s] | of processors [s] | peak memory [GB] |",
        "|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.folder or Path(temporary)
        write_records(folder / "records", asked.records, seeds=asked.seeds)
        for what in ("first", "again"):
            seconds, work, memory = build(folder / "records", folder / "site")
            counts = f"{asked.records:,} | {asked.records // asked.seeds:,}"
            lines.append(f"| {what} | {counts} | {seconds:.0f} | {work:.0f} | {memory:.2f} |")
            print(lines[-1], flush=True)
    publish(asked, "Building a leaderboard of thousands of records", "\n".join(lines), f"--records {asked.records}")


if __name__ == "__main__":
    main()
