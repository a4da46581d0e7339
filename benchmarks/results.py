"""Keep one section per benchmark in RESULTS.md: replaced when its benchmark runs again, others untouched."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from brainbench.core.files import write_text

RESULTS = Path(__file__).parent / "RESULTS.md"
HEAD = "# Benchmark results\n\nEach section is written by the command it names.\n"


def write_section(title: str, command: str, body: str, path: Path = RESULTS, *, where: str = "") -> None:
    """Replace the section ``title`` of ``path``, or append it; ``where`` says what measured it if not this machine."""
    text = path.read_text(encoding="utf-8") if path.exists() else HEAD
    load = f"{os.getloadavg()[0]:.1f}"
    machine = f"{platform.machine()}, {os.cpu_count()} processors, load {load} at the end"
    stamp = f"`{command}` — {where or machine}."
    section = f"## {title}\n\n{stamp}\n\n{body.strip()}\n"
    parts = text.split("\n## ")
    kept = [parts[0].rstrip() + "\n"]
    done = False
    for part in parts[1:]:
        if part.split("\n", 1)[0] == title:
            kept.append(section)
            done = True
        else:
            kept.append("## " + part.rstrip() + "\n")
    if not done:
        kept.append(section)
    write_text(path, "\n".join(kept))


def table(columns: list[str], rows: list[list[str]]) -> str:
    """Lay out a Markdown table."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])
