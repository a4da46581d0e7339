"""Are the statistics right? Simulations with a known truth behind every claim of docs/statistics.md.

    python -m benchmarks.scores.calibration [NAME ...] [--simulations 2000] [--write]

Names: p-values, corrections, crossnobis, recovery, coverage, ceiling, equivalence, faults; all by default.
``--write`` puts the tables into RESULTS.md and the figures into docs/images.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.report import table, write_section
from brainbench.core.trials import Trials
from brainbench.metrics import compare, rdm
from brainbench.metrics.animal_to_animal import score_animals
from brainbench.metrics.inference.bootstrap import animal_counts, ceilings, drawn_scores, noise_factors
from brainbench.metrics.inference.equivalence import equivalence_test
from brainbench.metrics.inference.intervals import bca_interval, percentile_interval, t_interval
from brainbench.metrics.inference.multiple import sign_flip_p, step_down
from brainbench.metrics.inference.permutation import label_orders
from brainbench.metrics.inference.power import ExperimentDesign, simulate_experiments
from brainbench.metrics.layers import held_out
from brainbench.metrics.rdms.comparison import compare_all, features
from brainbench.metrics.rdms.pairs import permuted_pairs
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, subject_rdm

IMAGES = Path(__file__).parents[2] / "docs" / "images"
PAIRS = permuted_pairs(np.concatenate(list(label_orders(6, 0))))
INK, ACCENT, WARN = "#333333", "#1f6f8b", "#c0504d"


@dataclass
class Result:
    title: str
    columns: list[str]
    rows: list[list[str]]
    note: str = ""
    picture: Callable[[], None] | None = None


def share(hits: np.ndarray) -> str:
    """A share with its Monte-Carlo standard error."""
    mean = float(np.mean(hits))
    return f"{mean:.3f} ± {math.sqrt(mean * (1 - mean) / len(hits)):.3f}"


def null_statistics(simulations: int, layers: int, animals: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Statistics without an effect, under every order: of the held-out choice [S, 720] and of layers [S, 720, L]."""
    rng = np.random.default_rng(seed)
    held, each = [], []
    for _ in range(0, simulations, 20):
        model, brain = simulate_experiments(rng, ExperimentDesign(animals=animals, effect=0.0, layers=layers), 20)
        left, right = features(model, "pearson"), features(brain, "pearson")
        r = np.einsum("slnp,sap->snla", left[:, :, PAIRS], right, optimize=True)
        held.append(held_out(r).mean(axis=-1) if layers > 1 else r[:, :, 0].mean(axis=-1))
        each.append(r.mean(axis=-1))
    return np.concatenate(held)[:simulations], np.concatenate(each)[:simulations]


def p_of(statistic: np.ndarray) -> np.ndarray:
    return (statistic >= statistic[:, :1] - 1e-12).mean(axis=1)


def p_values(simulations: int) -> Result:
    one, _ = null_statistics(simulations, 1, 11, 1)
    chosen, each = null_statistics(simulations, 12, 11, 2)
    best = each[:, 0].argmax(axis=1)
    naive = p_of(np.take_along_axis(each, best[:, None, None], axis=2)[..., 0])
    largest = p_of(each.max(axis=2))
    # The test that resamples animals asks another question, which six stimuli cannot answer.
    rng = np.random.default_rng(3)
    resampled = []
    for _ in range(simulations):
        model, brain = simulate_experiments(rng, ExperimentDesign(effect=0.0), 1)
        resampled.append(t_interval(compare(model[0, 0], brain[0]), 0.9).low > 0)
    found = {
        "one layer": p_of(one),
        "12 layers, chosen on the other animals (a score's p)": p_of(chosen),
        "12 layers, largest of all, corrected (layer_tests)": largest,
        "12 layers, largest of all, uncorrected (naive)": naive,
    }
    rows = [[name, share(p <= 0.05), f"{stats.kstest(p, 'uniform').pvalue:.2g}"] for name, p in found.items()]
    rows.append(["one layer, one-sided t interval over animals instead", share(np.array(resampled)), ""])

    def draw() -> None:
        figure, axes = _figure(1, 2)
        for name, p, colour in (
            ("one layer", found["one layer"], INK),
            ("12 layers, held out", p_of(chosen), ACCENT),
            ("12 layers, naive maximum", naive, WARN),
        ):
            axes[0].plot(np.sort(p), (np.arange(len(p)) + 1) / len(p), color=colour, label=name)
        axes[0].plot([0, 1], [0, 1], ":", color="#999999")
        axes[0].set(xlabel="p", ylabel="share of unrelated models with p or less", xlim=(0, 1), ylim=(0, 1))
        axes[0].legend(frameon=False)
        axes[1].hist(
            [p_of(one), p_of(chosen), naive],
            bins=20,
            range=(0, 1),
            density=True,
            color=[INK, ACCENT, WARN],
            histtype="step",
        )
        axes[1].axhline(1, ls=":", color="#999999")
        axes[1].set(xlabel="p", ylabel="density")
        _save(figure, "calibration_p.png")

    return Result(
        "p-values of models that know nothing (11 animals of one geometry, 6 stimuli)",
        ["test", "P(p ≤ .05)", "KS p"],
        rows,
        "",
        draw,
    )


def corrections(simulations: int) -> Result:
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
        rows.append(
            [
                str(count),
                share(np.array(alarms)),
                share(np.array(naive)),
                share(np.array(found)),
                share(np.array(alone)),
            ]
        )
    return Result(
        "Many models at once: P(any model called significant) when none is, and finding the one that is",
        ["models", "corrected", "uncorrected", "true model found, corrected", "alone"],
        rows,
    )


def crossnobis(simulations: int) -> Result:
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
    draws: int = 0,
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
        subjects.append(subject_rdm(str(index), [block], 6, splits=100, draws=draws, draw_splits=10))
        truth.append(float(compare(model, rdm(means))))
    # Over many units the correlation distance depends on the latent directions alone.
    shared = rdm(latent @ rng.normal(size=(4, 50_000)))
    return Pool(subjects, model, np.array(truth), shared)


def recovery(simulations: int) -> Result:
    rows, points = [], []
    for noise in (1.0, 3.0, 5.0, 7.0, 9.0, 12.0, 15.0, 20.0):
        pool = make_pool(simulations, noise, units=200, repeats=20, individual=0.0, mix=0.235, seed=7)
        reliability = np.array([subject.reliability for subject in pool.subjects])
        raw = np.array([float(compare(pool.model, subject.rdm)) for subject in pool.subjects])
        with np.errstate(invalid="ignore"):
            value = raw / np.sqrt(np.where(reliability > 0, reliability, np.nan))
        trusted = reliability >= 0.5
        kept = value[trusted]
        points.append(
            (
                reliability.mean(),
                pool.truth.mean(),
                raw.mean(),
                np.nanmean(value),
                kept.mean() if trusted.any() else np.nan,
                trusted.mean(),
            )
        )
        rows.append(
            [
                f"{reliability.mean():.3f}",
                f"{pool.truth.mean():.3f}",
                f"{raw.mean():.3f}",
                f"{np.nanmean(value):.3f}",
                f"{kept.mean():.3f} ± {kept.std() / math.sqrt(len(kept)):.3f}" if len(kept) > 1 else "–",
                f"{1 - trusted.mean():.1%}",
            ]
        )

    def draw() -> None:
        figure, axes = _figure(1, 1)
        x = [point[0] for point in points]
        for index, name, colour, style in (
            (1, "truth", "#999999", ":"),
            (2, "raw r", INK, "-"),
            (3, "corrected, everyone", WARN, "--"),
            (4, "corrected, reliable animals (default)", ACCENT, "-"),
        ):
            axes[0].plot(
                x,
                [point[index] for point in points],
                style,
                color=colour,
                label=name,
                marker="." if style != ":" else None,
            )
        axes[0].axvline(0.5, ls=":", color="#999999")
        axes[0].set(xlabel="mean reliability of an animal's RDM", ylabel="comparison with the model", ylim=(0, 1.4))
        axes[0].legend(frameon=False, loc="lower left", fontsize=7)
        _save(figure, "calibration_recovery.png")

    return Result(
        "A true comparison near .954, corrected for noise",
        ["mean reliability", "truth", "raw r", "corrected, everyone", "corrected, reliable ones", "flagged"],
        rows,
        "",
        draw,
    )


def coverage(simulations: int) -> Result:
    methods = ("t", "percentile, animals", "BCa, animals", "percentile, all levels", "BCa, all levels")
    rows, lines = [], []
    draws = 400
    for noise, word in ((2.0, "little"), (4.5, "much")):
        pool = make_pool(800, noise, draws=draws, seed=8)
        usable = [s for s in pool.subjects if s.reliability >= 0.5]
        rdms = np.stack([s.rdm for s in usable])
        factors = 1 / np.sqrt(np.array([s.reliability for s in usable]))
        values = compare_all(pool.model[None], rdms)[0] * factors
        drawn = np.stack([compare_all(pool.model[None], s.draws)[0] for s in usable], axis=1)
        drawn_factors = np.stack([noise_factors(s.draws_r) for s in usable], axis=1)
        reliability = np.mean([s.reliability for s in usable])
        truth = values.mean()
        rng = np.random.default_rng(9)
        for animals in (3, 4, 5, 6, 8, 11, 20):
            hits = {name: np.zeros(simulations, dtype=bool) for name in methods}
            for index in range(simulations):
                pick = rng.choice(len(usable), animals, replace=False)
                counts = animal_counts(rng, animals, draws)
                own = values[pick]
                jackknife = (own.sum() - own) / (animals - 1)
                top = counts @ own / animals
                every = drawn_scores(drawn[:, pick][None], drawn_factors[:, pick], counts)
                intervals = (
                    t_interval(own, 0.9),
                    percentile_interval(top, 0.9),
                    bca_interval(top, own.mean(), jackknife, 0.9),
                    percentile_interval(every, 0.9),
                    bca_interval(every, own.mean(), jackknife, 0.9),
                )
                for name, interval in zip(methods, intervals, strict=True):
                    hits[name][index] = interval is not None and interval.low <= truth <= interval.high
            rows.append([f"{word} ({reliability:.2f})", str(animals), *(share(hits[name]) for name in methods)])
            lines.append((word, animals, [hits[name].mean() for name in methods]))

    def draw() -> None:
        figure, axes = _figure(1, 2)
        for axis, word in zip(axes, ("little", "much"), strict=True):
            axis.axhspan(0.86, 0.94, color="#eeeeee")
            axis.axhline(0.9, ls=":", color="#999999")
            own = [line for line in lines if line[0] == word]
            for index, (name, colour) in enumerate(
                zip(methods, (ACCENT, WARN, "#e0a030", INK, "#777777"), strict=True)
            ):
                axis.plot(
                    [line[1] for line in own], [line[2][index] for line in own], color=colour, marker=".", label=name
                )
            axis.set(
                xlabel="animals",
                ylabel="coverage of 90 % intervals",
                ylim=(0.55, 1),
                title=f"{word} trial noise",
                xticks=(3, 5, 8, 11, 20),
            )
        axes[0].legend(frameon=False, fontsize=7)
        _save(figure, "calibration_coverage.png")

    return Result(
        "Coverage of 90 % intervals of the mean score",
        ["trial noise (reliability)", "animals", *methods],
        rows,
        "",
        draw,
    )


def ceiling(simulations: int) -> Result:
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
                bounds[index] = ceilings(rdms[pick], np.ones((1, animals)), "pearson")[0]
                true[index] = raw[pick].mean()
            expected = bounds.mean(axis=0)
            inside = expected[0] <= raw.mean() <= expected[1]
            rows.append(
                [
                    f"{np.mean([s.reliability for s in pool.subjects]):.2f}",
                    str(animals),
                    f"{expected[0]:.3f}",
                    f"{raw.mean():.3f}",
                    f"{expected[1]:.3f}",
                    "yes" if inside else "no",
                    share((bounds[:, 0] <= true) & (true <= bounds[:, 1])),
                ]
            )
    columns = ["reliability", "animals", "mean lower", "true model", "mean upper", "between", "between in one study"]
    return Result("Noise ceilings and what the shared geometry itself reaches (raw r)", columns, rows)


def equivalence(simulations: int) -> Result:
    rows = []
    rng = np.random.default_rng(12)
    for animals in (5, 8, 11):
        flips, edge, alike = [], [], []
        for _ in range(simulations):
            d = 0.1 * rng.normal(size=animals)
            flips.append(sign_flip_p(d) <= 0.05)
            consistency = 0.85 + 0.05 * rng.normal(size=animals)
            edge.append(
                equivalence_test(consistency - 0.1 + 0.08 * rng.normal(size=animals), consistency).verdict
                == "equivalent"
            )
            alike.append(
                equivalence_test(consistency + 0.08 * rng.normal(size=animals), consistency).verdict == "equivalent"
            )
        rows.append([str(animals), share(np.array(flips)), share(np.array(edge)), share(np.array(alike))])
    return Result(
        "Paired tests over animals at α = .05",
        [
            "animals",
            "sign flips, no difference",
            "equivalence claimed at the margin",
            "claimed when equal (sd of differences .08)",
        ],
        rows,
    )


def faults(simulations: int) -> Result:
    from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry, simulate

    rows = []
    for trials in ((20, 20), (8, 32)):
        size = PopulationDesign(animals=11, sessions=3, units=20, trials=trials, rate=8.0, window=1.0, modulation=0.3)
        design = replace(size, emphasis=0.0, dispersion=0.0, shared_gain=0.0)
        for given in ((), ("zero-fill",), ("first-appearance",), ("first-appearance", "zero-fill")):
            values, reliable = [], []
            for study in range(simulations):
                geometry = ResponseGeometry.from_features(np.random.default_rng(study).normal(size=(6, 4)))
                animals = simulate(geometry, design, seed=study, faults=given)
                blocks = [[Trials(b.responses[:, 0], b.labels, b.keys) for b in a.sessions] for a in animals]
                score = score_animals([subject_rdm(str(i), block, 6, splits=50) for i, block in enumerate(blocks)])
                values.append(score.value)
                reliable.append(score.reliability)
            known = np.array(values)[np.isfinite(values)]
            spread = f"{known.mean():.3f} ± {known.std() / math.sqrt(len(known)):.3f}"
            rows.append(["{} to {}".format(*trials), " + ".join(given) or "none", spread, f"{np.mean(reliable):.2f}"])
    title = (
        f"Animal-to-animal score of 11 animals of one geometry, with the released faults ({simulations:,} studies each)"
    )
    return Result(title, ["trials of a stimulus", "fault", "score", "reliability"], rows)


JOBS: dict[str, Callable[[int], Result]] = {
    "p-values": p_values,
    "corrections": corrections,
    "crossnobis": crossnobis,
    "recovery": recovery,
    "coverage": coverage,
    "ceiling": ceiling,
    "equivalence": equivalence,
    "faults": faults,
}


def _figure(rows: int, columns: int) -> tuple[object, list]:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(rows, columns, figsize=(4.2 * columns, 3.2 * rows), squeeze=False, layout="constrained")
    return figure, list(axes.ravel())


def _save(figure: object, name: str) -> None:
    IMAGES.mkdir(parents=True, exist_ok=True)
    figure.savefig(IMAGES / name, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", choices=[*JOBS, []])
    parser.add_argument("--simulations", type=int, default=2000)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    for name in options.names or JOBS:
        start = time.perf_counter()
        result = JOBS[name](options.simulations)
        seconds = time.perf_counter() - start
        heading = f"{result.title}; {options.simulations:,} simulations, {seconds:.0f} s."
        body = f"{heading}\n\n{table(result.columns, result.rows)}"
        print(f"\n## {name}\n\n{body}", flush=True)
        if options.write:
            write_section(
                f"Calibration: {name}",
                f"python -m benchmarks.scores.calibration {name} --write",
                body,
                subject="scores",
            )
            if result.picture:
                result.picture()


if __name__ == "__main__":
    main()
