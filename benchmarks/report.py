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
SUBJECTS = ("commands", "whiskers", "models", "scores", "leaderboards", "tactile", "policies")
QUESTIONS = (
    ("How exact is a simulated whisker?", "whiskers", "accura|agree|bases|bullet|chosen|finer|friction|nothing in rod"
     "|plane|presets|random scenes|tolerance|trust|twist|their estimates|Contact forces solved"),
    ("What can be fitted to a real whisker?", "whiskers", "Fitted|Contact forces from|Gradients|Motions|Ring-downs"),
    ("How fast are whiskers simulated?", "whiskers", ""),
    ("What do networks cost, and how were the shipped ones trained?", "models", ""),
    ("Could an experiment tell networks apart?", "scores", "Recovery|demo-rodgers|default recordings"),
    ("Can a score be trusted?", "scores", ""),
    ("How exact is simulated touch?", "tactile", "closed forms|extremes|GelSight|Genesis 1|adds up"
     "|faults|hot_ball|Hand and|noise"),
    ("How fast is simulated touch?", "tactile", ""),
    ("What does touch bring to a policy?", "policies", ""),
    ("How quick, small and robust are the commands?", "commands|leaderboards", ""),
)  # fmt: skip
"""Question of a reader, subjects and words of the titles that answer it; a section stands under the first that fits."""
HEADLINES = (
    ("true error of whiskers with an object on one side at `balanced`, median",
     "Errors of whiskers and their estimates: seed 22",
     r"\| balanced \| one-side \|[^|]*\| ([^|]*) \|", " %"),
    ("whiskers between objects, slipping off or let go whose estimated error is no smaller than the true one",
     "Errors of whiskers and their estimates: seed 22",
     r"\| balanced \| hard \|[^|]*\|[^|]*\|[^|]*\|[^|]*\| ([^|]*) \|", ""),
    ("processor time of a simulated second of one whisker at `balanced`", "Settings chosen for an error",
     r"\| 10% \|[^|]*\|[^|]*\|[^|]*\| ([^|]*) \|", " s"),
    ("error of Young's modulus fitted to base forces with 1 % noise, median",
     "Fitted whiskers: truth, coverage and wrong models", r"\| young_modulus \| ([^|]*) \|", " %"),
    ("95 % intervals of it that hold the truth, with Wilson interval",
     "Fitted whiskers: truth, coverage and wrong models", r"\| young_modulus \|[^|]*\|[^|]*\|[^|]*\| ([^|]*) \|", " %"),
    ("error of a contact force from a traced shape, contact point known: median / 90 %", "Contact forces from shapes",
     r"\| contact point known \| all \|[^|]*\| ([^|]*) \|", " %"),
    ("sweeps past objects on one GPU, by the public command", "Sweeps on a GPU, by the public command",
     r"\| procedural-24:32 \|[^|]*\|[^|]*\| ([^|]*) \|", " a second"),
    ("steps of free whiskers of ten links on one GPU", "The rod backend on a GPU",
     r"([\d.e]+) whisker-steps/s at 10 links", " a second"),
    ("difference of the published networks from the authors' outputs", "Published networks beside the authors' outputs",
     r"logits, encoder \| ([^|,]*),", " of the largest"),
    ("training of zhuang-intersection-ln+gpt on one GPU",
     "Training step (zhuang-intersection-ln+gpt, NVIDIA H200)",
     r"\| ours \| bf16 \| captured \|[^|]*\|[^|]*\| ([^|]*) \|", " sweeps a second"),
    ("boards on which the true network comes first", "Recovery: the shipped networks",
     r"comes first in (.*?) by chance|comes first in (.*?);", ""),
    ("false positives of RSA at p ≤ .05", "Calibration: nulls", r"\| rsa \|[^|]*\| ([^|]*) \|", ""),
    ("95 % intervals of RSA that hold the truth (20 stimuli, 11 animals, half of the signal)", "Calibration: coverage",
     r"\| 20 \| 11 \| 0.5 \|[^|]*\|[^|]*\|[^|]*\| ([^|]*) \|", ""),
    ("difference of crossnobis distances from rsatoolbox", "Metrics: parity with rsatoolbox",
     r"\| RDM, crossnobis \| ([^|]*) \|", ""),
    ("sum of taxels less sum of contact forces, worst of 200 scenes", "Touch: what adds up",
     r"normal, law \|[^|]*\|[^|]*\| ([^|]*) \|", ""),
    ("environments × steps with 100 kinematic taxels on one GPU, 4,096 at once",
     "Tactile whole step on the pyramid (NVIDIA H200)", r"\| 4,096 \| kinematic \| ([^|]*) \|", " a second"),
    ("success of the teacher of `in_palm_rotate`", "Teacher of in_palm_rotate",
     r"\(in_palm_rotate.teacher\) \|[^|]*\| ([^|]*) \|", ""),
    ("success of the shipped student, deployed", "Evaluation and deployment of a student",
     r"\| deployed \|[^|]*\| ([^|]*) \|", ""),
    ("control tick of a deployed policy with a small encoder, median", "Control tick of a deployed policy",
     r"\| zhuang-intersection-ln-small \| no \|[^|]*\|[^|]*\|[^|]*\| ([^|]*) \|", " ms"),
    ("files that differ after commands were killed and given again (of 118 kills)", "Kills",
     r"\| all \|[^|]*\|[^|]*\|[^|]*\|[^|]*\| ([^|]*) \|", ""),
)  # fmt: skip
"""What is measured, title of its section, where the figure stands in the body, and its unit."""
EARLIER = "f0af6943"
"""Commit that holds the scripts whose results stand here and that no release repeats."""
CHANGED, BEFORE = "2026-11-30", "0266d1cf"
PARTS = r"training_step --part (forward|stream|length)|metrics --device|--part published|tasks --part|encoder_step"
"""Commands of scripts that do something else since that day, and the commit that holds them as they were."""
HEAD = (
    "# Measured results\n\n"
    "Every figure stands with the command that made it, the date and the machine. This page is written by "
    "`python -m benchmarks.report` from `benchmarks/results/*.json`; commands run in the repository's root. "
    f"Studies that are not repeated have left the tree: where commit {EARLIER} is named, the script is found there.\n"
)


@dataclass(frozen=True)
class Section:
    """One measured result."""

    title: str
    subject: str
    """One of :data:`SUBJECTS`: the folder of the script, as a rule."""
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


def script_parser(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help is a script's docstring, with ``--write``."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="keep the section and write RESULTS.md anew")
    return parser


def publish(
    options: argparse.Namespace, title: str, body: str, words: str = "", *, subject: str = "", where: str = ""
) -> None:
    """Print the body of a section, and keep it with ``--write``.

    Args:
        options: what a parser of :func:`script_parser` understood.
        title: heading, which names the section.
        body: Markdown without a heading.
        words: options of the command that made it, other than ``--write``; the script is the one that runs.
        subject: one of :data:`SUBJECTS`; that of the script's folder if empty.
        where: what measured it, if not this machine.
    """
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
    """Return all sections, by title."""
    sections = [Section(**read_json(path)) for path in sorted(FOLDER.glob("*.json"))]
    for section in sections:
        if section.subject not in SUBJECTS:
            raise UsageError(f"{section.path.name} has the subject {section.subject!r}; allowed: {list(SUBJECTS)}.")
    return sorted(sections, key=lambda section: section.title)


def question(section: Section) -> str:
    """Return the question under which a section stands."""
    return next(
        heading
        for heading, subjects, words in QUESTIONS
        if section.subject in subjects.split("|") and re.search(words, section.title)
    )


def headline(section: Section, pattern: str) -> str:
    """Return the figure that a pattern finds in the body of a section.

    Raises:
        UsageError: the body has no such place; the table of headline figures would go on with a stale one.
    """
    match = re.search(pattern, section.body)
    if match is None:
        raise UsageError(f"The section {section.title!r} has no place that fits {pattern!r}; mend HEADLINES.")
    return next(text for text in match.groups() if text is not None).strip(" ;:")


def anchor(title: str) -> str:
    """Return the anchor of a heading, as GitHub and MkDocs make it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-")


def page(sections: list[Section]) -> str:
    """Return the page: the headline figures, then a heading a question and a heading a section."""
    by_title = {section.title: section for section in sections}
    rows = [
        [words, f"**{headline(by_title[title], pattern)}{unit}**", f"[{title}](#{anchor(title)})", by_title[title].date]
        for words, title, pattern, unit in HEADLINES
    ]
    parts = [HEAD, "## Twenty figures\n", table(["what", "measured", "section", "date"], rows) + "\n"]
    for heading, *_ in QUESTIONS:
        parts.append(f"## {heading}\n")
        for section in (section for section in sections if question(section) == heading):
            command = f"`{section.command}` — " if section.command else ""
            where = section.where or "2 cores (AMD EPYC), 24 GiB, Python 3.11, torch 2.13 (CPU)"
            body = re.sub(r"^(#{2,4} )", r"#\1", section.body, flags=re.MULTILINE)
            gone = removed_scripts(f"{section.command}\n{body}")
            note = f" Not in the tree any more, but in commit {EARLIER}: {', '.join(gone)}." if gone else ""
            if section.date < CHANGED and re.search(PARTS, section.command):
                note += f" The script as it was then: commit {BEFORE}."
            parts.append(f"### {section.title}\n\n{command}{section.date}, {where}.{note}\n\n{body}\n")
    return "\n".join(parts)


def removed_scripts(text: str) -> list[str]:
    """Return the scripts and files of ``benchmarks`` that a text names and that are not in the tree."""
    modules = re.findall(r"benchmarks\.(\w+)\.(\w+)", text)
    paths = {f"{folder}/{module}.py" for folder, module in modules}
    paths |= set(re.findall(r"benchmarks/((?:\w+/)*[\w-]+\.(?:py|sh|toml))\b", text))
    paths |= {f"policies/{name}" for name in re.findall(r"(?:policies/)?(records/[\w.-]+\.tar\.xz)", text)}
    paths |= {"policies/trainings"} if "policies/trainings" in text else set()
    return sorted(f"`benchmarks/{path}`" for path in paths if not (FOLDER.parent / path).exists())


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
