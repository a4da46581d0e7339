"""Keep measured results, one JSON file a section, and write RESULTS.md from all of them.

``python -m benchmarks.report`` writes the page anew. A section says its subject, the command that made it, the date,
the machine, and a body in Markdown.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import sys
from collections.abc import Callable, Container, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.files import read_json, write_json, write_text

FOLDER = Path(__file__).parent / "results"
PAGE = Path(__file__).with_name("RESULTS.md")
SUBJECTS = {
    "commands": "Commands",
    "whiskers": "Whisker simulation",
    "models": "Networks and training",
    "scores": "Scores and statistics",
    "leaderboards": "Leaderboards",
    "tactile": "Tactile simulation",
    "policies": "Tasks, policies and deployment",
}
HEAD = (
    "# Measured results\n\n"
    "Every figure stands with the command that made it, the date and the machine. This page is written by "
    "`python -m benchmarks.report` from `benchmarks/results/*.json`; commands run in the repository's root.\n"
)


@dataclass(frozen=True)
class Section:
    """One measured result."""

    title: str
    subject: str
    """One of :data:`SUBJECTS`."""
    command: str
    """What made it; empty where the body names several."""
    date: str
    """Day of the measurement, ``YYYY-MM-DD``."""
    where: str
    """Machine and its load; empty for the machine on which CI runs."""
    body: str
    """Markdown without a heading."""

    @property
    def path(self) -> Path:
        """File of the section, named by its title."""
        return FOLDER / file_name(self.title)


def file_name(title: str) -> str:
    """Return the name of the JSON file of a title."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:60].strip("-") + ".json"


def measure_once(
    folder: Path, names: Iterable[str], measure: Callable[[str], dict[str, Any]], *, known: bool = False
) -> dict[str, dict[str, Any]]:
    """Return the measurement of each name, kept as a JSON file; one that stands in the folder is not made again.

    Args:
        folder: where the files stand.
        names: what to measure, in order.
        measure: makes one measurement.
        known: leave out what does not stand there instead of measuring it.
    """
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        path = folder / file_name(name)
        if not path.is_file():
            if known:
                continue
            write_json(path, measure(name))
        found[name] = read_json(path)
        print(name, found[name], flush=True)
    return found


def with_notes(text: str, notes: Path | None) -> str:
    """Return the body of a section and, below it, the text of a file that was written by hand."""
    return text if notes is None else f"{text}\n\n{notes.read_text(encoding='utf-8').strip()}"


def script_parser(doc: str | None, *, notes: bool = False) -> argparse.ArgumentParser:
    """Return a parser whose help is a script's docstring, with ``--write`` and, where asked for, ``--notes``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="keep the section and write RESULTS.md anew")
    if notes:
        parser.add_argument("--notes", type=Path, help="text that follows the tables")
    return parser


def publish(
    options: argparse.Namespace, title: str, body: str, words: str = "", *, subject: str = "", where: str = ""
) -> None:
    """Print the body of a section, with the notes that were given, and keep it with ``--write``.

    Args:
        options: what a parser of :func:`script_parser` understood.
        title: heading, which names the section.
        body: Markdown without a heading.
        words: options of the command that made it, other than ``--write``; the script is the one that runs.
        subject: one of :data:`SUBJECTS`; that of the script's folder if empty.
        where: what measured it, if not this machine.
    """
    body = with_notes(body, getattr(options, "notes", None))
    print(body)
    if options.write:
        script = sys.modules["__main__"].__spec__
        assert script is not None, "a script is run as python -m benchmarks.SUBJECT.NAME"
        command = " ".join(filter(None, ("python -m", script.name, words, "--write")))
        write_section(title, command, body, subject=subject or script.name.split(".")[1], where=where)


def write_section(title: str, command: str, body: str, *, subject: str, where: str = "") -> None:
    """Replace or add a section, and write the page anew.

    Args:
        title: heading, which names the section.
        command: what made it.
        body: Markdown without a heading.
        subject: one of :data:`SUBJECTS`.
        where: what measured it, if not this machine.
    """
    if subject not in SUBJECTS:
        raise unknown_name("subject", subject, SUBJECTS)
    machine = f"{platform.machine()}, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} at the end"
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    section = Section(title, subject, command, today, where or machine, body.strip())
    write_json(section.path, asdict(section))
    write_page()


def read_sections() -> list[Section]:
    """Return all sections, by subject and then by title."""
    sections = [Section(**read_json(path)) for path in sorted(FOLDER.glob("*.json"))]
    for section in sections:
        if section.subject not in SUBJECTS:
            raise UsageError(f"{section.path.name} has the subject {section.subject!r}; allowed: {list(SUBJECTS)}.")
    return sorted(sections, key=lambda section: (list(SUBJECTS).index(section.subject), section.title))


def page(sections: list[Section]) -> str:
    """Return the page: a heading a subject, a heading a section, and how each was measured."""
    parts = [HEAD]
    for subject, heading in SUBJECTS.items():
        parts.append(f"## {heading}\n")
        for section in (item for item in sections if item.subject == subject):
            made = f"`{section.command}` — " if section.command else ""
            where = section.where or "2 cores (AMD EPYC), 24 GiB, Python 3.11, torch 2.13 (CPU)"
            body = re.sub(r"^(#{2,4} )", r"#\1", section.body, flags=re.MULTILINE)
            parts.append(f"### {section.title}\n\n{made}{section.date}, {where}.\n\n{body}\n")
    return "\n".join(parts)


def write_page() -> None:
    """Write RESULTS.md from the sections."""
    write_text(PAGE, page(read_sections()))


def table(columns: list[str], rows: list[list[str]], *, right: Container[str] = ()) -> str:
    """Lay out a Markdown table; columns named in ``right`` are aligned to that side."""
    rule = "".join("---:|" if name in right else "---|" for name in columns)
    lines = ["| " + " | ".join(columns) + " |", "|" + rule]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


if __name__ == "__main__":
    write_page()
