"""Table and curves of the campaign, from its lists in the repository.

python -m benchmarks.models.campaign_report --note "one sentence on machine and time"
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from benchmarks.models.campaign import CURVES, DONE, ROOT
from benchmarks.models.campaign_jobs import campaign
from benchmarks.report import table, write_section
from brainbench.core.figures.style import COLORS, panels, save_figure

PICTURE = ROOT / "docs" / "images" / "training-curves.png"
PATTERNS = {"": "solid", "gpt": (0, (6, 2)), "mamba": (0, (1, 1.4))}
"""Line pattern of each attender."""
OBJECTIVES = {"supervised": "labels", "simclr": "SimCLR", "ae": "autoencoder", "simsiam": "SimSiam"}
"""Objective → what lines are labelled with, in the order of their colours."""


def read(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a list."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def percent(found: dict[str, Any] | None) -> str:
    """Return an accuracy in per cent, with its interval."""
    if found is None:
        return "–"
    return f"{100 * found['top1']:.1f} [{100 * found['interval']['low']:.1f}, {100 * found['interval']['high']:.1f}]"


def results_table(lines: list[dict[str, Any]]) -> str:
    """Return one row for each training, the first seeds first."""
    head = ["network", "seed", "learning rate", "tried: validation %", "top-1 %", "top-5 %", "twin, probed, %"]
    head += ["collapsed", "training s", "sweeps/s"]
    rows = []
    for line in lines:
        if line["objective"] in ("untrained", "baseline"):
            continue
        found = line["evaluation"]
        tried = [f"{float(rate):g}: {100 * value:.1f}" for rate, value in (line["search"] or {}).items()]
        rows.append(
            [
                line["name"].rpartition(".")[0],
                str(line["seed"]),
                f"{line['learning_rate']:g}",
                ", ".join(tried) or "as seed 0",
                percent(found),
                f"{100 * found['top5']:.1f}",
                percent(line.get("twin_evaluation")),
                "yes" if found["collapsed"] else "no",
                f"{line['training_seconds']:.0f}",
                f"{line['sweeps_per_second']:,.0f}",
            ]
        )
    return table(head, rows)


def draw(curves: list[dict[str, Any]], path: Path) -> None:
    """Draw the validation accuracy of the networks of seed 0 over their epochs, one panel for each encoder.

    Variants of an objective (augmentation, masking) stand in the table alone.
    """
    series: dict[str, dict[str, list[tuple[int, float]]]] = defaultdict(lambda: defaultdict(list))
    for line in curves:
        if line["job"].endswith(".seed0") and line.get("validation") is not None:
            model, _, objective = line["job"].removesuffix(".seed0").partition(".")
            encoder, _, attender = model.partition("+")
            if objective not in OBJECTIVES:
                continue
            series[encoder][f"{objective}+{attender}"].append((line["epoch"], 100 * line["validation"]))
    columns = 4
    figure, axes = panels(-(-len(series) // columns), columns, (14, 8.4), sharex=True, sharey=True)
    for axis, (encoder, lines) in zip(axes.flat, sorted(series.items()), strict=False):
        ends = []
        for name, points in lines.items():
            objective, _, attender = name.partition("+")
            color = COLORS[list(OBJECTIVES).index(objective)]
            axis.plot(*zip(*points, strict=True), color=color, linestyle=PATTERNS[attender])
            ends.append((*points[-1], OBJECTIVES[objective] + f" +{attender}" * bool(attender), color))
        lowest = 0.0
        for epoch, accuracy, label, color in sorted(ends, key=lambda end: end[1]):
            # Labels of lines that end close together are moved apart, upwards.
            lowest = max(lowest, accuracy)
            axis.annotate(label, (epoch + 0.6, lowest), color=color, fontsize=8, va="center", annotation_clip=False)
            lowest += 7
        axis.set(title=encoder, ylim=(0, 100), xlim=(0, 44), xticks=range(0, 31, 10))
    for axis in list(axes.flat)[len(series) :]:
        axis.set_axis_off()
    figure.supxlabel("epoch", fontsize=9.5)
    figure.supylabel("validation accuracy (%)", fontsize=9.5)
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--note", default="", help="a sentence for the section: the machine, how long")
    args = parser.parse_args()
    lines = read(DONE)
    known = {line["name"]: line for line in lines}
    jobs = [job for job in campaign() if job.trained]
    data = lines[-1]["data"]
    text = (
        f"Data {data['hash']}: {data['train']:,} sweeps of {data['classes']} families to train (chance "
        f"{100 / data['classes']:.1f} %), {data['validation']:,} to validate, {data['test']:,} of other objects to "
        f"test, {data['left_out']:,} left out as unstable. {args.note} Done: {sum(job.name in known for job in jobs)} "
        f"of {len(jobs)} trainings. A linear probe reads {percent(known['raw-input']['evaluation'])} % from the raw "
        f"input and {percent(known['random-features']['evaluation'])} % from 96 random features of it.\n\n"
        f"{results_table(lines)}\n\nEvery network has the same epochs, batches of 1,024 and AdamW with a cosine; the "
        "learning rate is the best of three after two epochs. Networks with labels answer by their own decoder, others "
        "and untrained twins through a linear probe. Several jobs shared a device, so rates add up. Intervals: Wilson "
        "95 % over sweeps."
    )
    write_section("Trained models", "python -m benchmarks.models.campaign", text, subject="models")
    draw(read(CURVES), PICTURE)


if __name__ == "__main__":
    main()
