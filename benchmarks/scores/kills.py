"""Commands killed with SIGKILL at times over the whole run, repeated, and compared with unbroken runs.

    python -m benchmarks.scores.kills --out kills [--write]

The commands are those of ``tests/core/test_kills.py``; one that stands in the folder of ``--out`` is not killed again.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.report import measure_once, publish, script_parser, table

TITLE = "Kills"
PROGRAM = (sys.executable, "-m", "tests.core.test_kills")
HEAD = [
    "command", "unbroken", "kills", "resumed", "repeated", "files that differ", "left over", "failed", "two at once",
]  # fmt: skip


def kill(name: str, cache: Path) -> dict[str, Any]:
    """Kill one command as often as its slow test does, in a process of its own."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "BRAINBENCH_CACHE": str(cache)}
    with tempfile.TemporaryDirectory() as folder:
        words = [*PROGRAM, str(Path(folder) / "work"), name]
        found = subprocess.run(words, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(found.stdout.splitlines()[-1])


def row(found: dict[str, Any]) -> list[str]:
    """Return a line of the table."""
    counts = [str(found[name]) for name in ("kills", "resumed", "repeated")]
    faults = [str(len(found[name])) for name in ("different", "left", "failed")]
    return [found["name"], f"{found['seconds']:.1f} s", *counts, *faults, "; ".join(found["together"]) or "whole"]


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="Folder for the outcome of each command.")
    parser.add_argument("--known", action="store_true", help="Measure nothing that does not stand in --out.")
    chosen = parser.parse_args()
    names, cache = subprocess.check_output(PROGRAM, text=True).splitlines(), chosen.out / "cache"
    found = list(measure_once(chosen.out, names, lambda name: kill(name, cache), known=chosen.known).values())
    rows = [row(item) for item in found]
    total = [str(sum(item[name] for item in found)) for name in ("kills", "resumed", "repeated")]
    faults = [str(sum(len(item[name]) for item in found)) for name in ("different", "left", "failed")]
    text = f"{NOTE}\n\n{table(HEAD, [*rows, ['all', '', *total, *faults, '']])}"
    publish(chosen, TITLE, text, "--out kills", subject="commands")


NOTE = (
    "Each command runs in a process that is killed (SIGKILL) at a time drawn with a fixed seed over the duration of an "
    "unbroken run, and is then given again. *Resumed*: finished parts stood there and were kept; *repeated*: done "
    "anew. The result is compared with an unbroken run's, file by file and to the byte, but for `time`, `seconds`, "
    "`sweeps_per_second`, `collect_s` and `learn_s` in JSON files, pages (`.html`) that state the time, and "
    "TensorBoard's files. *Two at once*: two processes on one folder (and cache) finish, or one is refused in a "
    "sentence, and the result is whole. Every second kill of policy training falls after its first checkpoint, which "
    "comes late."
)


if __name__ == "__main__":
    main()
