"""Recovery among the shipped networks: which RDM and comparison find the network that made the data.

``choice``: wins of every distance and comparison, over stimuli, baselines and noise. ``null``: p of networks against
animals that know nothing of them. ``matrix``: the confusion matrix of the default design. ``selection``: stimuli that
are picked beside random ones. Wins in ``choice`` are by mean raw comparisons, layers chosen on the other animals.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.report import publish, script_parser
from brainbench.core.jobs import run_jobs
from brainbench.core.statistics import wilson_interval
from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry, draw_animals
from brainbench.metrics.inference.permutation import label_orders, tail_p
from brainbench.metrics.layers import held_out
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import compare_all, permuted_comparisons
from brainbench.metrics.rdms.pairs import permuted_pairs
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from brainbench.models.training.checkpoints import shipped
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.recovery import Candidate, RecoveryDesign, open_candidates, plot_confusion, recover
from brainbench.scoring.recovery.selection import keep_stimuli, select_stimuli

DISTANCES = ("sqeuclidean", "correlation", "mahalanobis", "crossnobis")
COMPARISONS = ("whitened-cosine", "cosine", "pearson", "whitened-pearson", "spearman")
SETTINGS = {
    "default": {},
    "unequal baselines": {"spread": 1.0},
    "weak tuning": {"modulation": 0.12},
    "standardised features": {},
}
STIMULI = (6, 20, 40)
KEPT = (6, 10)
PICTURE = Path("docs/images/recovery.png")


def drawn_rdms(
    candidate: Candidate, rows: np.ndarray, setting: str, stream: tuple[int, ...], methods: Iterable[str]
) -> dict[str, np.ndarray]:
    """Return the RDMs [A, P] of animals drawn from a candidate, by every method."""
    random = np.random.default_rng(stream)
    layer = candidate.choose("any", random)
    geometry = (
        ResponseGeometry.from_activations(candidate.features[layer][rows])
        if setting == "standardised features"
        else candidate.geometry(layer, rows)
    )
    animals = draw_animals(geometry, PopulationDesign(**SETTINGS[setting]), stream)
    blocks = [[replace(item, responses=item.responses[:, 0]) for item in sessions] for sessions in animals.values()]
    return {
        method: np.stack([subject_rdm("a", one, len(rows), method=method, splits=1).rdm for one in blocks])
        for method in methods
    }


def layer_rdms(candidates: Sequence[Candidate], method: str, rows: np.ndarray) -> list[np.ndarray]:
    """Return the RDMs [L, P] of every candidate."""
    pairs = permuted_pairs(rows[None], len(candidates[0].stimuli))[0]
    kind = "correlation" if method == "correlation" else "sqeuclidean"
    metric = RSA(model_method=kind)
    return [np.stack(list(item.layers(metric).values()))[:, pairs] for item in candidates]


def mean_chosen(r: np.ndarray) -> np.ndarray:
    """Return the mean over animals of comparisons [..., L, A], each with the layer chosen on the others."""
    known = np.where(np.isfinite(r).all(axis=-1, keepdims=True), r, -2.0)
    return held_out(known).mean(axis=-1)


def choice_board(
    candidates: Sequence[Candidate], boards: int, job: tuple[str, int, int]
) -> tuple[tuple[str, int], dict[tuple[str, str], int]]:
    """Count the wins of every distance and comparison over some boards of one true candidate."""
    setting, stimuli, true = job
    wins: dict[tuple[str, str], int] = dict.fromkeys(product(DISTANCES, COMPARISONS), 0)
    pool = len(candidates[0].stimuli)
    for number in range(boards):
        stream = (stimuli, true, number)
        rows = np.sort(np.random.default_rng([*stream, 1]).permutation(pool)[:stimuli])
        drawn = drawn_rdms(candidates[true], rows, setting, stream, DISTANCES)
        for method, rdms in drawn.items():
            brain, models = rdms[np.isfinite(rdms).all(axis=1)], layer_rdms(candidates, method, rows)
            if len(brain) < 2:
                continue
            for comparison in COMPARISONS:
                scores = [mean_chosen(compare_all(item, brain, method=comparison)) for item in models]
                wins[method, comparison] += int(np.argmax(scores) == true)
    return (setting, stimuli), wins


def choice(candidates: Sequence[Candidate], boards: int) -> str:
    """Return the table of win rates."""
    jobs = list(product(SETTINGS, STIMULI, range(len(candidates))))
    total: dict[tuple[str, int], dict[tuple[str, str], int]] = {}
    for _, (place, wins) in run_jobs(partial(choice_board, tuple(candidates), boards), jobs):
        kept = total.setdefault(place, dict.fromkeys(wins, 0))
        for name, count in wins.items():
            kept[name] += count
    count = boards * len(candidates)
    interval = wilson_interval(count // 2, count)
    lines = [
        f"{len(candidates)} shipped networks, {boards} boards of each: share of {count} boards in which the true "
        f"network has the highest score (Wilson interval of .50: {interval.low:.2f}–{interval.high:.2f}; chance "
        f"{1 / len(candidates):.2f}). Ten animals of 60 units, 16–20 trials where nothing else is said; a random layer "
        "and, below 40, random stimuli of the recipe `objects` for each board. Mahalanobis and "
        "crossnobis distances are divided by the noise of each unit.",
    ]
    for setting in SETTINGS:
        lines += ["", f"**{setting}**", "", "| distance | comparison | " + " | ".join(f"{k} stimuli" for k in STIMULI)]
        lines[-1] += " |"
        lines.append("|---|---|" + "---|" * len(STIMULI))
        for method, comparison in product(DISTANCES, COMPARISONS):
            rates = [total[setting, stimuli][method, comparison] / count for stimuli in STIMULI]
            lines.append(f"| {method} | {comparison} | " + " | ".join(f"{rate:.2f}" for rate in rates) + " |")
    return "\n".join(lines)


def null_p(candidates: Sequence[Candidate], boards: int, comparison: str, job: tuple[str, int]) -> list[float]:
    """Return p of a network against animals of a random geometry, for some boards."""
    method, stimuli = job
    found = []
    pool = len(candidates[0].stimuli)
    for number in range(boards):
        stream = (7, stimuli, number)
        random = np.random.default_rng(stream)
        rows = np.sort(random.permutation(pool)[:stimuli])
        unrelated = Candidate.of("unrelated", candidates[0].stimuli, {"a": random.standard_normal((pool, 12))})
        brain = drawn_rdms(unrelated, rows, "default", stream, [method])[method]
        layers = layer_rdms([candidates[number % len(candidates)]], method, rows)[0]
        orders = iter([np.concatenate(list(label_orders(stimuli, number, exact=1, draws=199)))])
        null = np.concatenate(list(permuted_comparisons(layers, brain, orders, comparison)))
        found.append(float(tail_p(mean_chosen(null)[:, None])[0]))
    return found


def null(candidates: Sequence[Candidate], boards: int) -> str:
    """Return the shares of small p where nothing is alike."""
    lines = [
        f"{boards} boards a row: animals of a random geometry, one shipped network after another; 199 orders.",
        "",
        "| distance | comparison | stimuli | p ≤ .05 | p ≤ .2 | p ≤ .5 |",
        "|---|---|---|---|---|---|",
    ]
    for method, comparison in (
        ("sqeuclidean", "whitened-cosine"),
        ("sqeuclidean", "whitened-pearson"),
        ("crossnobis", "whitened-pearson"),
    ):
        jobs = [(method, stimuli) for stimuli in STIMULI]
        for place, p in run_jobs(partial(null_p, tuple(candidates), boards, comparison), jobs):
            shares = " | ".join(f"{np.mean(np.array(p) <= level + 1e-12):.3f}" for level in (0.05, 0.2, 0.5))
            lines.append(f"| {method} | {comparison} | {jobs[place][1]} | {shares} |")
    return "\n".join([*lines[:4], *sorted(lines[4:])])


def matrix(candidates: Sequence[Candidate], boards: int) -> str:
    """Return the confusion matrix of the default design, and draw it."""
    start = time.perf_counter()
    found = recover(candidates, RecoveryDesign(), boards=boards)
    seconds = time.perf_counter() - start
    plot_confusion(found, PICTURE)
    lines = [
        found.answer(),
        "",
        f"{seconds:.0f} s on this machine; pairs of a board: "
        + ", ".join(f"{name} {share:.2f}" for name, share in found.outcomes.items())
        + ".",
        "",
        "| true network | first | interval | most often mistaken for |",
        "|---|---|---|---|",
    ]
    for place, name in enumerate(found.names):
        interval, row = found.wins(place), found.firsts[place].copy()
        own, row[place] = int(row[place]), 0
        other = f"{found.names[int(row.argmax())]} ({row.max()})" if row.max() else ""
        lines.append(f"| {name} | {own} of {found.made[place]} | {interval.low:.2f}–{interval.high:.2f} | {other} |")
    return "\n".join(lines)


def selection(candidates: Sequence[Candidate], boards: int) -> str:
    """Return the win rates of picked stimuli beside random ones, on boards that did not choose them."""
    lines = ["| stimuli | picked | as many at random | twice as many at random |", "|---|---|---|---|"]
    design = RecoveryDesign()
    for keep in KEPT:
        chosen = select_stimuli(candidates, keep, design)
        rates = [recover(keep_stimuli(candidates, chosen.rows), design, boards=boards)]
        rates += [recover(candidates, replace(design, stimuli=size), boards=boards) for size in (keep, 2 * keep)]
        cells = [f"{one.win_rate:.2f} [{one.wins().low:.2f}, {one.wins().high:.2f}]" for one in rates]
        lines.append(f"| {keep} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    return "\n".join(lines)


JOBS: dict[str, tuple[str, Callable[[Sequence[Candidate], int], str], int]] = {
    "choice": ("Recovery: which distance and comparison", choice, 10),
    "null": ("Recovery: unrelated networks", null, 200),
    "matrix": ("Recovery: the shipped networks", matrix, 20),
    "selection": ("Recovery: picked stimuli", selection, 10),
}


def main() -> None:
    """Run the named parts."""
    parser = script_parser(__doc__)
    parser.add_argument("names", nargs="*", choices=[*JOBS, []])
    parser.add_argument("--boards", type=int, help="boards of each network")
    parser.add_argument("--stimuli", default="objects")
    options = parser.parse_args()
    candidates, _ = open_candidates(list(shipped()), ScoreOptions(stimuli=options.stimuli))
    for name in options.names or JOBS:
        title, job, boards = JOBS[name]
        body = job(candidates, options.boards or boards)
        print(title, flush=True)
        publish(options, title, body, name)


if __name__ == "__main__":
    main()
