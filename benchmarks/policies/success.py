"""Do students succeed more with networks that score higher against the default recordings?

    python -m benchmarks.policies.students --arms NETWORK … --iterations 110 --out STUDENTS
    python -m benchmarks.policies.success --students STUDENTS … --at-least 110 [--notes FILE] [--device NAME] [--write]

A student has a frozen network of the shipped board as its encoder (arms ``ead_*`` and the networks of
:mod:`benchmarks.policies.arms`). A point is a network: the mean over its students, and the score of the same
weights on the board, an untrained network's initial states of the same seeds. Whisker accuracy and read-outs are those
that :mod:`benchmarks.policies.alignment` measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks.policies.alignment import RECORD, board, partial_spearman
from benchmarks.policies.arms import NETWORKS, arm_of
from benchmarks.policies.comparison import found_logs, seen
from benchmarks.report import publish, script_parser, table
from brainbench.core.errors import UsageError
from brainbench.core.figures.style import COLORS, PALE, panels, save_figure
from brainbench.core.files import read_json
from brainbench.models.architecture import Architecture
from robotics_bridge.policies.report.results import StudentResult, read_results
from robotics_bridge.policies.training.distill_config import DistillConfig

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-score-success.png"
FROZEN = (*NETWORKS, "ead_simclr", "ead_supervised", "ead_untrained")
"""Arms whose encoder is a network of the board."""
FEWEST = 6
"""Networks below which a correlation says nothing."""
OUTCOMES = {"success": "success", "learning": "success in training", "goals": "quarter turns in 10 s"}
GIVEN = ("accuracy", "position", "contact")
"""What else may go with success: the whisker accuracy, and two read-outs of the object in the hand."""


def networks(results: Sequence[StudentResult], folders: list[Path]) -> list[dict[str, Any]]:
    """Return one row per network with students, highest score first; KeyError for one that is not on the board."""
    known = board()
    measured = {row["model"]: row for row in read_json(RECORD)}
    named = {arm: result for result in results if (arm := arm_of(result.config)) in FROZEN}
    logs = found_logs(folders, named)
    found = []
    for arm, result in named.items():
        least = min(learned or 0 for learned in result.learned)
        name = result.config.encoder
        moments = [seen(logs[arm, seed], least) for seed in result.seeds]
        rows = [known[f"{name} seed {weights_seed(config)}"] for config in result.configs]
        found.append(
            {
                "model": name, "students": len(result.seeds), "training": rows[0]["training"],
                "score": float(np.mean([row["score"] for row in rows])),
                "success": result.value, "goals": result.graded["goals"][0],
                "learning": float(np.mean(moments)),
                "spread": [float(np.std(of, ddof=1)) if len(of) > 1 else None for of in (result.success, moments)],
                **{key: measured[name][key] for key in GIVEN},
            }
        )  # fmt: skip
    return sorted(found, key=lambda row: -row["score"])


def weights_seed(config: DistillConfig) -> int:
    """Return the seed of a student's frozen weights as the board states it: 0 for weights with a tag.

    Raises:
        UsageError: the weights are of another training than the board's.
    """
    tactile = config.tactile
    assert tactile is not None
    if tactile.pretrained is not None:
        raise UsageError(
            f"The weights {tactile.pretrained!r} of {config.name!r} are not scored on the board; leave the folder of "
            "that student out."
        )
    return 0 if Architecture.parse(tactile.arm).tag else tactile.seed


def interval(value: float, count: int) -> tuple[float, float]:
    """Return the 95 % interval of Spearman's correlation of ``count`` points (Bonett & Wright 2000, equation 4)."""
    half = norm.ppf(0.975) * np.sqrt((1 + value**2 / 2) / (count - 3))
    return float(np.tanh(np.arctanh(value) - half)), float(np.tanh(np.arctanh(value) + half))


def correlations(found: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return a row for each set of networks and each quantity that may go with what students reach."""
    sets = {"all": found, "untrained": [row for row in found if row["training"] == "untrained"]}
    rows = []
    for name, some in sets.items():
        columns = {key: np.array([row[key] for row in some]) for key in ("score", *GIVEN, *OUTCOMES)}
        for key, given in (("score", None), ("score", "accuracy"), *((other, None) for other in GIVEN)):
            told = [name, str(len(some)), key, given or "–"]
            for outcome in OUTCOMES:
                value, p = partial_spearman(columns[key], columns[outcome], given and columns[given])
                low, high = interval(value, len(some) - (given is not None))
                told.append(f"{value:+.2f} [{low:+.2f}, {high:+.2f}] (p {p:.3f})")
            rows.append(told)
    return rows


def draw(found: Sequence[Mapping[str, Any]]) -> None:
    """Draw success in training over the board's score and over two read-outs, a network a point."""
    figure, axes = panels(1, 3, (12.0, 3.8), sharey=True)
    labels = {"score": "score on the board", "position": "position, read out (R²)", "contact": "contact, read out (R²)"}
    for panel, (key, label) in zip(axes[0], labels.items(), strict=True):
        for row in found:
            color = COLORS[0] if row["training"] != "untrained" else COLORS[1] if "+" in row["model"] else PALE
            panel.plot(row[key], row["learning"], "o", color=color, ms=5 + 2 * (row["students"] > 1))
        panel.set(xlabel=label)
    axes[0, 0].set(ylabel="success of students in training")
    save_figure(figure, PICTURE, dpi=120)


def main() -> None:
    parser = script_parser(__doc__, notes=True)
    parser.add_argument("--students", type=Path, nargs="+", required=True)
    parser.add_argument("--at-least", type=int, default=0, help="iterations; what learned fewer is left out")
    parser.add_argument("--device", default="", help="what trained the students")
    options = parser.parse_args()
    results = read_results(options.students, at_least=options.at_least)
    found = networks(results, options.students)
    keys = ("score", *GIVEN, *OUTCOMES)
    heads = ["score", "whisker accuracy", "position (R²)", "contact (R²)", *OUTCOMES.values()]
    rows = [[row["model"], str(row["students"]), *(f"{row[key]:.3f}" for key in keys)] for row in found]
    spreads = [
        f"{np.std([row[key] for row in found], ddof=1):.3f} and "
        f"{np.mean([row['spread'][of] for row in found if row['students'] > 1] or [np.nan]):.3f}"
        for of, key in enumerate(("success", "learning"))
    ]
    if len(found) < FEWEST:
        parser.error(f"there are students of {len(found)} networks of the board; a correlation takes {FEWEST}")
    parts = [
        f"{len(found)} frozen networks of the default board as encoders of students. Standard deviations of success "
        f"between networks, and between students of one: {spreads[0]} in evaluation, {spreads[1]} in the last episodes "
        "of training.",
        table(["network", "students", *heads], rows),
        "Spearman's correlations over networks with 95 % intervals (Bonett & Wright 2000), two-sided p of permuted "
        "networks; `given` is partialled out of the ranks:",
        table(["networks", "count", "quantity", "given", *OUTCOMES.values()], correlations(found)),
    ]
    if options.write:
        draw(found)
    words = f"--students STUDENTS … --at-least {options.at_least}"
    publish(options, "Scores of networks and students", "\n\n".join(parts), words, where=options.device)


if __name__ == "__main__":
    main()
