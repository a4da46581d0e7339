"""Tables and the figure of scaling, from the records that benchmarks/tactile/throughput.py keeps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.report import table

Rows = Sequence[dict[str, Any]]
AXES = ("taxels", "environments", "triangles (raycast)", "triangles (sdf)", "points (proximity)", "points (elastomer)")


def tables(rows: Rows) -> dict[str, tuple[str, str]]:
    """Lay out the records of one device: part → (heading, body)."""
    device = rows[0]["device"] if rows else ""
    found = {}
    for part, lay_out in _LAYOUTS.items():
        # The last measurement of a case counts.
        kept = {(row["case"], row.get("envs"), row.get("value")): row for row in rows if row["part"] == part}
        if kept:
            heading, body = lay_out(list(kept.values()))
            found[part] = (f"{heading} ({device})", body)
    return found


def _check(rows: Rows) -> tuple[str, str]:
    cells = [[row["case"], f"{row['relative']:.1e}", f"{row['largest']:.1e}"] for row in rows]
    body = table(["sensor", "99.9 % of readings agree within", "all agree within"], cells)
    return "Tactile readings against the processor's", f"Relative to the largest reading.\n\n{body}"


def _sensors(rows: Rows) -> tuple[str, str]:
    cells = []
    for row in rows:
        ratios = ("–" if row.get(key) is None else f"{row[key]:.2f}" for key in ("roofline_ratio", "moved_ratio"))
        cells.append([
            row["case"], f"{row['ms']:.3f}", f"{row['ns']:.3g}", *ratios,
            f"{row['bytes']:.0f}", f"{row.get('scratch', 0):.0f}", f"{row['first_s']:.2f}",
        ])  # fmt: skip
    columns = ["sensor", "ms / update", "ns / number", "time / roofline", "time / own bytes"]
    columns += ["bytes / taxel", "scratch", "first (s)"]
    note = (
        "A taxel of temperature is a cell, of audio a sample. Scratch (bytes / taxel) is written anew by every update; "
    )
    note += "the first update loads or compiles the kernels."
    if any(row.get("roofline_ratio") is not None for row in rows):
        note += (
            " Roofline: .018 ms clean and .085 ms with noise per 100 taxels and 16,384 environments on an H200;"
            " the goals 1.5 (primitive) and 3 (mesh 5k) are multiples of it. Own bytes: the 24 (noisy: 144) bytes of a"
            " taxel that any such update moves, at the bandwidth of the memory."
        )
    return f"Tactile sensors alone, {rows[0]['envs']:,} environments", f"{note}\n\n{table(columns, cells)}"


def _step(rows: Rows) -> tuple[str, str]:
    cells = [[f"{r['envs']:,}", r["case"], f"{r['env_steps_per_s']:,.0f}", f"{100 * r['share']:.0f} %"] for r in rows]
    return "Tactile whole step on the pyramid", table(
        ["environments", "sensor (100 taxels)", "env-steps/s", "of the engine alone"], cells
    )


def _published(rows: Rows) -> tuple[str, str]:
    cells = [[r["case"], f"{r['envs']:,}", f"{r['ms']:.3f}", f"{r['rate']:,.0f}", f"{r['kib']:.1f}"] for r in rows]
    columns = ["configuration", "environments", "ms / update", "sensor updates/s", "KiB / environment"]
    return "Tactile published configurations", table(columns, cells)


def _scaling(rows: Rows) -> tuple[str, str]:
    cells = [[r["case"], f"{r['value']:,}", f"{r['envs']:,}", f"{r['ms']:.3f}"] for r in rows]
    return "Tactile scaling", table(["axis", "value", "environments", "ms / update"], cells)


def _peer(rows: Rows) -> tuple[str, str]:
    cells = []
    for r in rows:
        alone = ["–"] * 3
        if r["case"] != "none":
            alone = [f"{r['ours_alone_us']:.1f}", f"{r['genesis_alone_us']:.0f}"]
            alone.append(f"{r['genesis_alone_us'] / r['ours_alone_us']:.0f} ×")
        whole = [f"{r['ours_us']:.0f}", f"{r['genesis_us']:.0f}", f"{r['genesis_us'] / r['ours_us']:.1f} ×"]
        cells.append([r["case"], *whole, *alone])
    columns = ["sensor", "step and sensor, ours", "Genesis 1.4.5", "ratio", "sensor alone, ours", "Genesis", "ratio"]
    note = "Processor µs per environment and step (all threads), 64 environments, 100 taxels, 500 points."
    return "Tactile sensors on the processor beside Genesis", f"{note}\n\n{table(columns, cells)}"


_LAYOUTS = {
    "check": _check,
    "sensors": _sensors,
    "step": _step,
    "published": _published,
    "scaling": _scaling,
    "peer": _peer,
}


def plot_scaling(rows: Rows, path: Path) -> None:
    """Draw cost against taxels, environments, triangles and points, one line per device."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 3.0), dpi=110, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    panels = (("taxels", AXES[:1]), ("environments", AXES[1:2]), ("triangles", AXES[2:4]), ("points", AXES[4:]))
    colours = ("#c1440e", "#2b6cb0")
    devices = list(dict.fromkeys(row["device"] for row in rows))
    for number, (title, axes_of) in enumerate(panels):
        axes = figure.add_subplot(1, 4, number + 1)
        for device, marker in zip(devices, "os^", strict=False):
            for axis, colour in zip(axes_of, colours, strict=False):
                kept = {row["value"]: row for row in rows if row["case"] == axis and row["device"] == device}
                if not kept:
                    continue
                x = sorted(kept)
                per = 1e3 if title == "environments" else 1e-3
                y = [kept[value]["ms"] / (per if title == "environments" else per * kept[value]["envs"]) for value in x]
                name = axis.split("(")[-1].rstrip(")") if "(" in axis else ""
                label = " ".join(part for part in (name, device if len(devices) > 1 else "") if part)
                axes.loglog(x, y, marker + "-", color=colour, markersize=4, linewidth=1, label=label or None)
                if number < 2:
                    scale = y[-1] / x[-1]
                    ends = [x[0], x[-1]]
                    axes.loglog(ends, [scale * end for end in ends], ":", color="#888888", linewidth=1)
        axes.set_title(title, fontsize=9)
        axes.set_ylabel("s / update" if title == "environments" else "µs / update and environment", fontsize=8)
        low, high = axes.get_ylim()
        axes.set_ylim(10 ** math.floor(math.log10(low)), 10 ** math.ceil(math.log10(high)))
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=7, frameon=False)
    figure.savefig(path)
