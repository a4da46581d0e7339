"""Processor time of the first minute: help, a first score and later ones, as ratios to ``import torch``.

python -m benchmarks.scores.first_minute [--rounds 5] [--write]

User and system time of the process and its children, median over the rounds; every round measures ``import torch``
too, so that a busy machine slows both sides of a ratio. A cold score finds empty caches of brainbench and of Warp.
Only what the README's installation holds can be imported: xarray would also load dask and pyarrow if they were there.
"""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.report import publish, script_parser, table
from tests.factories.installations import ROOT, link_installation

TITLE = "The first minute"
FIRST, OTHER = "zhuang-intersection-ln-small.simclr", "resnet18-small+gpt.simclr"
HELP = ([], ["score"], ["models"], ["stimuli", "render"], ["recovery"], ["leaderboard"], ["leaderboard", "add"])


def measure(words: list[str], **environment: str) -> float:
    """Return the processor time of a command, s."""
    before = os.times()
    subprocess.run([sys.executable, "-S", *words], env={**os.environ, **environment}, capture_output=True, check=True)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def imports(words: list[str], **environment: str) -> str:
    """Return a table of the packages whose imports cost the most, by their own time."""
    told = subprocess.run(
        [sys.executable, "-S", "-X", "importtime", *words],
        env={**os.environ, **environment}, capture_output=True, text=True, check=True,
    ).stderr  # fmt: skip
    spent: dict[str, float] = {}
    for own, name in re.findall(r"^import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)", told, flags=re.MULTILINE):
        package = name.partition(".")[0]
        spent[package] = spent.get(package, 0.0) + int(own) / 1000
    most = sorted(spent, key=spent.__getitem__, reverse=True)[:12]
    rows = [[name, f"{spent[name]:.0f}"] for name in most]
    return table(["package", "imports, ms"], [*rows, ["all", f"{sum(spent.values()):.0f}"]])


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    spent: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        out, installed = Path(name) / "out", link_installation(Path(name) / "installed", ())
        cache = {
            "BRAINBENCH_CACHE": f"{name}/cache",
            "WARP_CACHE_PATH": f"{name}/warp",
            "PYTHONPATH": f"{ROOT}{os.pathsep}{installed}",
        }
        score = ["-m", "brainbench", "score", "--out", str(out)]

        def take(what: str, words: list[str], **other: str) -> None:
            alone = measure(["-c", "import torch"], **cache)
            spent.setdefault("torch", []).append(alone)
            spent.setdefault(what, []).append(measure(words, **cache | other) / alone)

        take("cold: `score` with empty caches (goal 8)", [*score, FIRST])
        own = [*score, FIRST, "--recordings", "demo", "--stimuli", "objects", "--fidelity", "fast"]
        take("then with `--fidelity fast`: compiles the solver, simulates 40 objects", own)
        for index in range(options.rounds):
            take("again: the same `score` (goal 2)", [*score, FIRST])
            take(
                "`score` of another network, stimuli and recordings in the cache", [*score, OTHER, "--seed", str(index)]
            )
            for words in HELP:
                shown = " ".join(["brainbench", *words, "--help"])
                take(f"`{shown}` (goal .15)", ["-m", "brainbench", *words, "--help"])
        packages = imports([*score, OTHER, "--seed", "99"], **cache)
    alone = statistics.median(spent.pop("torch"))
    rows = [[what, f"{statistics.median(found):.2f}"] for what, found in spent.items()]
    body = (
        f"Processor time, as a ratio to `import torch` ({alone:.2f} s here), median of {options.rounds} (cold: once). "
        "The installation is that of the README, without extras. A cold score makes the demo recordings; their stimuli "
        "ship with the package. Stimuli of one's own compile the solver first. The same score again is read from the "
        "cache with its record, so no framework is loaded.\n\n"
        f"{table(['command', '× import torch'], rows)}\n\n"
        f"Imports of the score of another network, by package:\n\n{packages}"
    )
    publish(options, TITLE, body, subject="commands")


if __name__ == "__main__":
    main()
