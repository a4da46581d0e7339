"""The picture of a comparison of students: success and rotation with intervals, beside other agents."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from brainbench.core.figures.style import COLORS, PALE, panels, save_figure
from robotics_bridge.policies.report.results import StudentResult
from robotics_bridge.policies.report.tables import sense


def draw(results: Sequence[StudentResult], path: str | Path, *, agents: Sequence[Mapping[str, Any]] = ()) -> Path:
    """Draw success and rotation with intervals, two panels per task, hand and contacts; other agents as lines.

    A mark is a mean, a dot the success of one training seed.
    """
    groups: dict[tuple[str, str, str], list[StudentResult]] = defaultdict(list)
    for result in results:
        groups[result.world].append(result)
    longest = max(len(found) for found in groups.values())
    turning = any("turn_rate" in result.graded for result in results)
    size = (7.0 + 2.4 * turning, (1.7 + 0.38 * longest) * len(groups))
    figure, axes = panels(len(groups), 1 + turning, size, sharey="row")
    for row, ((task, hand, contacts), found) in zip(axes, groups.items(), strict=True):
        for height, result in enumerate(reversed(found)):
            interval = result.interval
            low, high = (result.value,) * 2 if interval is None else (interval.low, interval.high)
            color = PALE if result.config.observe == "none" else COLORS[0]
            marks = [(row[0], result.value, low, high)]
            if "turn_rate" in result.graded:
                mean, half = result.graded["turn_rate"]
                marks.append((row[1], mean, mean - half, mean + half))
            for axis, mean, low, high in marks:
                axis.plot([low, high], [height, height], color=color, lw=1.5)
                axis.plot(mean, height, "|", color=color, ms=11, mew=2)
            row[0].plot(result.success, [height] * len(result.success), "o", color=color, ms=4, mec="white", mew=0.5)
        # Agents of versions that did not state it were evaluated under the contacts of their students.
        others = [item for item in agents if item["task"] == task and item.get("contacts", contacts) == contacts]
        for number, item in enumerate(others, start=1):
            name, color = Path(item["agent"]).name, COLORS[number % len(COLORS)]
            label = {"zero": "no movement", "random": "random movement"}.get(name, name)
            lines = [(row[0], item["success_rate"], *item["success_interval"])]
            if turning and "turn_rate" in item:
                mean, half = item["turn_rate"], item.get("turn_rate_half_width", 0.0)
                lines.append((row[1], mean, mean - half, mean + half))
            for axis, mean, low, high in lines:
                axis.axvline(mean, color=color, lw=1, ls=(0, (4, 2)), label=label)
                axis.axvspan(low, high, color=color, alpha=0.15, lw=0)
        row[0].set_yticks(range(len(found)), [_label(result) for result in reversed(found)])
        row[0].set_xlabel("share of successful episodes")
        row[0].set_title(f"task {task}, hand {hand}, contacts {contacts}", loc="left", fontsize=9)
        if turning:
            row[1].set_xlabel("rotation about the axis (rad/s)")
    # One legend below, of the agents of all rows.
    named = [line for row in axes for line in row[0].get_lines() if not line.get_label().startswith("_")]
    if lines := {line.get_label(): line for line in named}:
        figure.legend(lines.values(), lines, loc="outside lower center", ncols=len(lines), fontsize=8.5, frameon=False)
    return save_figure(figure, Path(path), dpi=130)


def _label(result: StudentResult) -> str:
    placement, resolution, noise, encoder = sense(result.config)
    seeds = f"{len(result.seeds)} seeds" if len(result.seeds) > 1 else "one seed"
    if result.config.tactile is None:
        return f"{result.config.felt}, {seeds}"
    noise = ", noisy" if noise == "noisy" else ""
    return f"{result.config.felt}, {placement}, {resolution}{noise}\n{encoder}, {seeds}"
