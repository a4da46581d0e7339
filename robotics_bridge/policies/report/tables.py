"""Tables of students and of agents that are none, as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from brainbench.core.records import Interval
from robotics_bridge.hands.layouts import is_probe_file
from robotics_bridge.policies.report.results import STOPPED, StudentResult, learned_of
from robotics_bridge.policies.training.distill_config import DistillConfig

COLUMNS = (
    "task", "hand", "contacts", "touch", "placement", "resolution", "noise", "encoder", "iterations", "seeds",
    "success", "over none", "goals", "rad/s", "s", "return",
)  # fmt: skip


_SHARED = COLUMNS[: COLUMNS.index("success")]
"""What students have in common stands above a table rather than in each of its rows."""


def _pm(value: tuple[float, float] | None) -> str:
    return "–" if value is None else f"{value[0]:.3g} ± {value[1]:.2g}"


def _span(interval: Interval | None) -> str:
    return "" if interval is None else f" [{interval.low:.3f}, {interval.high:.3f}]"


def sense(config: DistillConfig) -> tuple[str, str, str, str]:
    """Return placement, resolution, noise and encoder of a student's touch in words; dashes without touch."""
    tactile = config.tactile
    if tactile is None:
        return "–", "–", "–", "–"
    own = config.encoder_settings
    told = ([tactile.learning] if "learning" in own else []) + ([f"{own['units']} units"] if "units" in own else [])
    # A layout of one's own is a file; its name tells it apart.
    resolution = Path(config.resolution).stem if is_probe_file(config.resolution) else config.resolution
    encoder = f"{tactile.arm} ({', '.join(told)})" if told else tactile.arm
    return config.placement, resolution, "noisy" if config.noisy else "clean", encoder


def rows(results: Sequence[StudentResult]) -> list[list[str]]:
    """Return the table of the results as text, in the order of :data:`COLUMNS`."""
    found = []
    for result in results:
        config = result.config
        found.append(
            [
                *result.world, config.felt, *sense(config),
                learned_of(result.learned) or "–", str(len(result.seeds)),
                f"{result.value:.3f}{_span(result.interval)}",
                "–" if result.gain is None else f"{result.gain:+.3f}{_span(result.difference)}",
                *(_pm(result.graded.get(name)) for name in ("goals", "turn_rate", "seconds", "returns")),
            ]
        )  # fmt: skip
    return found


def agent_rows(agents: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the table of agents that are no students as text, in the order of :data:`COLUMNS`."""
    names = ("goals", "turn_rate", "seconds", "returns")
    return [
        [
            item["task"], "–", item.get("contacts", "–"), Path(item["agent"]).name, *["–"] * 6,
            "{:.3f} [{:.3f}, {:.3f}]".format(item["success_rate"], *item["success_interval"]), "–",
            *(_mean_of(item, name) for name in names),
        ]
        for item in agents
    ]  # fmt: skip


def _mean_of(item: Mapping[str, Any], name: str) -> str:
    mean, half_width = item.get(name), item.get(f"{name}_half_width")
    return _pm(None if mean is None else (mean, math.nan if half_width is None else half_width))


def concise(table: Sequence[Sequence[str]]) -> tuple[str, list[str], list[list[str]]]:
    """Return what all rows share, as words, and the columns and rows that are left; a dash in a row says nothing."""
    columns = {name: [row[index] for row in table] for index, name in enumerate(COLUMNS)}
    words = []
    for name in _SHARED:
        if len(said := {*columns[name]} - {"–"}) <= 1:
            words += [f"{name}: {one}" for one in said]
            del columns[name]
    return ", ".join(words), list(columns), [list(row) for row in zip(*columns.values(), strict=True)]


def remarks(results: Sequence[StudentResult]) -> list[str]:
    """Return every note once; how far students were trained in one line; at the end the students left out."""
    parts = dict.fromkeys(part for result in results for part in result.note.split("; ") if part)
    early = [result for result in results if STOPPED in result.note]
    found = [part for part in parts if not part.startswith(STOPPED)]
    if early:
        wanted = ", ".join(str(number) for number in sorted({result.config.iterations or 0 for result in early}))
        found.append(f"{STOPPED} {learned_of(n for result in early for n in result.learned)} of {wanted} iterations")
    return found + [
        f"left out: {result.name}, seed {item.seed}, after "
        f"{'unknown' if item.iterations is None else item.iterations} iterations ({item.reason})"
        for result in results
        for item in result.left_out
    ]
