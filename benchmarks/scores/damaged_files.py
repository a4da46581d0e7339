"""What becomes of damaged files: every reader of users' files, fed with seeded damage.

    python -m benchmarks.scores.damaged_files --cases 500 --out damaged --write

Each reader runs in a process of its own, so that a library that crashes or never returns is counted; one that stands in
the folder of ``--out`` is not run again. The cases are those of ``tests/core/reading/test_damaged_files.py``. What was
counted before the reading layer is taken from the kept section.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path

from benchmarks.report import measure_once, publish, read_sections, script_parser, table
from tests.factories.reading_surfaces import SURFACES
from tests.factories.reading_trials import LONGEST, attempt

FAILURES = ("traceback", "memory", "hang", "silent", "wordy", "crash", "half-written")
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


def before() -> dict[str, dict[str, int]]:
    """Return the failures of each reader before the reading layer, as the kept section tells them."""
    (kept,) = [section.body for section in read_sections() if section.title == TITLE]
    head, _, *lines = [line.strip("| ").split(" | ") for line in re.findall(r"^\|.*\|$", kept, re.MULTILINE)]
    return {
        name: {kind: int(cell.split(" → ")[0]) for kind, cell in zip(head[2:], cells, strict=True) if " → " in cell}
        for name, _, *cells in lines
    }


def rows(counts: dict[str, dict[str, int]]) -> list[list[str]]:
    """Return the lines of the table, and their sums; what was not counted before has no arrow."""
    earlier = {name: kinds for name, kinds in before().items() if name in counts}
    found = []
    for name in (*counts, "all"):
        now = counts[name] if name != "all" else _sum(counts)
        then = earlier.get(name, {}) if name != "all" else _sum(earlier)
        cells = [f"{then[kind]} → {now.get(kind, 0)}" if kind in then else str(now.get(kind, 0)) for kind in FAILURES]
        found.append([name, f"{sum(now.values()):,}", *cells])
    return found


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--only", help="name of one reader: print its outcomes")
    parser.add_argument("--first", type=int, default=0, help="seed of the first case")
    parser.add_argument("--out", type=Path, default=Path("damaged"), help="folder for the counts of each reader")
    parser.add_argument("--known", action="store_true", help="measure nothing that does not stand in --out")
    chosen = parser.parse_args()
    if chosen.only:
        attempts(chosen.only, chosen.first, chosen.cases)
        return
    names = [surface.name for surface in SURFACES]
    counts = measure_once(chosen.out, names, lambda name: dict(count(name, chosen.cases)), known=chosen.known)
    body = f"{NOTE}\n\n{table(['surface', 'cases', *FAILURES], rows(counts))}"
    publish(chosen, TITLE, body, f"--cases {chosen.cases} --out damaged", subject="commands")


NOTE = (
    "Failures of readers, before the reading layer → with it. A seeded mutator damages a good file: bits, truncation, "
    "repeated and zeroed bytes; other numbers, types and nesting in texts; other values, types, shapes, links and "
    "attributes in HDF5; other headers, values and objects in archives of arrays and weights; and a folder, FIFO, "
    "endless device or broken link in place of the file. *memory*: more than 2 GiB beyond the process; *hang*: more "
    "than 10 s of work, or 30 s by the clock; *silent*: a number that is not finite or out of range was accepted; "
    f"*wordy*: an error of more than {LONGEST} characters; *half-written*: refused, and something new was left in the "
    "folder. Few readers write (copies of recordings, imported weights, training); others have none by nature. "
    "Before is the code of 2026-11-21; for surfaces that came later (site manifest, commitment, trainings, and all "
    "after the seeds text) it is commit ad20c3f; where no arrow stands, nothing was counted before. That of the "
    "calibration log is not comparable: the log was also fitted then. Before: 500 cases each, *wordy* above 1,000."
)


def _sum(side: dict[str, dict[str, int]]) -> Counter[str]:
    total: Counter[str] = Counter()
    for counts in side.values():
        total.update(counts)
    return total


if __name__ == "__main__":
    main()
