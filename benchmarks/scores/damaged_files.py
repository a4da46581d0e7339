"""What becomes of damaged files: every reader of users' files, fed with seeded damage.

    python -m benchmarks.scores.damaged_files --cases 500 --out before.json
    python -m benchmarks.scores.damaged_files --cases 500 --before before.json --write

Each reader runs in a process of its own, so that a library that crashes or never returns is counted. The cases
are those of ``tests/core/reading/test_damaged_files.py``.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path

from benchmarks.report import table, write_section
from brainbench.core.files import write_json
from tests.factories.reading_surfaces import SURFACES
from tests.factories.reading_trials import attempt

FAILURES = ("traceback", "memory", "hang", "silent", "wordy", "crash")
STUCK = 60.0
"""Seconds without an outcome after which a case is taken to hang inside a library."""
TITLE = "Damaged files"


def count(name: str, cases: int) -> Counter[str]:
    """Return how often each outcome came; a case that ends or stops the process counts, and the next one goes on."""
    found: Counter[str] = Counter()
    while (first := sum(found.values())) < cases:
        words = [sys.executable, "-m", "benchmarks.scores.damaged_files", "--only", name, "--first", str(first)]
        with subprocess.Popen([*words, "--cases", str(cases)], stdout=subprocess.PIPE, text=True) as child:
            # Before its first outcome a process starts and makes a good file.
            watch = threading.Timer(20 * STUCK, child.kill)
            watch.start()
            for line in child.stdout or ():
                watch.cancel()
                found[line.strip()] += 1
                watch = threading.Timer(STUCK, child.kill)
                watch.start()
            watch.cancel()
            stuck = child.wait() == -signal.SIGKILL
        if sum(found.values()) < cases:
            found["hang" if stuck else "crash"] += 1
            print(f"{name} {sum(found.values()) - 1}: {'hang' if stuck else 'crash'} in C", file=sys.stderr)
    return found


def attempts(name: str, first: int, cases: int) -> None:
    """Print the outcome of each case, and on stderr what failed."""
    surface = next(item for item in SURFACES if item.name == name)
    with tempfile.TemporaryDirectory() as folder:
        good = surface.make(Path(folder))
        for seed in range(first, cases):
            outcome = attempt(surface, good, seed)
            if outcome.kind in FAILURES:
                print(f"{name} {seed}: {outcome.kind}: {outcome.what}: {outcome.detail[:200]!r}", file=sys.stderr)
            print(outcome.kind, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--only", help="name of one reader: print its outcomes")
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--out", type=Path, help="JSON file for the counts; what it holds already is kept")
    parser.add_argument("--before", type=Path, help="such a file of an earlier state")
    parser.add_argument("--write", action="store_true", help="write the section of RESULTS.md")
    chosen = parser.parse_args()
    if chosen.only:
        attempts(chosen.only, chosen.first, chosen.cases)
        return
    kept: dict[str, dict[str, int]] = json.loads(chosen.out.read_text()) if chosen.out and chosen.out.exists() else {}
    counts: dict[str, dict[str, int]] = {}
    for surface in SURFACES:
        found = kept.get(surface.name, {})
        counts[surface.name] = found if sum(found.values()) == chosen.cases else dict(count(surface.name, chosen.cases))
        print(surface.name, counts[surface.name], flush=True)
        if chosen.out:
            write_json(chosen.out, {**kept, **counts})
    before = json.loads(chosen.before.read_text()) if chosen.before else {}
    rows = []
    for name in (*counts, "all"):
        sides = [side.get(name, {}) if name != "all" else _sum(side) for side in (before, counts)]
        cells = [f"{sides[0].get(kind, 0)} → {sides[1].get(kind, 0)}" for kind in FAILURES]
        rows.append([name, str(sum(sides[1].values())), *cells])
    body = table(["surface", "cases", *FAILURES], rows)
    if chosen.write:
        command = f"python -m benchmarks.scores.damaged_files --cases {chosen.cases} --write"
        write_section(TITLE, command, f"{NOTE}\n\n{body}", subject="commands")
    else:
        print(body)


NOTE = (
    "Failures of readers, before the reading layer → with it. A seeded mutator damages a good file: bits, truncation, "
    "repeated and zeroed bytes; other numbers, types and nesting in texts; other values, types, shapes, links and "
    "attributes in HDF5; other headers, values and objects in archives of arrays and weights; and a folder, FIFO, "
    "endless device or broken link in place of the file. *memory*: more than 2 GiB beyond the process; *hang*: more "
    "than 10 s of work, or 30 s by the clock; *silent*: a number that is not finite or out of range was accepted; "
    "*wordy*: an error of more than 1,000 characters. Before is the code of 2026-11-21; for surfaces that came later "
    "(site manifest, commitment, trainings, and all after the seeds text) it is commit ad20c3f."
)


def _sum(side: dict[str, dict[str, int]]) -> Counter[str]:
    total: Counter[str] = Counter()
    for counts in side.values():
        total.update(counts)
    return total


if __name__ == "__main__":
    main()
