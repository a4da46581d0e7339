"""Lay out the read-outs of tactile encoders that ``brainbench policy probe --out FILE`` measured.

    brainbench policy probe in_palm_rotate --agent in_palm_rotate.teacher --config careful --seconds 8 --out FILE
    brainbench policy probe … --place 50 --out FILE
    python -m benchmarks.policies.readouts --record FILE [FILE …] [--device "one NVIDIA H100"] [--notes FILE] [--write]

Prints the tables; with ``--write`` keeps them as a section of RESULTS.md, draws ``docs/images/policy-readouts.png`` or
``policy-placement.png``, and keeps the record in ``benchmarks/policies/records``. Files are of one kind.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.report import table, with_notes, write_section
from brainbench.core.figures.style import COLORS, PALE, panels, save_figure
from brainbench.core.files import read_json, write_json
from robotics_bridge.policies.readouts.arms import NETWORK
from robotics_bridge.policies.readouts.rollout import TARGETS

_ROOT = Path(__file__).resolve().parents[2]
IMAGES = _ROOT / "docs" / "images"
RECORDS = Path(__file__).with_name("records")


def body(record: Mapping[str, Any]) -> str:
    """Return both tables."""
    size = "taxels" if "place" in record else "features"
    arms = [
        [label(one["arm"]), str(one[size]), str(one["draws"]), *(_cell(one[name], "") for name in TARGETS)]
        for one in record["arms"]
    ]
    pairs = [
        [label(one["arm"]), one["less"], *(_cell(one[name], "+") for name in TARGETS)] for one in record["differences"]
    ]
    extent = f"{record['environments']} environments of {record['task']} for {record['seconds']:g} s"
    head = f"**{extent} under `{record['agent']}`, {record['contacts']} contacts**"
    return "\n\n".join([head, table(["arm", size, "draws", *TARGETS], arms), table(["arm", "less", *TARGETS], pairs)])


def label(arm: str) -> str:
    """Return the name of an arm for a table; of a network in a folder RUN/best, that of RUN."""
    return Path(arm).parent.name.removeprefix(f"{NETWORK}.") if ":" in arm else arm


def _cell(one: Mapping[str, float], sign: str) -> str:
    return f"{one['r2']:{sign}.3f} [{one['low']:{sign}.3f}, {one['high']:{sign}.3f}]"


def draw(record: Mapping[str, Any]) -> None:
    """Draw R² with its interval, a panel for each quantity, an arm a row."""
    arms = record["arms"][::-1]
    figure, axes = panels(1, len(TARGETS), (11.0, 4.6), sharey=True)
    for panel, name in zip(axes[0], TARGETS, strict=True):
        for height, one in enumerate(arms):
            value = one[name]
            random = one["arm"].startswith(("reservoir", "untrained", "random"))
            trained = label(one["arm"]).startswith(("simclr", "supervised", "chosen"))
            color = COLORS[0] if trained else COLORS[1] if random else PALE
            error = [[max(value["r2"] - value["low"], 0)], [max(value["high"] - value["r2"], 0)]]
            panel.errorbar(value["r2"], height, xerr=error, fmt="o", markersize=4, color=color, capsize=2)
        panel.axvline(0, color=PALE, linewidth=0.8)
        panel.set(title=name, xlabel="R² on environments left out")
    axes[0, 0].set_yticks(range(len(arms)), [label(one["arm"]) for one in arms])
    save_figure(figure, IMAGES / f"policy-{kind(record)}.png", dpi=120)


def kind(record: Mapping[str, Any]) -> str:
    """Return what a record is of."""
    return "placement" if "place" in record else "readouts"


def command(record: Mapping[str, Any]) -> str:
    """Return the command that measured a record."""
    words = [record["task"], "--agent", record["agent"], "--config", record["config"]]
    words += [word for change in record["change"] for word in ("--change", change)]
    words += ["--envs", str(record["environments"]), "--seconds", f"{record['seconds']:g}"]
    words += ["--place", str(record["place"])] if "place" in record else []
    words += [word for one in record["arms"] if ":" in one["arm"] for word in ("--network", one["arm"])]
    return f"brainbench policy probe {' '.join(words)} --out FILE"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--record", type=Path, nargs="+", required=True, help="the first one is drawn")
    parser.add_argument("--device", default="", help="what measured it, if not this machine")
    parser.add_argument("--notes", type=Path, help="text that follows the tables")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    records = [read_json(path) for path in options.record]
    text = "\n\n".join(body(record) for record in records)
    text = with_notes(text, options.notes)
    print(text)
    if options.write:
        draw(records[0])
        for record in records:
            write_json(RECORDS / f"{kind(record)}-{record['task']}-{record['contacts']}.json", record)
        commands = [*map(command, records), "python -m benchmarks.policies.readouts --record FILE … --write"]
        title = "Placement of few taxels" if kind(records[0]) == "placement" else "Read-outs of tactile encoders"
        write_section(title, "; ".join(commands), text, where=options.device, subject="policies")


if __name__ == "__main__":
    main()
