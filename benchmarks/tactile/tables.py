"""Tables and the figure of scaling, from the records that benchmarks/tactile/throughput.py keeps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.report import table
from brainbench.core.figures import COLORS, PALE, panels, save_figure

Rows = Sequence[dict[str, Any]]
AXES = ("taxels", "environments", "triangles (raycast)", "triangles (sdf)", "points (proximity)", "points (elastomer)")


def tables(rows: Rows) -> dict[str, tuple[str, str]]:
    """Lay out the records of one device: part → (heading, body)."""
    device = rows[0]["device"] if rows else ""
    found = {}
    for part in ("sensors", *_LISTS):
        # The last measurement of a case counts.
        kept = {(row["case"], row.get("envs"), row.get("value")): row for row in rows if row["part"] == part}
        if kept:
            heading, body = (_sensors if part == "sensors" else _listed)(list(kept.values()))
            found[part] = (f"{heading} ({device})", body)
    return found


def _listed(rows: Rows) -> tuple[str, str]:
    heading, note, columns = _LISTS[rows[0]["part"]]
    cells = [[form.format(**row) for form in columns.values()] for row in rows]
    return heading, note.format(**rows[0]) + table(list(columns), cells)


def _sensors(rows: Rows) -> tuple[str, str]:
    cells = []
    for row in rows:
        ratios = ("–" if row.get(key) is None else f"{row[key]:.2f}" for key in ("roofline_ratio", "moved_ratio"))
        cells.append([
            row["case"], f"{row['ms']:.3f}", f"{row['ns']:.3g}", *ratios,
            f"{row['bytes']:.0f}", f"{row['first_s']:.2f}",
        ])  # fmt: skip
    columns = ["sensor", "ms / update", "ns / number", "time / roofline", "time / own bytes"]
    columns += ["bytes / taxel", "first (s)"]
    note = "A taxel of temperature is a cell, of audio a sample. The first update loads or compiles the kernels."
    if any(row.get("roofline_ratio") is not None for row in rows):
        note += (
            " Roofline: .018 ms clean and .085 ms with noise per 100 taxels and 16,384 environments on an H200;"
            " the goals 1.5 (primitive) and 2.5 (mesh 5k) are multiples of it. Own bytes: the 24 (noisy: 144) bytes of"
            " a taxel that any such update moves, at the bandwidth of the memory."
        )
    return f"Tactile sensors alone, {rows[0]['envs']:,} environments", f"{note}\n\n{table(columns, cells)}"


_LISTS: dict[str, tuple[str, str, dict[str, str]]] = {
    "check": (
        "Tactile readings against the processor's", "Relative to the largest reading.\n\n",
        {"sensor": "{case}", "99.9 % of readings agree within": "{relative:.1e}", "all agree within": "{largest:.1e}"},
    ),
    "totals": (
        "Engine totals beside the law of depths", "Microseconds of one update of {envs:,} environments.\n\n",
        {"scene": "{case}", "law of depths": "{law:,.0f}", "engine totals": "{engine:,.0f}", "× law": "{ratio:.2f}"},
    ),
    "step": (
        "Tactile whole step on the pyramid", "",
        {"environments": "{envs:,}", "sensor (100 taxels)": "{case}", "env-steps/s": "{env_steps_per_s:,.0f}",
         "of the engine alone": "{share:.0%}"},
    ),
    "scaling": (
        "Tactile scaling", "",
        {"axis": "{case}", "value": "{value:,}", "environments": "{envs:,}", "ms / update": "{ms:.3f}"},
    ),
}  # fmt: skip
"""Part → heading, what stands before the table, and the form of each column."""


def plot_scaling(rows: Rows, path: Path) -> None:
    """Draw time against taxels, environments, triangles and points; dotted lines are proportional to what grows."""
    kinds = {
        "raycast": "each triangle",
        "sdf": "distance field",
        "proximity": "proximity taxels",
        "elastomer": "elastomer",
    }
    groups = {"taxels": AXES[:1], "environments": AXES[1:2], "triangles": AXES[2:4], "points": AXES[4:]}
    figure, axes = panels(1, 4, (12, 3.4))
    devices = list(dict.fromkeys(row["device"] for row in rows))
    for (title, cases), one in zip(groups.items(), axes[0], strict=True):
        whole = title == "environments"
        for device, marker in zip(devices, "os^", strict=False):
            for case, colour in zip(cases, COLORS, strict=False):
                kept = {row["value"]: row for row in rows if row["case"] == case and row["device"] == device}
                if not kept:
                    continue
                x = sorted(kept)
                y = [kept[value]["ms"] if whole else 1e3 * kept[value]["ms"] / kept[value]["envs"] for value in x]
                kind = case.partition("(")[2].rstrip(")")
                name = kinds.get(kind, kind)
                label = ", ".join(part for part in (name, device if len(devices) > 1 else "") if part)
                one.loglog(x, y, marker + "-", color=colour, markersize=4, linewidth=1.2, label=label or None)
                if title in ("taxels", "environments"):
                    ends = [x[0], x[-1]]
                    one.loglog(ends, [y[-1] * end / x[-1] for end in ends], ":", color=PALE, linewidth=1)
        one.set_xlabel(f"number of {title}" if title != "points" else "number of surface points")
        one.set_ylabel("time per update (ms)" if whole else "time per update and environment (µs)")
        low, high = one.get_ylim()
        one.set_ylim(10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(high)))
        if one.get_legend_handles_labels()[0]:
            one.legend(fontsize=8.5, frameon=False)
    save_figure(figure, path, dpi=120)
