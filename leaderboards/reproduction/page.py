"""The page "What reproduces": verdicts, agreement of seeds, networks and figures 3.3 to 3.8, as Markdown."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from brainbench.core.files import write_text
from brainbench.core.statistics import is_finite, wilson_interval
from leaderboards.figures.charts import board_figures
from leaderboards.figures.plots import Figure
from leaderboards.figures.svg import standalone
from leaderboards.reproduction.campaign import Campaign, Network, NetworkKey, board_name
from leaderboards.reproduction.claims import GOAL, Judgement, judge_accuracy, judge_fit, lacks_of, seed_agreement
from leaderboards.reproduction.contrasts import Effect, Matched, Observed, contrast
from leaderboards.reproduction.measures import Measured, accuracies, fits, observed, published, published_accuracy
from leaderboards.reproduction.trainings import TRAININGS, Training
from leaderboards.site.page import render_markdown
from leaderboards.text import number, plural, span

PAGE = "what-reproduces.md"
_FIGURES = "images/what-reproduces"
# Order of the study: 3.3, 3.4, 3.5, 3.6, 3.7, 3.8, table 3.7.
_ORDER = (
    "parameters", "parameters-accuracy", "layers", "rdms", "rdm-lines", "accuracy", "fit", "accuracy-fit",
    "supervised-fit", "augmentation", "masking",
)  # fmt: skip


def write_page(campaign: Campaign, out: str | os.PathLike[str]) -> tuple[list[Path], list[Judgement]]:
    """Write the page with its figures into a folder; return its files, the page first, and the judgements on it."""
    out = Path(out)
    accuracy = judge_accuracy(campaign)
    fit = [judge_fit(campaign, place) for place in range(max(1, len(campaign.boards)))]
    figures = _figures(campaign)
    drawn = [(figure, f"{_FIGURES}/{figure.key}.svg") for figure in figures if figure.drawing is not None]
    values = {
        "synthetic": any(board.synthetic for board in campaign.boards),
        "trained": _trained(campaign),
        "counts": [_counts("Accuracy and training", accuracy), _counts("Neural fit", fit[0])],
        "accuracy": [_accuracy_row(item) for item in accuracy],
        "boards": [board_name(board) for board in campaign.boards],
        "too_small": [(board_name(board), lacks) for board in campaign.boards if (lacks := lacks_of(board))],
        "fit": [_fit_row(items, bool(campaign.boards)) for items in zip(*fit, strict=True)],
        "goal": GOAL,
        "seeds": _seed_rows(campaign),
        "networks": _network_rows(campaign),
        "diverged": any(line.status == "diverged" for line in campaign.trainings),
        "figures": drawn,
        "absent": [figure for figure in figures if figure.drawing is None],
        "left_out": _left_out(campaign),
    }
    lines = (line.rstrip() for line in render_markdown("reproduction.md.j2", **values).splitlines())
    text = re.sub(r"\n{3,}", "\n\n", "\n".join(lines)) + "\n"
    images = [write_text(out / file, standalone(one.drawing, follow=True)) for one, file in drawn if one.drawing]
    return [write_text(out / PAGE, text), *images], [*accuracy, *fit[0]]


def _figures(campaign: Campaign) -> list[Figure]:
    if not campaign.boards:
        return [Figure("none", "Figures 3.3 to 3.8", lacking="the campaign holds no result record yet")]
    found = {figure.key: figure for figure in board_figures(campaign.boards[0])}
    return [found[key] for key in _ORDER]


def _trained(campaign: Campaign) -> str:
    lines = [item for item in campaign.trainings if item.objective != "untrained"]
    if not lines:
        return f"Nothing stands in {TRAININGS} yet."
    titles = {(line.model, line.objective, line.augmentation, line.masking) for line in lines}
    text = f"Here {plural(len(lines), 'training')} of {len(titles)} networks are compared"
    if epochs := sorted({line.epochs for line in lines if line.epochs}):
        text += f", of {'/'.join(map(str, epochs))} epochs"
    text += "."
    if known := [line.data for line in lines if line.data.get("hash")]:
        hashes, data = " and ".join(sorted({str(one["hash"]) for one in known})), known[0]
        uses = {"train": "train", "validation": "validate", "test": "test on unseen objects"}
        stated = [f"{data[name]:,} to {verb}" for name, verb in uses.items() if isinstance(data.get(name), int)]
        text += f" Data {hashes}: {data.get('classes', '?')} classes; sweeps: {', '.join(stated)}."
    return text


def _counts(name: str, judged: Sequence[Judgement]) -> str:
    counts = Counter(item.verdict for item in judged).most_common()
    return f"{name}: " + ", ".join(f"{verdict} {count}" for verdict, count in counts)


def _effect(effect: Effect | None) -> str:
    if effect is None:
        return "–"
    interval = effect.interval if is_finite(effect.interval) else None
    return " ".join(filter(None, (number(effect.value), span(interval), effect.detail and f"({effect.detail})")))


def _accuracy_row(item: Judgement) -> tuple[str, ...]:
    theirs = number(item.published_effect.value) if item.published_effect else "–"
    return item.claim.claim, _published(item), theirs, _effect(item.effect), _above(item) or "–", _verdict(item)


def _above(item: Judgement) -> str:
    """Return how many comparisons lie above the neutral value; empty where the effect is no mean of comparisons."""
    if item.effect is None or item.claim.measure not in ("accuracy", "fit", "layers", "blocks"):
        return ""
    effect = item.effect
    return f"{effect.positive} of {effect.comparisons} above" if effect.comparisons > 1 else ""


def _published(item: Judgement) -> str:
    return f"{item.claim.published} ({item.claim.source})".strip()


def _verdict(item: Judgement) -> str:
    return item.verdict + (f": {item.reason}" if item.reason else "")


def _fit_row(items: Sequence[Judgement], scored: bool) -> tuple[str, ...]:
    """Return the row of one claim, with what the rule says on each board; the verdict is that of the first."""
    first = items[0]
    cells = [", ".join(filter(None, (_effect(one.effect), _above(one), one.rule))) for one in items if scored]
    return (first.claim.claim, _published(first), *cells, _verdict(first))


def _seed_rows(campaign: Campaign) -> list[tuple[str, ...]]:
    measured = {"top-5 accuracy": accuracies(campaign)}
    measured |= {f"fit on {board_name(board)}": fits(campaign, i) for i, board in enumerate(campaign.boards)}
    rows = []
    for name, one in measured.items():
        supervised, every = seed_agreement(one, "supervised"), seed_agreement(one)
        # Where both are equal, nothing else was repeated.
        for kind, found in (("supervised", supervised), ("all trained", every if every != supervised else [])):
            if found:
                mean = sum(tau for *_, tau in found) / len(found)
                told = ", ".join(f"{a} and {b}: {number(tau, 2)} ({count})" for a, b, count, tau in found)
                rows.append((f"{name}, {kind}", told, number(mean, 2), "reached" if mean >= GOAL else "not reached"))
    return rows


def _network_rows(campaign: Campaign) -> list[tuple[str, ...]]:
    first, five = accuracies(campaign, "top1"), accuracies(campaign)
    scores = [fits(campaign, place) for place in range(len(campaign.boards))]
    theirs = {key: number(item.value) for key, item in published_accuracy().networks.items()}
    expected = {NetworkKey.of(run["model"], run["objective"]) for run in published()["runs"]}
    expected = {key for key in expected if key.objective != "untrained"}
    rows = []
    for key in sorted({*campaign.networks, *expected}, key=lambda key: (key.objective, key)):
        network = campaign.networks.get(key, Network({}, {}))
        seeds = {*network.trainings, *(seed for one in network.records.values() for seed in one)}
        epochs = {line.epochs for line in network.trainings.values() if line.epochs}
        twin = five.networks.get(NetworkKey(key.encoder, key.attender, "untrained"))
        told = (number(twin.value) if twin and key.objective != "untrained" else "", theirs.get(key, ""))
        about = (", ".join(map(str, sorted(seeds))), "/".join(map(str, sorted(epochs))))
        means = (_mean(first, key), _mean(five, key), *told, *(_mean(one, key) for one in scores))
        rows.append((key.name, *about, *means, _remarks(network)))
    empty = [""] * len(scores)
    for line in campaign.other_trainings:
        about = (f"{line.model}.{line.objective}", str(line.seed), str(line.epochs or ""))
        told = ("", theirs.get(NetworkKey.of(line.model, line.objective), ""), *empty, _OTHER_SIZE)
        rows.append((*about, _alone(line, "top1"), _alone(line, "top5"), *told))
    for name, item in five.baselines.items():
        told = (_plain(first.baselines[name]), _plain(item))
        rows.append((f"{name} (linear probe)", "", "", *told, "", "", *empty, ""))
    return rows


_OTHER_SIZE = "of another size than most, so it enters no comparison"


def _alone(line: Training, name: str) -> str:
    result = line.evaluation if line.finished else None
    return _plain(observed(line.name, {0: result}, name, line.objective)) if result else line.status


def _mean(measured: Measured, key: NetworkKey) -> str:
    item = measured.networks.get(key)
    if item is None:
        return ""
    effect = contrast([Matched((item,))], measured.networks.values())
    known = effect is not None and is_finite(effect.interval)
    return _effect(effect) if known else _plain(item)


def _plain(item: Observed) -> str:
    """Return a value with its interval over test sweeps alone, or with that over animals and stimuli."""
    if item.sweeps:
        interval = wilson_interval(item.value * item.sweeps, item.sweeps)
        return f"{number(item.value)} {span(interval)}{'*' if item.objective else ''}"
    interval = item.sample.interval if item.sample else None
    return f"{number(item.value)} {span(interval)}*".replace(" *", "")


def _remarks(network: Network) -> str:
    lines = network.trainings
    if not lines and not network.records:
        return "not trained yet"
    marks: list[Any] = [(f"{line.status}", seed) for seed, line in lines.items() if line.status != "finished"]
    marks += [("collapsed", seed) for seed, line in lines.items() if line.evaluation and line.evaluation.collapsed]
    told = [f"{name} (seed {seed})" for name, seed in marks]
    # Of a learning rate that was given instead of searched, the accuracy alone is asked for.
    unscored = "accuracy only" if any(line.rate for line in lines.values()) else "not scored yet"
    return ", ".join(told + ([] if network.records else [unscored]))


def _left_out(campaign: Campaign) -> list[str]:
    listed = {line.model for line in campaign.other_trainings}
    found = [f"{name}: {_OTHER_SIZE}" for name in campaign.other_sizes if name not in listed]
    return found + [f"{name}: the record names neither architecture nor objective" for name in campaign.unmatched]
