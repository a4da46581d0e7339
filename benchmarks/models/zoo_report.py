"""Tables and curves of what ``train_zoo.py`` brought back.

python -m benchmarks.models.zoo_report FOLDER [FOLDER …] [--write]
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from statistics import mean
from typing import Any

from benchmarks.report import table, write_section

ROOT = Path(__file__).resolve().parents[2]
PICTURE = ROOT / "docs" / "images" / "training-curves.png"


def read(folder: Path, name: str) -> list[dict[str, Any]]:
    """Read the lines of a file that came back."""
    path = folder / name if (folder / name).is_file() else folder / "unpacked" / name
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.is_file() else []


def read_results(folders: list[Path]) -> list[dict[str, Any]]:
    """Read all results; later folders replace jobs of earlier ones on the same data."""
    found = {(line["name"], line["data"]["hash"]): line for folder in folders for line in read(folder, "results.jsonl")}
    return list(found.values())


def read_curves(folders: list[Path]) -> list[dict[str, Any]]:
    """Read the curves of all jobs; of a job that was trained several times, the longest."""
    longest: dict[str, list[dict[str, Any]]] = {}
    for folder in folders:
        jobs: dict[str, dict[Any, dict[str, Any]]] = defaultdict(dict)
        for line in read(folder, "curves.jsonl"):
            jobs[line["job"]][line["epoch"], line["kind"]] = line
        for name, lines in jobs.items():
            if len(lines) >= len(longest.get(name, ())):
                longest[name] = list(lines.values())
    return [line for lines in longest.values() for line in lines]


def share(value: float) -> str:
    return f"{100 * value:.1f}"


def score_text(result: dict[str, Any] | None) -> str:
    found = (result or {}).get("score") or {}
    if found.get("value") is None:
        return "–"
    low, high = (found.get("interval") or {}).get("low"), (found.get("interval") or {}).get("high")
    between = f" [{low:.2f}, {high:.2f}]" if low is not None and high is not None else ""
    return f"{found['value']:.2f}{between}"


def accuracy_table(results: list[dict[str, Any]]) -> str:
    """One row per network and way of training, seeds together, beside its untrained twins."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = defaultdict(list)
    twins: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        job, data = result["job"], result["data"]["hash"]
        if job["objective"] == "untrained":
            twins[job["model"], data].append(result)
        else:
            groups[job["model"], job["objective"], job["augmentation"], job["masking"], data].append(result)
    rows = []
    for (model, objective, augmentation, masking, data), found in groups.items():
        found.sort(key=lambda result: result["job"]["seed"])
        architecture, _, shipped = model.partition(".")
        first, others = found[0], twins.get((architecture, data), [])
        low, high = (first["evaluation"]["interval"][end] for end in ("low", "high"))
        seeds = ", ".join(share(result["evaluation"]["top1"]) for result in found[1:])
        rows.append(
            [
                architecture,
                objective,
                "as shipped" if shipped else augmentation + (f" + {masking:.0%} masked" if masking else ""),
                data[:4],
                ", ".join(str(result["job"]["seed"]) for result in found),
                "–" if shipped else "/".join(str(result["epochs"]) for result in found),
                f"{share(first['evaluation']['top1'])} [{share(low)}, {share(high)}]",
                seeds or "–",
                share(mean(result["evaluation"]["top5"] for result in found)),
                " / ".join(share(result["evaluation"]["top1"]) for result in others) or "–",
                "yes" if any(result["evaluation"]["collapsed"] for result in found) else "no",
                score_text(first),
                score_text(next((item for item in others if item["job"]["seed"] == first["job"]["seed"]), None)),
            ]
        )
    head = ["network", "objective", "augmentation", "data", "seeds", "epochs (published: 100)", "top-1 % of the first"]
    head += ["of the others"]
    head += ["top-5 %", "untrained twins, probed, %", "collapsed", "score", "score of the twin"]
    return table(head, rows)


def data_text(results: list[dict[str, Any]]) -> str:
    """Return which data the networks were trained on."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for result in results:
        groups[result["data"]["hash"]].append(result)
    told = []
    for name, found in groups.items():
        data = found[0]["data"]
        told.append(
            f"Data {name}: {data['train']:,} sweeps to train, {data['validation']:,} to validate, {data['test']:,} of "
            f"other objects to test; {data['left_out']:,} unstable ones left out."
        )
    return " ".join(told)


def draw(curves: list[dict[str, Any]], path: Path) -> None:
    """Draw loss and validation of the networks of seed 0 with the usual augmentation."""
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), constrained_layout=True)
    series: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for line in curves:
        if line["kind"] == "epoch" and line["job"].endswith(("supervised.seed0", "simclr.seed0")):
            series[line["job"]].append(line)
    colors: dict[str, str] = {}
    for name, lines in sorted(series.items()):
        model, objective = name.rsplit(".", 2)[:2]
        axis = axes[int(objective == "simclr")]
        color = colors.setdefault(model, f"C{len(colors)}")
        lines.sort(key=lambda line: line["epoch"])
        value = (lambda line: 100 * (1 - line["validation"])) if axis is axes[0] else (lambda line: line["validation"])
        shown = [line for line in lines if line.get("validation") is not None]
        style = "-" if "small" in model else "--"
        axis.plot([line["epoch"] for line in shown], [value(line) for line in shown], style, color=color, label=model)
    axes[0].set(title="Supervised", ylabel="validation top-1 [%]", xlabel="epoch")
    axes[1].set(title="SimCLR", ylabel="validation loss", xlabel="epoch")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    handles = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, fontsize=7, frameon=False)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--write", action="store_true", help="write the section of RESULTS.md and the picture")
    parser.add_argument("--picture", type=Path, default=PICTURE)
    parser.add_argument("--note", default="", help="a sentence for the section: the machine, how long")
    args = parser.parse_args()
    results, curves = read_results(args.folders), read_curves(args.folders)
    classes = results[0]["data"]["classes"]
    text = (
        f"{classes} classes (chance {100 / classes:.1f} %). {data_text(results)} {args.note}\n\n"
        f"{accuracy_table(results)}\n\nSupervised "
        "networks answer by their own decoder, others and twins through a linear probe. Intervals: accuracy Wilson "
        "95 %, score over the animals of the (synthetic) demo recordings.\n\n"
    )
    speeds = [
        [
            result["name"],
            result["precision"],
            str(result["epochs"]),
            f"{result['training_seconds']:.0f}",
            f"{result['sweeps_per_second']:,.0f}",
        ]
        for result in results
        if result.get("training_seconds")
    ]
    text += "Several jobs shared a device, so rates add up:\n\n" + table(
        ["job", "precision", "epochs", "s", "sweeps/s"], speeds
    )
    print(text)
    if args.write:
        write_section("Trained models", "python -m benchmarks.models.train_zoo --out $OUT", text, subject="models")
        draw(curves, args.picture)


if __name__ == "__main__":
    main()
