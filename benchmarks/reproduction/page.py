"""The page "What reproduces": verdicts, agreement of seeds, networks and figures 3.3 to 3.8, as Markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template

from benchmarks.report import table
from benchmarks.reproduction.campaign import Campaign, Network, NetworkKey, Training, board_name
from benchmarks.reproduction.claims import (
    ERROR,
    Judgement,
    accuracy_tests,
    allowed_error,
    fit_tests,
    judge_accuracy,
    judge_fit,
    seed_agreement,
)
from benchmarks.reproduction.contrasts import Effect, Matched, Observed, contrast
from benchmarks.reproduction.measures import Measured, accuracies, fits, observed, published_accuracy
from benchmarks.reproduction.touch import RULE, part_two, stimuli_table, write_pages
from brainbench.core.files import write_text
from brainbench.core.records import ESTIMATOR_VERSION
from brainbench.core.statistics import is_finite, wilson_interval
from leaderboards.figures.charts import board_figures
from leaderboards.figures.svg import Drawing, standalone
from leaderboards.site.build import escape_markdown
from leaderboards.text import SYNTHETIC, number, plural, span

PAGE = "what-reproduces.md"
_FIGURES = "images/what-reproduces"
# Order of the study: 3.3, 3.4, 3.5, 3.6, 3.7, 3.8, table 3.7.
_ORDER = (
    "parameters", "parameters-accuracy", "layers", "rdms", "rdm-lines", "accuracy", "fit", "accuracy-fit",
    "supervised-fit", "augmentation", "masking",
)  # fmt: skip
_GOAL = 0.8
"""Kendall's τ that the rankings of two seeds should reach."""
_DARK = "@media (prefers-color-scheme:dark){svg.figure{filter:invert(1) hue-rotate(180deg)}}"
"""Style of a drawing on a dark ground: light and dark change places, hues stay."""
_SYNTHETIC = (
    f'> **{SYNTHETIC}** Claims on neural fit are therefore marked "cannot be tested here"; beside them stands what the '
    "rule says of the\n> synthetic animals. Scores of real recordings can be given as records instead.\n\n"
)


def write_page(campaign: Campaign, out: Path) -> tuple[list[Path], list[Judgement]]:
    """Write the page with its figures into a folder; return its files, the page first, and the judgements on it."""
    places = range(len(campaign.boards))
    tests = [
        accuracy_tests(campaign),
        *(fit_tests(campaign, place) for place in places if not campaign.boards[place].lacks),
    ]
    count, error = sum(map(len, tests)), allowed_error([test for group in tests for test in group])
    accuracy = judge_accuracy(campaign, error)
    fit = [judge_fit(campaign, place, error) for place in places]
    boards = {board_name(board): board for board in campaign.boards}
    lacks = [(name, board.lacks) for name, board in boards.items() if board.lacks]
    versions = {board.estimator.partition("version ")[2] or str(ESTIMATOR_VERSION) for board in campaign.boards}
    figures, images = _figures(campaign, out)
    ranked = ["ranking by", "τ of two seeds (networks)", "mean τ", "goal"]
    columns = ["claim", "published", "published effect", "ours", "comparisons", "verdict"]
    named = ["network", "seeds", "epochs", "top-1", "top-5", "untrained top-5", "published top-5", *boards, "remarks"]
    values = {
        "synthetic": _SYNTHETIC if any(board.synthetic for board in campaign.boards) else "",
        "trained": _trained(campaign),
        "version": ", ".join(sorted(versions)),
        "counts": f"{_counts('Accuracy and training', accuracy)}\n{_counts('Neural fit', fit[0])}",
        "accuracy": _table(columns, map(_accuracy_row, accuracy), columns[2:5]),
        "too_small": "".join(f"On {name} the rule leaves all undecided: it needs {lack}.\n" for name, lack in lacks),
        "fit": _table(["claim", "published", *boards, "verdict"], map(_fit_row, zip(*fit, strict=True))),
        "corrected": (
            f"{count} verdicts of this page are corrected together (false discovery rate 5 %): an interval of "
            f"{1 - error:.1%} decides.\nWithout the correction {ERROR * count:.1f} would be decided by chance."
        ),
        "goal": _GOAL,
        "seeds": _table(ranked, _seed_rows(campaign), ranked[2:3]),
        "networks": _table(named, _network_rows(campaign), named[3:-1]),
        "figures": figures,
        "stimuli": stimuli_table(),
        "touch": part_two(),
        "touch_rule": RULE,
    }
    text = Template(Path(__file__).with_name("page.md").read_text(encoding="utf-8")).substitute(values)
    return [write_text(out / PAGE, text), *images, *write_pages(out, _for_dark)], [*accuracy, *fit[0]]


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]], right: Sequence[str] = ()) -> str:
    return table(list(columns), [[escape_markdown(cell) for cell in row] for row in rows], right=right)


def _figures(campaign: Campaign, out: Path) -> tuple[str, list[Path]]:
    """Write the figures of the first board; return what shows them, and their files."""
    found = {figure.key: figure for figure in board_figures(campaign.boards[0])}
    shown, absent, files = [], [], []
    for figure in map(found.__getitem__, _ORDER):
        title = escape_markdown(figure.title)
        if figure.drawing is None:
            absent.append(f"{title}: {escape_markdown(figure.lacking)}.")
            continue
        file = f"{_FIGURES}/{figure.key}.svg"
        files.append(write_text(out / file, _for_dark(figure.drawing)))
        shown.append(f"![{title}]({file})\n\n*{title}.* {escape_markdown(figure.caption)}")
    return "\n\n".join([*shown, *([f"Not drawn: {' '.join(absent)}"] if absent else [])]), files


def _for_dark(drawing: Drawing) -> str:
    return standalone(drawing).replace("</style>", f"{_DARK}</style>", 1)


def _trained(campaign: Campaign) -> str:
    lines = [line for line in campaign.trainings if line.objective != "untrained"]
    titles = {(line.model, line.objective, line.augmentation, line.masking) for line in lines}
    epochs, data = "/".join(map(str, sorted({line.epochs for line in lines if line.epochs}))), lines[0].data
    return (
        f"Here {plural(len(lines), 'training')} of {len(titles)} networks are compared, of {epochs} epochs. Data "
        f"{data['hash']}: {data['classes']} classes; sweeps: {data['train']:,} to train, {data['validation']:,} to "
        f"validate, {data['test']:,} to test on unseen objects."
    )


def _counts(name: str, judged: Sequence[Judgement]) -> str:
    counts = Counter(item.verdict for item in judged).most_common()
    return f"- {name}: " + ", ".join(f"{verdict} {count}" for verdict, count in counts)


def _effect(effect: Effect | None) -> str:
    if effect is None:
        return "–"
    interval = effect.interval if is_finite(effect.interval) else None
    return " ".join(filter(None, (number(effect.value), span(interval), effect.detail and f"({effect.detail})")))


def _accuracy_row(item: Judgement) -> tuple[str, ...]:
    theirs = number(item.published_effect.value) if item.published_effect else "–"
    return item.claim.claim, _published(item), theirs, _effect(item.effect), _above(item) or "–", _verdict(item)


def _fit_row(items: Sequence[Judgement]) -> tuple[str, ...]:
    """Return the row of one claim, with what the rule says on each board; the verdict is that of the first."""
    first = items[0]
    cells = [", ".join(filter(None, (_effect(one.effect), _above(one), one.rule))) for one in items]
    return (first.claim.claim, _published(first), *cells, _verdict(first))


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


def _seed_rows(campaign: Campaign) -> list[tuple[str, ...]]:
    measured = {"top-5 accuracy": accuracies(campaign)}
    measured |= {f"fit on {board_name(board)}": fits(campaign, i) for i, board in enumerate(campaign.boards)}
    rows = []
    for name, one in measured.items():
        for family in ("", "ConvRNNs"):
            if not (found := seed_agreement(one, family=family)):
                continue
            mean = sum(tau for *_, tau in found) / len(found)
            told = ", ".join(f"{a} and {b}: {number(tau, 2)} ({count})" for a, b, count, tau in found)
            verdict = "reached" if mean >= _GOAL else "not reached"
            rows.append((f"{name}, {family or 'all'} supervised", told, number(mean, 2), verdict))
    return rows


def _network_rows(campaign: Campaign) -> list[tuple[str, ...]]:
    top1, top5 = accuracies(campaign, "top1"), accuracies(campaign)
    scores = [fits(campaign, place) for place in range(len(campaign.boards))]
    theirs = {key: number(item.value) for key, item in published_accuracy().networks.items()}
    rows = []
    for key, network in sorted(campaign.networks.items(), key=lambda item: (item[0].objective, item[0])):
        seeds = sorted({*network.trainings, *(seed for one in network.records.values() for seed in one)})
        epochs = sorted({line.epochs for line in network.trainings.values() if line.epochs})
        twin = top5.networks.get(key.untrained) if key.objective != "untrained" else None
        about = (key.name, ", ".join(map(str, seeds)), "/".join(map(str, epochs)))
        told = (number(twin.value) if twin else "", theirs.get(key, ""))
        means, fit = ([_mean(one, key) for one in some] for some in ((top1, top5), scores))
        rows.append((*about, *means, *told, *fit, _remarks(network)))
    empty = [""] * len(scores)
    for key, network in campaign.full.items():
        for line in network.trainings.values():
            told = ("", theirs.get(key._replace(full=False), ""))
            means = [_alone(line, name) for name in ("top1", "top5")]
            about = (key.name, str(line.seed), str(line.epochs or ""))
            rows.append((*about, *means, *told, *empty, "of another size than most, so it enters no comparison"))
    for name, item in top5.baselines.items():
        means = (_plain(top1.baselines[name]), _plain(item))
        rows.append((f"{name} (linear probe)", "", "", *means, "", "", *empty, ""))
    return rows


def _alone(line: Training, name: str) -> str:
    return _plain(observed(line.name, {0: line.result}, name, line.objective)) if line.result else line.status


def _mean(measured: Measured, key: NetworkKey) -> str:
    item = measured.networks.get(key)
    if item is None:
        return ""
    effect = contrast([Matched((item,))], measured.networks.values())
    return _effect(effect) if effect is not None and is_finite(effect.interval) else _plain(item)


def _plain(item: Observed) -> str:
    """Return a value with its interval over test sweeps alone, or over animals and stimuli; ``*`` leaves seeds out."""
    interval = wilson_interval(item.value * item.sweeps, item.sweeps) if item.sweeps else None
    interval = item.sample.interval if item.sample else interval
    return f"{number(item.value)} {span(interval)}".rstrip() + ("*" if item.objective else "")


def _remarks(network: Network) -> str:
    lines = network.trainings
    told = [f"diverged (seed {seed})" for seed, line in lines.items() if line.status == "diverged"]
    told += [f"collapsed (seed {seed})" for seed, line in lines.items() if line.result and line.result.collapsed]
    # Of a learning rate that was given instead of searched, the accuracy alone is asked for.
    unscored = "accuracy only" if any(line.rate for line in lines.values()) else "not scored yet"
    return ", ".join(told + ([] if network.records else [unscored]))
