"""Part two of "What reproduces": claims of chapter 4 judged on records of students, and figure 4.6.

python -m benchmarks.reproduction.touch --write     keeps the tables in RESULTS.md

The pages are written with the rest of "What reproduces", by ``python -m benchmarks.reproduction``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from statistics import fmean
from string import Template
from typing import Any

import numpy as np

from benchmarks.report import headline, publish, read_sections, script_parser, table
from benchmarks.reproduction.contrasts import Effect, Verdict, judge
from brainbench.core.files import read_json, write_text
from brainbench.core.records import Interval
from brainbench.core.statistics import LEVEL, is_finite
from leaderboards.figures.svg import Drawing, Scale, standalone, tick_text
from leaderboards.site.build import escape_markdown
from leaderboards.text import number, span

RECORDS = Path(__file__).parents[1] / "policies" / "records"
EQUAL, PUBLISHED = "students-placement-and-type.json", "students-published-encoders.json"
"""Students of equal size of all types; students with the published encoder of each type."""
LATER = "students-noise-resolution-law.json"
"""Students of equal size with noise, another resolution or the published law."""
SCREWDRIVER = "students-screwdriver.json"
"""Students of equal size that spin a screwdriver, with taxels on the fingers."""
LONG, TAUGHT = "students-four-times-as-long.json", "students-of-other-teachers.json"
"""Success in training of six arms that went on; students of equal size of two more teachers."""
SURE, EARLY = "new", "seen"
"""Groups of types: students trained after the claims were written, and before."""
KINDS = {
    "bool": "bits of contact", "agg_bool": "a bit per link", "agg_force": "a force per link",
    "depth": "depth", "force": "force", "force_torque": "force and torque", "elastomer": "gel markers",
    "proximity": "proximity", "center_of_pressure": "centres of pressure",
}  # fmt: skip
PLACES = {"hand": "whole hand", "tips": "finger tips", "fingers": "fingers"}
VARIANTS = {"noisy": "with noise", "low": "90 taxels", "high": "667 taxels", "law": "published law"}
TOUCH_PAGE, FIGURE = "which-touch.md", "images/what-reproduces/students.svg"
RULE = (
    "Differences of success; the intervals hold together for all claims and groups (Bonferroni). A claim holds where "
    'its interval lies above zero (above minus the amount where it says "no more than"), one of several pairs where '
    "all do (the nearest is shown). The verdict is that of students trained after the claims had been written; "
    "exploratory are those judged on others."
)
Arms = Mapping[str, Sequence[float]]


def arms_of(*records: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return success by arm, a value for each seed; the teacher has one."""
    arms: dict[str, list[float]] = {"teacher": [records[0]["teacher"]]}
    for row in (row for record in records for row in record["students"]):
        arms.setdefault(row["arm"], []).append(row["success"])
    return arms


def pairs_of(claim: Mapping[str, Any], types: Sequence[str], arms: Arms) -> list[list[str]]:
    """Return the pairs of a claim for the types of a group, those whose arms were trained."""
    chosen = [kind for kind in types if kind in claim.get("of", types)]
    filled = dict.fromkeys(
        tuple(name.format(kind) for name in pair) for pair in claim.get("pairs", ()) for kind in chosen
    )
    return [[*pair] for pair in filled if set(pair) <= arms.keys() and len(set(pair)) == len(pair)]


def difference(arms: Arms, pairs: Sequence[Sequence[str]], level: float) -> Effect:
    """Return the mean over pairs of the first arm less the mean of the rest, with its interval.

    A linear mixed model with one effect per arm and students as the random factor: their variance, episodes included,
    is pooled over all arms with several. The teacher is one, so that no interval covers others.
    """
    from scipy.special import stdtrit

    groups = [values for values in arms.values() if len(values) > 1]
    freedom = sum(len(values) - 1 for values in groups)
    within = sum(float(np.var(values)) * len(values) for values in groups) / freedom
    weights: dict[str, float] = {}
    for first, *rest in pairs:
        for name, weight in ((first, 1.0), *((name, -1 / len(rest)) for name in rest)):
            weights[name] = weights.get(name, 0.0) + weight / len(pairs)
    variance = within * sum(weight**2 / len(arms[name]) for name, weight in weights.items() if name != "teacher")
    value = sum(weight * fmean(arms[name]) for name, weight in weights.items())
    half = float(stdtrit(freedom, (1 + level) / 2)) * math.sqrt(variance)
    return Effect(value, Interval(value - half, value + half, level, "t over students"), len(pairs))


@dataclass(frozen=True)
class Judged:
    """A claim on the students of one group."""

    effect: Effect
    verdict: Verdict
    weakest: str = ""
    """Of a claim that every pair must hold: the pair that holds it least."""


def judge_claim(claim: Mapping[str, Any], types: Sequence[str], arms: Arms, level: float) -> Judged | None:
    """Return effect and verdict; None where no such arms were trained."""
    pairs = pairs_of(claim, types, arms)
    if not pairs:
        return None
    margin = claim.get("margin", 0.0)

    def verdict_of(effect: Effect) -> Verdict:
        bounds = effect.interval
        moved = bounds and replace(bounds, low=bounds.low + margin, high=bounds.high + margin)
        return judge(replace(effect, value=effect.value + margin, interval=moved), 1)

    if claim["rule"] == "mean":
        effect = difference(arms, pairs, level)
        return Judged(effect, verdict_of(effect))
    effects = {" less ".join(map(in_words, pair)): difference(arms, [pair], level) for pair in pairs}
    weakest = min(effects, key=lambda name: effects[name].value)
    verdicts: list[Verdict] = [verdict_of(effect) for effect in effects.values()]
    order = ["does not hold", "undecided", "holds"]
    verdict = min(verdicts, key=order.index)
    return Judged(effects[weakest], verdict, weakest)


def record_of(name: str) -> dict[str, Any]:
    """Return the students of a file of records."""
    record: dict[str, Any] = read_json(RECORDS / name)
    return record


def claim_rows() -> tuple[list[str], list[list[str]]]:
    """Return columns and rows of the claims: on types trained after they were written, before, with other encoders."""
    document = read_json(Path(__file__).with_name("touch.json"))
    groups, published = document["groups"], arms_of(record_of(PUBLISHED))
    equal = arms_of(record_of(EQUAL), record_of(LATER))
    everything, other_tasks = [*groups[SURE], *groups[EARLY]], {"screwdriver": arms_of(record_of(SCREWDRIVER))}

    def sets_of(claim: Mapping[str, Any]) -> tuple[tuple[Sequence[str], Arms], ...]:
        if "group" in claim:
            group = claim["group"]
            return ((groups[group], other_tasks.get(group, equal)), ((), equal), ((), published))
        return ((groups[SURE], equal), (groups[EARLY], equal), (everything, published))

    tested = sum(bool(pairs_of(claim, *kinds)) for claim in document["claims"] for kinds in sets_of(claim))
    level = 1 - 0.05 / tested
    rows = []
    for claim in document["claims"]:
        words = f"{claim['claim']} ({claim['source']})"
        if "section" in claim:
            ours, verdict = looked_up(claim)
            rows.append([words, ours, "–", "–", verdict])
            continue
        judged = [judge_claim(claim, *kinds, level) for kinds in sets_of(claim)]
        verdict = f"not tested, it would take: {claim['reason']}" if "reason" in claim else _verdict(judged)
        rows.append([words, *map(_words, judged), verdict])
    head = ["claim", "types trained after it was written", "types trained before", "published encoders", "verdict"]
    return head, rows


def looked_up(claim: Mapping[str, Any]) -> list[str]:
    """Return number and verdict of a claim whose number stands in a section of RESULTS.md."""
    section = next(section for section in read_sections() if section.title == claim["section"])
    words = headline(section, claim["figure"])
    value = float(words.replace(",", ""))
    met = claim.get("least", -math.inf) <= value <= claim.get("most", math.inf)
    verdict = claim.get("met", "reached") if met else claim.get("missed", "not reached")
    return [f'{words} (RESULTS, "{section.title}")', f"{verdict} ({claim['note']})"]


def _verdict(judged: Sequence[Judged | None]) -> str:
    """Return the verdict of the claim written first; else that of the students it was written after, marked."""
    sure, *rest = judged
    if sure is not None:
        return sure.verdict
    return next((f"{each.verdict} (exploratory)" for each in rest if each is not None), "not trained yet")


def _words(judged: Judged | None) -> str:
    if judged is None:
        return "–"
    weakest = f" ({judged.weakest})" if judged.weakest else ""
    return f"{number(judged.effect.value)} {span(judged.effect.interval)}{weakest}, {judged.verdict}"


def in_words(arm: str) -> str:
    """Return an arm as a reader would say it."""
    kind, *words = arm.split(" ")
    if kind not in KINDS:
        return {"none": "no touch", "none, memory": "no touch, with memory"}.get(arm, arm)
    return ", ".join([KINDS[kind], PLACES[words[0]], *(VARIANTS[word] for word in words[1:])])


def compared() -> dict[str, Any]:
    """Return the students of :data:`LATER` with those of equal size that they are compared with."""
    later, equal = record_of(LATER), record_of(EQUAL)
    plain = {row["arm"].rpartition(" ")[0] for row in later["students"]} | {"none, memory"}
    return {**later, "students": [*later["students"], *(row for row in equal["students"] if row["arm"] in plain)]}


def ranked(record: Mapping[str, Any]) -> dict[str, Effect]:
    """Return the success of every arm with its 95 % interval over students, the best first."""
    arms = arms_of(record)
    trained = [arm for arm in arms if arm != "teacher"]
    effects = {arm: difference(arms, [[arm]], LEVEL) for arm in trained}
    return dict(sorted(effects.items(), key=lambda entry: -entry[1].value))


def student_table(record: Mapping[str, Any]) -> str:
    """Return the table of students, the best arm first, with the share of the way from no touch to the teacher."""
    low, high = fmean(arms_of(record)["none, memory"]), record["teacher"]
    rows = []
    for arm, effect in ranked(record).items():
        of = sorted((row for row in record["students"] if row["arm"] == arm), key=lambda row: row["seed"])
        single, turns = (", ".join(f"{row[key]:.{n}f}" for row in of) for key, n in (("success", 3), ("turns", 1)))
        gain = "" if arm.startswith("none") else f"{(effect.value - low) / (high - low):.0%}"
        bounds = f" [{effect.interval.low:.2f}, {effect.interval.high:.2f}]" if is_finite(effect.interval) else ""
        rows.append([in_words(arm), str(len(of)), f"{effect.value:.2f}{bounds}", single, turns, gain])
    counted = record.get("counted", "quarter turns in 10 s")
    names = ["what it feels", "students", "success", "each", counted, "of the way to the teacher"]
    return table(names, rows)


def order_table(records: Sequence[Mapping[str, Any]]) -> str:
    """Return Kendall's τ of the order of arms by success in training: between seeds, and with the last iteration."""
    from scipy.stats import kendalltau

    rows = []
    for record in records:
        curves = {(row["arm"], row["seed"]): row["training"] for row in record["students"]}
        arms, steps = sorted({arm for arm, _ in curves}), list(record["students"][0]["training"])
        means = {step: [fmean(curves[key][step] for key in curves if key[0] == arm) for arm in arms] for step in steps}
        for step in steps:
            values = []
            for left, right in combinations(sorted({seed for _, seed in curves}), 2):
                shared = [arm for arm in arms if (arm, left) in curves and (arm, right) in curves]
                if len(shared) > 2:
                    sides = [[curves[arm, seed][step] for arm in shared] for seed in (left, right)]
                    values.append(float(np.array(kendalltau(*sides))[0]))
            last = float(np.array(kendalltau(means[step], means[steps[-1]]))[0])
            rows.append([record["name"], step, f"{fmean(values):.2f}" if values else "–", f"{last:.2f}"])
    return table(["students", "iterations", "τ of two seeds (mean)", "τ with the last"], rows)


def teacher_table(record: Mapping[str, Any]) -> str:
    """Return success of the arms whose students had several teachers, those of the first one as a mean."""
    first, rows = arms_of(record_of(EQUAL)), []
    for arm in dict.fromkeys(row["arm"] for row in record["students"]):
        others = [f"{row['success']:.3f}" for row in record["students"] if row["arm"] == arm]
        rows.append([in_words(arm), f"{fmean(first[arm]):.3f} ({len(first[arm])})", *others])
    own = ["success of the teacher", *(f"{success:.3f}" for success in record["teachers"].values())]
    return table(["students", *record["teachers"]], [*rows, own])


def figure(records: Sequence[Mapping[str, Any]]) -> Drawing:
    """Draw the success of every student by arm, with the mean of the arm, its interval and the teacher (figure 4.6)."""
    groups = [(record, ranked(record)) for record in records]
    drawing = Drawing(760, 30 + sum(17 * len(arms) + 52 for _, arms in groups), "Success of students by what they feel")
    axis, y = Scale(0, 1, 270, 740), 24.0
    for record, arms in groups:
        drawing.text(10, y, f"{record['name'].capitalize()} (dots: students; diamonds: means; bars: 95 %)", "title")
        top, bottom = y + 8, y + 17 * len(arms) + 8
        for tick in axis.ticks:
            drawing.line(axis.at(tick), top, axis.at(tick), bottom, "grid")
            drawing.text(axis.at(tick), bottom + 13, tick_text(tick), "mid small quiet")
        drawing.line(axis.at(record["teacher"]), top, axis.at(record["teacher"]), bottom, "one")
        for arm, effect in arms.items():
            y += 17
            colour = "c0" if arm.startswith("none") else "c1" if "whole hand" in in_words(arm) else "c2"
            drawing.text(260, y + 4, in_words(arm), "end small")
            if is_finite(effect.interval):
                drawing.line(axis.at(effect.interval.low), y, axis.at(effect.interval.high), y, f"{colour} span")
            for row in record["students"]:
                if row["arm"] == arm:
                    drawing.mark(axis.at(row["success"]), y, "dot", f"{colour} faint", f"{row['success']:.3f}", 3.5)
            drawing.mark(axis.at(effect.value), y, "diamond", colour, f"{in_words(arm)}: {effect.value:.3f}", 3.5)
        y += 52
    return drawing


def part_two() -> str:
    """Return the second part of the page "What reproduces"."""
    head, rows = claim_rows()
    return table(head, [[escape_markdown(cell) for cell in row] for row in rows])


def stimuli_table() -> str:
    """Return the claims on stimuli that two commands answer, figure 3.1 b and table 3.6."""
    claims = read_json(Path(__file__).with_name("touch.json"))["stimuli"]
    rows = [[f"{claim['claim']} ({claim['source']})", *looked_up(claim)] for claim in claims]
    return table(["claim", "ours", "verdict"], [[escape_markdown(cell) for cell in row] for row in rows])


def write_pages(out: Path, decorate: Callable[[Drawing], str] = standalone) -> list[Path]:
    """Write the page "Which touch should my hand have?" and figure 4.6 into a folder; return the files."""
    records = [record_of(EQUAL), compared(), record_of(SCREWDRIVER), record_of(PUBLISHED)]
    template = Template(Path(__file__).with_name("which-touch.md").read_text(encoding="utf-8"))
    tables = dict(zip(("students", "later", "screwdriver", "published"), map(student_table, records), strict=True))
    text = template.substitute(**tables, teachers=teacher_table(record_of(TAUGHT)))
    return [write_text(out / TOUCH_PAGE, text), write_text(out / FIGURE, decorate(figure(records)))]


def main() -> None:
    options = script_parser(__doc__).parse_args()
    records, more = [record_of(EQUAL), record_of(PUBLISHED), record_of(SCREWDRIVER)], compared()
    head, rows = claim_rows()
    parts = [
        f"{start}: `{record['command']}`, {record['where']}; {record['notes']}\n\n{student_table(record)}"
        for start, record in (
            ("Students", records[0]),
            ("Noise, resolution and law", more),
            ("Screwdriver", records[2]),
        )
    ]
    taught = record_of(TAUGHT)
    parts.append(f"Teachers: `{taught['command']}`; {taught['notes']}\n\n{teacher_table(taught)}")
    orders = f"Order of the arms by success in training:\n\n{order_table([*records, record_of(LONG)])}"
    body = "\n\n".join([*parts, table(head, rows), RULE, orders])
    publish(options, "Students by what they feel", body, subject="policies", where="records, no simulation")


if __name__ == "__main__":
    main()
