"""Are the statistics right? Simulations with a known truth behind every claim of docs/calibration.md.

    python -m benchmarks.scores.calibration [NAME ...] [--simulations N] [--workers N] [--seed N] [--write]

Names: nulls, coverage, noise, unique, ridge, pairs, over-time, dimensions, corrections, crossnobis, recovery, ceiling,
faults; all by default. ``--write`` puts the tables into RESULTS.md and docs/calibration.md, and the figures into
docs/images.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from benchmarks.report import publish, script_parser, table
from benchmarks.scores import simulated_boards
from benchmarks.scores.simulated_boards import BIN, BOARDS, RULES, NoisyStudy, Study
from brainbench.core.contracts import Trials
from brainbench.core.figures import COLORS, INK, PALE, panels, save_figure
from brainbench.core.files import write_text
from brainbench.core.runs.jobs import run_jobs
from brainbench.metrics import compare, get_metric, noise_ceiling, rdm
from brainbench.metrics.inference.multiple import step_down
from brainbench.metrics.inference.permutation import label_orders
from brainbench.metrics.rdms.comparison import compare_all, features, permuted_pairs
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, subject_rdm
from brainbench.scoring.power.experiments import ExperimentDesign, power, signal_dimensions, simulate_experiments

DOCS = Path(__file__).parents[2] / "docs"
IMAGES = DOCS / "images"
PAIRS = permuted_pairs(np.concatenate(list(label_orders(6, 0))))


@dataclass
class Result:
    title: str
    columns: list[str]
    rows: list[list[str]]
    picture: Callable[[], None] | None = None


def share(hits: np.ndarray) -> str:
    """A share with its Monte-Carlo standard error."""
    mean = float(np.mean(hits))
    return f"{mean:.3f} ± {math.sqrt(mean * (1 - mean) / len(hits)):.3f}"


@dataclass(frozen=True)
class Run:
    """How many simulations, from which seed, on how many processors."""

    simulations: int
    seed: int = 0
    workers: int | None = None

    def seeds(self) -> range:
        """Return one seed a simulation."""
        return range(self.seed * 1_000_000, self.seed * 1_000_000 + self.simulations)

    def each(self, function: Callable[[Any], Any], jobs: list[Any]) -> list[Any]:
        """Return what a function gives for each job, in their order."""
        found = dict(run_jobs(function, jobs, workers=self.workers))
        return [found[place] for place in range(len(jobs))]


NULL_METRICS = ("rsa", "rsa-correlation", "rsa-crossnobis", "cka", "procrustes", "ridge", "soft-matching", "one-to-one")
"""All but decoding, of which one study takes a minute."""


def nulls(run: Run) -> Result:
    """Uniform p of models of three layers that know nothing, 12 stimuli and 5 animals."""
    rows, found = [], {}
    for name in NULL_METRICS:
        jobs = [Study(seed, 12, 5, (0.0,), metric=name, quick=False, layers=3) for seed in run.seeds()]
        p = np.array(run.each(simulated_boards.null_p, jobs))
        p = found[name] = p[np.isfinite(p)]
        rows.append([name, str(len(p)), share(p <= 0.05), share(p <= 0.01), f"{stats.kstest(p, 'uniform').pvalue:.2g}"])

    def draw() -> None:
        figure, axes = _figure(1, 1)
        for name, p in found.items():
            axes[0].plot(np.sort(p), (np.arange(len(p)) + 1) / len(p), label=name)
        axes[0].plot([0, 1], [0, 1], ":", color="#999999")
        axes[0].set(xlabel="p", ylabel="share of unrelated models with p or less", xlim=(0, 1), ylim=(0, 1))
        axes[0].legend(frameon=False, fontsize=7)
        _save(figure, "calibration_p.png")

    title = "p of models that know nothing (three layers, 12 stimuli, 5 animals)"
    return Result(title, ["metric", "studies", "P(p ≤ .05)", "P(p ≤ .01)", "KS p"], rows, picture=draw)


SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


def coverage(run: Run) -> Result:
    """How often 95 % intervals hold the truth when animals and stimuli are drawn anew in every study."""
    rows, lines = [], {}
    for stimuli, animals in ((10, 4), (20, 5), (20, 11), (40, 5), (40, 11)):
        jobs = [Study(seed, stimuli, animals, SHARES) for seed in run.seeds()]
        found = np.array(run.each(simulated_boards.interval_found, jobs))
        held = []
        for index, asked in enumerate(SHARES):
            value, low, high, scaled, noiseless = found[:, index].T
            # The truth of a design: the mean noiseless comparison over animals and stimuli of the population.
            truth, known = noiseless.mean(), np.isfinite(low)
            inside = (low <= truth) & (truth <= high)
            held.append(inside[known].mean())
            means = map("{:.3f}".format, (truth, np.nanmean(value), np.nanmean(scaled)))
            width = f"{np.mean((high - low)[known]):.3f}"
            rows.append([str(stimuli), str(animals), f"{asked:g}", *means, share(inside[known]), width])
        lines[f"{stimuli} stimuli, {animals} animals"] = held

    def draw() -> None:
        figure, axes = _figure(1, 1)
        axes[0].axhline(0.95, ls=":", color="#999999")
        for name, held in lines.items():
            axes[0].plot(SHARES, held, marker=".", label=name)
        axes[0].set(xlabel="true score between chance and 1", ylabel="coverage of 95 % intervals", ylim=(0.7, 1.01))
        axes[0].legend(frameon=False, fontsize=7)
        _save(figure, "calibration_coverage.png")

    columns = ["stimuli", "animals", "share", "true value", "mean value", "mean scaled", "coverage", "width"]
    return Result("Coverage of 95 % intervals, animals and stimuli drawn anew", columns, rows, picture=draw)


def noise(run: Run) -> Result:
    """Coverage over trials, reliability and stimuli, and how often such a study is ``ok``."""
    rows, designs = [], list(product((10, 30, 100), (4, 7, 20), (0.3, 0.5, 0.7, 0.95)))
    # Studies of many stimuli take ten times as long, and their intervals are narrow.
    counts = [run.simulations // (3 if design[0] == 100 else 1) for design in designs]
    jobs = [
        NoisyStudy(seed, *each) for each, count in zip(designs, counts, strict=True) for seed in run.seeds()[:count]
    ]
    studies = np.split(np.array(run.each(simulated_boards.noisy_study, jobs)), np.cumsum(counts)[:-1])
    for design, found in zip(designs, studies, strict=True):
        ok, value, low, high, truth, estimate = np.moveaxis(found, -1, 0)
        row = [*map("{:g}".format, design), f"{np.nanmean(estimate):.2f}", f"{ok[:, 0].mean():.2f}"]
        for column in range(found.shape[1]):
            usable, true = ok[:, column] > 0, truth[:, column].mean()
            held = ((low <= true) & (true <= high))[usable, column]
            bias = value[usable, column].mean() / true - 1 if usable.any() else math.nan
            row.append(f"{held.mean():.2f} ({100 * bias:+.0f} %)" if len(held) >= _FEWEST_OK else "–")
        rows.append(row)
    columns = ["stimuli", "trials", "reliability", "estimated", "ok"]
    columns += [f"coverage (bias), true score {share:g}" for share in simulated_boards.SHARES_OF_NOISY]
    return Result("Coverage of 95 % intervals of studies that are ok, eight animals", columns, rows)


UNIQUE_DESIGNS = ((12, 0.5), (12, 0.8), (24, 0.5), (24, 0.8), (40, 0.5), (40, 0.8))
"""Stimuli and reliability of the animals."""


def unique(run: Run, study: Any = simulated_boards.unique_study, sides: tuple[str, ...] = ("",)) -> Result:
    """Coverage of the interval of the unique part, and how often it is found where there is one and where not."""
    rows = []
    for stimuli, reliability in UNIQUE_DESIGNS:
        studies = run.each(study, [NoisyStudy(seed, stimuli, 10, reliability) for seed in run.seeds()])
        labels = [f"{kind}, {hidden:g}{side}" for kind, hidden in simulated_boards.UNIQUE_CASES for side in sides]
        for label, (part, low, high, truth) in zip(labels, np.moveaxis(np.array(studies), 0, 2), strict=True):
            known = np.isfinite(part)
            true, part, low, high = np.nanmean(truth), part[known], low[known], high[known]
            numbers = f"{true:.3f}", f"{part.mean():.3f}", share((low <= true) & (true <= high)), share(low > 0)
            rows.append([str(stimuli), f"{reliability:g}", label, *numbers, str(len(part))])
    columns = ["stimuli", "reliability", "network, hidden share", "true", "mean", "coverage", "found above 0", "ok"]
    return Result("Unique part of networks of six layers, eight animals, ten trials", columns, rows)


_FEWEST_OK = 15
"""Studies that are ``ok`` below which a coverage says nothing."""


def pairs(run: Run) -> Result:
    """Null pairs told apart, and the power to find a better model, of boards of eight models."""
    rows = []
    for stimuli in (6, 20, 40, 60):
        for animals in (4, 11):
            jobs = [Study(seed, stimuli, animals) for seed in run.seeds()]
            found = run.each(simulated_boards.pairs_told_apart, jobs)
            for rule in RULES:
                told = {board: np.nanmean([one[board][rule] for one in found], axis=0) for board in BOARDS}
                nulls = [f"{told[board][place]:.3f}" for board in ("unrelated", "equally good") for place in (0, 1)]
                rows.append([str(stimuli), str(animals), rule, *nulls, f"{told['one better'][2]:.3f}"])
    columns = ["stimuli", "animals", "rule", "unrelated: p ≤ .05", "told apart"]
    columns += ["equally good: p ≤ .05", "told apart", "power, .9 against .4"]
    return Result("Pairs of models on boards of eight: null pairs told apart, and a better one found", columns, rows)


def over_time(run: Run) -> Result:
    """Level of the scores over time, and coverage of latencies."""
    found = np.array(run.each(simulated_boards.study_over_time, list(run.seeds())))
    p, layer_p, latency, low, high = found.T
    truth, known = 2 * BIN, np.isfinite(low)
    rows = [
        ["p of the best time, model unrelated: P(p ≤ .05)", share(p <= 0.05)],
        ["p of the best of three layers and all lags, unrelated: P(p ≤ .05)", share(layer_p <= 0.05)],
        ["latency of a related layer given", share(np.isfinite(latency))],
        ["its mean, ms (true: 100)", f"{1000 * np.nanmean(latency):.1f} ± {1000 * np.nanstd(latency):.1f} (SD)"],
        ["coverage of its 95 % interval", share(((low <= truth) & (truth <= high))[known])],
        ["mean width of the interval, ms", f"{1000 * np.mean((high - low)[known]):.1f}"],
    ]
    return Result("Scores over time: 16 stimuli, 6 animals, 12 bins of 50 ms, lag 100 ms", ["", "found"], rows)


def dimensions(run: Run) -> Result:
    """Dimensions estimated from trials, and the power they predict beside that of new experiments."""
    rows = []
    for stimuli in (6, 10, 20):
        for true in (2, 5, 10):
            study = partial(_power_study, stimuli=stimuli, dimensions=true)
            found = np.array(run.each(study, list(run.seeds())))
            effect, consistency, reliability = np.mean(found[:, 1:4], axis=0).tolist()
            estimate = float(np.median(found[:, 4]))
            design = ExperimentDesign(
                stimuli=stimuli, animals=8, effect=effect, consistency=consistency, reliability=reliability
            )
            predicted = [
                power(replace(design, dimensions=number), simulations=2000, seed=run.seed).power
                for number in (round(estimate), 10)
            ]
            rows.append(
                [str(stimuli), str(true), f"{estimate:.1f}", share(found[:, 0]), *(f"{one:.3f}" for one in predicted)]
            )
    columns = ["stimuli", "true dimensions", "estimated", "power of experiments", "predicted", "predicted for ten"]
    return Result("Power predicted with the dimensions of a pilot (8 animals of 60 neurons)", columns, rows)


def _power_study(seed: int, *, stimuli: int, dimensions: int) -> tuple[float, float, float, float, float]:
    """Return p ≤ .05, and the effect, consistency, reliability and dimensions of one experiment."""
    rng = np.random.default_rng([13, seed, stimuli, dimensions])
    animals, units, trials = 8, 60, 8
    shared = rng.normal(size=(stimuli, dimensions))
    own = rng.normal(size=(animals, stimuli, dimensions))
    weights = rng.normal(size=(2, animals, dimensions, units))
    means = math.sqrt(0.8) * shared @ weights[0] + math.sqrt(0.2) * own @ weights[1]
    model = rdm(simulated_boards.mixed(shared, 0.5, rng), method="sqeuclidean")
    labels = np.repeat(np.arange(stimuli), trials)
    responses = means[:, labels] + 2 * math.sqrt(dimensions) * rng.normal(size=(animals, len(labels), units))
    measured = responses.reshape(animals, stimuli, trials, units).mean(axis=2)
    brain, true = (np.stack([rdm(one, method="sqeuclidean") for one in several]) for several in (measured, means))
    sessions = [[Trials(one, labels)] for one in responses]
    orders = np.concatenate(list(label_orders(stimuli, seed, exact=6, draws=999)))
    null = compare(model[permuted_pairs(orders)][:, None], brain, method="whitened-cosine").mean(axis=1)

    def alike(one: np.ndarray, two: np.ndarray) -> np.ndarray:
        return compare(one, two, method="whitened-pearson")

    return (
        float((null >= null[0] - 1e-12).mean() <= 0.05),
        float(alike(model, true).mean()),
        float(alike(true[:, None], true)[np.triu_indices(animals, 1)].mean()),
        get_metric("rsa").animal("", sessions[0], stimuli, splits=10).reliability,
        signal_dimensions(sessions, stimuli),
    )


def corrections(run: Run) -> Result:
    simulations = run.simulations
    rows = []
    for count in (5, 20, 64):
        rng = np.random.default_rng(count)
        alarms, naive, found, alone = [], [], [], []
        for _ in range(0, simulations, 20):
            model, brain = simulate_experiments(rng, ExperimentDesign(animals=5, effect=0.0, layers=count), 20)
            true, _ = simulate_experiments(rng, ExperimentDesign(animals=5, effect=0.0), 20)
            mean = features(brain, "pearson").mean(axis=1)
            null = np.einsum("slnp,sp->sln", features(model, "pearson")[:, :, PAIRS], mean, optimize=True)
            strong = features(brain, "pearson").mean(axis=1) + 0.15 * true[:, 0] / np.sqrt(15)
            null_true = np.einsum("snp,sp->sn", features(strong, "pearson")[:, PAIRS], mean)
            for one, other in zip(null, null_true, strict=True):
                corrected = step_down(one)
                alarms.append(corrected.min() <= 0.05)
                naive.append((one >= one[:, :1] - 1e-12).mean(axis=1).min() <= 0.05)
                both = np.concatenate([other[None], one[1:]])
                found.append(step_down(both)[0] <= 0.05)
                alone.append((other >= other[0] - 1e-12).mean() <= 0.05)
        rows.append([str(count), *(share(np.array(hits)) for hits in (alarms, naive, found, alone))])
    return Result(
        "Many models at once: P(any model called significant) when none is, and finding the one that is",
        ["models", "corrected", "uncorrected", "true model found, corrected", "alone"],
        rows,
    )


def crossnobis(run: Run) -> Result:
    simulations = run.simulations
    rows = []
    for units, trials in ((10, (4, 5, 6, 8, 10, 12)), (40, (10,) * 6)):
        rng = np.random.default_rng(4)
        labels = np.repeat(np.arange(6), trials)
        spread = np.linalg.cholesky(np.eye(units) + 0.3) * np.linspace(0.5, 2, units)[:, None]
        kinds = [("crossnobis", noise) for noise in ("none", "diag", "shrinkage_diag", "full")] + [
            ("mahalanobis", "diag")
        ]
        found: dict[tuple[str, str], list[float]] = {kind: [] for kind in kinds if kind[1] != "full" or units == 10}
        for _ in range(simulations):
            block = Trials(rng.normal(size=(len(labels), units)) @ spread.T, labels)
            for (method, noise), values in found.items():
                values.append(subject_rdm("a", [block], 6, method=method, noise=noise, splits=1).rdm.mean())
        for (method, noise), values in found.items():
            mean, error = np.mean(values), np.std(values) / math.sqrt(len(values))
            rows.append([f"{units} units, {len(labels)} trials", method, noise, f"{mean:+.4f} ± {error:.4f}"])
    return Result("Mean distance between stimuli that are alike", ["data", "distance", "noise", "mean"], rows)


@dataclass
class Pool:
    """Many animals of one population, to draw experiments from."""

    subjects: list[SubjectRDM]
    model: np.ndarray
    truth: np.ndarray
    """[N] noiseless comparison of the model with each animal's own true RDM."""
    shared: np.ndarray
    """RDM of the shared geometry."""


def make_pool(
    count: int,
    noise: float,
    *,
    units: int = 30,
    repeats: int = 12,
    individual: float = 0.5,
    mix: float = 0.3,
    seed: int = 0,
) -> Pool:
    """Animals whose own geometry scatters about a shared one; Gaussian trial noise."""
    rng = np.random.default_rng(seed)
    latent, other = rng.normal(size=(6, 4)), rng.normal(size=(6, 4))
    model = rdm((latent + mix * other) @ rng.normal(size=(4, 50_000)))
    labels = np.repeat(np.arange(6), repeats)
    subjects, truth = [], []
    for index in range(count):
        means = (latent + individual * rng.normal(size=latent.shape)) @ rng.normal(size=(4, units))
        responses = means[labels] + noise * rng.normal(size=(len(labels), units))
        block = Trials(responses, labels, [str(trial) for trial in range(len(labels))])
        subjects.append(subject_rdm(str(index), [block], 6, splits=100))
        truth.append(float(compare(model, rdm(means))))
    # Over many units the correlation distance depends on the latent directions alone.
    shared = rdm(latent @ rng.normal(size=(4, 50_000)))
    return Pool(subjects, model, np.array(truth), shared)


def recovery(run: Run) -> Result:
    simulations = run.simulations
    rows = []
    for noise in (1.0, 3.0, 5.0, 7.0, 9.0, 12.0, 15.0, 20.0):
        pool = make_pool(simulations, noise, units=200, repeats=20, individual=0.0, mix=0.235, seed=7)
        reliability = np.array([subject.reliability for subject in pool.subjects])
        raw = np.array([float(compare(pool.model, subject.rdm)) for subject in pool.subjects])
        with np.errstate(invalid="ignore"):
            value = raw / np.sqrt(np.where(reliability > 0, reliability, np.nan))
        trusted = reliability >= 0.5
        kept = value[trusted]
        means = (reliability.mean(), pool.truth.mean(), raw.mean(), np.nanmean(value))
        sure = f"{kept.mean():.3f} ± {kept.std() / math.sqrt(len(kept)):.3f}" if len(kept) > 1 else "–"
        rows.append([*map("{:.3f}".format, means), sure, f"{1 - trusted.mean():.1%}"])
    return Result(
        "A true comparison near .954, corrected for noise",
        ["mean reliability", "truth", "raw r", "corrected, everyone", "corrected, reliable ones", "flagged"],
        rows,
        partial(draw_recovery, rows),
    )


def draw_recovery(rows: list[list[str]]) -> None:
    """Draw the rows of the table ``recovery``; bars are 95 % intervals of the simulation."""
    numbers = [[tuple(float(part) for part in cell.rstrip("%").split(" ± ")) for cell in row[:5]] for row in rows]
    x = [row[0][0] for row in numbers]
    figure, axes = _figure(1, 1, (6.0, 4.0))
    axes[0].axvspan(0, 0.5, color="0.94", lw=0)
    axes[0].text(0.49, 1.36, "reliability below 0.5:\nanimal left out", ha="right", va="top", fontsize=8.5, color=PALE)
    for index, name, colour, style in (
        (1, "true comparison, without noise", PALE, ":"),
        (2, "not corrected (raw r)", INK, "o-"),
        (3, "corrected, all animals", COLORS[1], "o--"),
        (4, "corrected, reliable animals (default)", COLORS[0], "o-"),
    ):
        y, half = [row[index][0] for row in numbers], [1.96 * sum(row[index][1:]) for row in numbers]
        axes[0].errorbar(x, y, half, fmt=style, color=colour, label=name, ms=4, capsize=3)
    axes[0].set(xlabel="mean split-half reliability of an animal's RDM", ylabel="correlation with the model's RDM")
    axes[0].set(xlim=(0.25, 1.02), ylim=(0, 1.4))
    axes[0].legend(frameon=False, loc="lower right", fontsize=8.5)
    _save(figure, "calibration_recovery.png")


def ceiling(run: Run) -> Result:
    simulations = run.simulations
    rows = []
    for noise in (1.0, 3.0, 5.0):
        pool = make_pool(800, noise, seed=10)
        rdms = np.stack([s.rdm for s in pool.subjects])
        raw = compare_all(pool.shared[None], rdms)[0]
        rng = np.random.default_rng(11)
        for animals in (5, 11):
            bounds = np.empty((simulations, 2))
            true = np.empty(simulations)
            for index in range(simulations):
                pick = rng.choice(len(rdms), animals, replace=False)
                bounds[index] = noise_ceiling(rdms[pick])[:2]
                true[index] = raw[pick].mean()
            expected = bounds.mean(axis=0)
            inside = expected[0] <= raw.mean() <= expected[1]
            reliability = f"{np.mean([s.reliability for s in pool.subjects]):.2f}"
            means = map("{:.3f}".format, (expected[0], raw.mean(), expected[1]))
            within = share((bounds[:, 0] <= true) & (true <= bounds[:, 1]))
            rows.append([reliability, str(animals), *means, "yes" if inside else "no", within])
    columns = ["reliability", "animals", "mean lower", "true model", "mean upper", "between", "between in one study"]
    return Result("Noise ceilings and what the shared geometry itself reaches (raw r)", columns, rows)


def faults(run: Run) -> Result:
    from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry
    from tests.factories.synthetic_animals import simulate

    rows, metric = [], get_metric("rsa")
    quiet = dict[str, Any](rate=8.0, window=1.0, modulation=0.3, emphasis=0.0, dispersion=0.0, shared_gain=0.0)
    for trials in ((20, 20), (8, 32)):
        design = PopulationDesign(animals=11, sessions=3, units=20, trials=trials, **quiet)
        for given in ((), ("zero-fill",), ("first-appearance",), ("first-appearance", "zero-fill")):
            values, reliable = [], []
            for study in run.seeds():
                geometry = ResponseGeometry.from_activations(np.random.default_rng(study).normal(size=(6, 4)))
                animals = simulate(geometry, design, seed=study, faults=given)
                blocks = [[Trials(b.responses[:, 0], b.labels, b.keys) for b in a.sessions] for a in animals]
                prepared = [metric.animal(str(i), block, 6) for i, block in enumerate(blocks)]
                score = metric.score_animals(prepared, stimuli=list("abcdef"))
                values.append(score.scaled)
                reliable.append(score.reliability)
            known = np.array(values)[np.isfinite(values)]
            spread = f"{known.mean():.3f} ± {known.std() / math.sqrt(len(known)):.3f}"
            rows.append(["{} to {}".format(*trials), " + ".join(given) or "none", spread, f"{np.mean(reliable):.2f}"])
    title = "Scaled animal-to-animal score of 11 animals of one geometry, with the released faults"
    return Result(title, ["trials of a stimulus", "fault", "score", "reliability"], rows)


JOBS: dict[str, Callable[[Run], Result]] = {
    "nulls": nulls,
    "coverage": coverage,
    "noise": noise,
    "unique": unique,
    "ridge": partial(unique, study=simulated_boards.ridge_study, sides=(": score", ": unique part")),
    "pairs": pairs,
    "over-time": over_time,
    "dimensions": dimensions,
    "corrections": corrections,
    "crossnobis": crossnobis,
    "recovery": recovery,
    "ceiling": ceiling,
    "faults": faults,
}


def _figure(rows: int, columns: int, inches: tuple[float, float] | None = None) -> tuple[Any, list[Any]]:
    figure, axes = panels(rows, columns, inches or (4.2 * columns, 3.2 * rows))
    return figure, list(axes.ravel())


def _save(figure: Any, name: str) -> None:
    save_figure(figure, IMAGES / name, dpi=150)


def write_docs(name: str, body: str) -> None:
    """Put a table where docs/calibration.md marks its place."""
    page = DOCS / "calibration.md"
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    before, _, rest = page.read_text(encoding="utf-8").partition(begin)
    write_text(page, f"{before}{begin}\n\n{body}\n\n{end}{rest.partition(end)[2]}")


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("names", nargs="*", choices=[*JOBS, []])
    parser.add_argument("--simulations", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=None, help="processes; all processors by default")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    run = Run(options.simulations, options.seed, options.workers)
    # Workers inherit this; threads of their own would only be in each other's way.
    os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"})
    for name in options.names or JOBS:
        start = time.perf_counter()
        result = JOBS[name](run)
        seconds = time.perf_counter() - start
        heading = f"{result.title}; {options.simulations:,} simulations, seed {options.seed}, {seconds:.0f} s."
        body = f"{heading}\n\n{table(result.columns, result.rows)}"
        print(f"\n## {name}\n", flush=True)
        words = f"{name} --simulations {options.simulations} --seed {options.seed}"
        publish(options, f"Calibration: {name}", body, words)
        if options.write:
            write_docs(name, body)
            if result.picture:
                result.picture()


if __name__ == "__main__":
    main()
