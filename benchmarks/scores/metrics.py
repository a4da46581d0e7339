"""Speed and memory of the metrics beside rsatoolbox 0.3.2, same definitions, one run.

    python -m benchmarks.scores.metrics [--large] [--write]
    python -m benchmarks.scores.metrics --parity [--write]

``--large`` adds the RDM of 2,000 stimuli and 100,000 units; ``--parity`` compares every method and comparison with
rsatoolbox on balanced data; ``--write`` puts the tables into RESULTS.md.
"""

from __future__ import annotations

import resource
import time
import warnings
from collections.abc import Callable

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.timing import seconds
from brainbench.core.contracts import Trials
from brainbench.metrics import compare_models, noise_precision, rdm
from brainbench.metrics.measures.rsa import RSA, score_rdms
from brainbench.metrics.reliability.subject_rdm import subject_rdm

STIMULI = [f"s{k}" for k in range(6)]


def rsatoolbox_rows() -> list[list[str]]:
    """Time both libraries on the same numbers, and measure how far they differ."""
    import tqdm
    from rsatoolbox.data import Dataset
    from rsatoolbox.data.noise import prec_from_unbalanced
    from rsatoolbox.rdm import calc_rdm

    tqdm.trange = lambda n, **_: range(n)
    rng = np.random.default_rng(0)
    rows = []

    def add(what: str, theirs: Callable[[], object], ours: Callable[[], object], goal: str, difference: str) -> None:
        slow, fast = (float(np.median(seconds(job, count))) for job, count in ((theirs, 1), (ours, 15)))
        rows.append([what, f"{slow * 1e3:.3g}", f"{fast * 1e3:.3g}", f"{slow / fast:.0f}×", goal, difference])

    responses, labels = rng.normal(size=(600, 999)), np.repeat(np.arange(6), 100)
    precision = noise_precision(responses, labels)
    for count in (2, 5, 10):
        folds = np.tile(np.arange(count), 600 // count)
        data = Dataset(responses, obs_descriptors={"stimulus": labels, "fold": folds})
        for name, weight in (("", None), (", full precision given", precision)):

            def theirs_crossnobis(data: Dataset = data, weight: object = weight) -> np.ndarray:
                found = calc_rdm(data, method="crossnobis", descriptor="stimulus", cv_descriptor="fold", noise=weight)
                return found.dissimilarities[0]

            def ours_crossnobis(folds: np.ndarray = folds, weight: np.ndarray | None = weight) -> np.ndarray:
                return rdm(responses, labels, method="crossnobis", folds=folds, precision=weight)

            error = np.abs(theirs_crossnobis() - ours_crossnobis()).max()
            what = f"crossnobis, 999 units × 600 trials, {count} folds{name}"
            add(what, theirs_crossnobis, ours_crossnobis, "20×" if weight is None else "", f"{error:.0e}")
    # A full covariance needs more trials than units, whoever inverts it.
    for units, method in ((999, "diag"), (999, "shrinkage_diag"), (999, "shrinkage_eye"), (300, "full")):
        part, folds = responses[:, :units], np.tile(np.arange(5), 120)
        data = Dataset(part, obs_descriptors={"stimulus": labels, "fold": folds})

        def theirs_from_trials(data: Dataset = data, method: str = method) -> np.ndarray:
            noise = prec_from_unbalanced(data, "stimulus", method=method)
            found = calc_rdm(data, method="crossnobis", descriptor="stimulus", cv_descriptor="fold", noise=noise)
            return found.dissimilarities[0]

        def ours_from_trials(part: np.ndarray = part, folds: np.ndarray = folds, method: str = method) -> np.ndarray:
            return rdm(part, labels, method="crossnobis", folds=folds, precision=method)

        error = np.abs(theirs_from_trials() - ours_from_trials()).max()
        what = f"crossnobis with {method} noise of its trials, {units} units × 600 trials, 5 folds"
        add(what, theirs_from_trials, ours_from_trials, "20×" if units == 999 else "", f"{error:.0e}")
    data = Dataset(responses, obs_descriptors={"stimulus": labels})
    error = np.abs(prec_from_unbalanced(data, "stimulus", method="shrinkage_diag") - precision).max()
    add(
        "shrinkage precision, 999 units × 600 trials",
        lambda: prec_from_unbalanced(data, "stimulus", method="shrinkage_diag"),
        lambda: noise_precision(responses, labels),
        "",
        f"{error:.0e}",
    )
    return rows


def parity_rows() -> list[list[str]]:
    """Measure how far every RDM method and comparison is from rsatoolbox on balanced data, in 20 draws."""
    from rsatoolbox.data import Dataset
    from rsatoolbox.data.noise import prec_from_unbalanced
    from rsatoolbox.inference.noise_ceiling import boot_noise_ceiling
    from rsatoolbox.rdm import RDMs, calc_rdm
    from rsatoolbox.rdm import compare as their_compare

    from brainbench.metrics import compare, noise_ceiling

    methods = {
        "correlation": "correlation",
        "sqeuclidean": "euclidean",
        "mahalanobis": "mahalanobis",
        "crossnobis": "crossnobis",
        "poisson": "poisson",
    }
    comparisons = {
        "pearson": "corr",
        "spearman": "spearman",
        "rho-a": "rho-a",
        "tau-a": "tau-a",
        "tau-b": "kendall",
        "cosine": "cosine",
        "whitened-cosine": "cosine_cov",
        "whitened-pearson": "corr_cov",
    }
    worst: dict[str, float] = {}

    def note(what: str, theirs: object, ours: object) -> None:
        theirs, ours = np.asarray(theirs), np.asarray(ours)
        error = float((np.abs(theirs - ours) / np.maximum(1.0, np.abs(theirs))).max())
        worst[what] = max(worst.get(what, 0.0), error)

    for seed in range(20):
        rng = np.random.default_rng(seed)
        labels, folds = np.repeat(np.arange(6), 20), np.tile(np.arange(5), 24)
        trials = rng.gamma(2.0, 2.0, (6, 40))[labels] + rng.gamma(1.0, 1.0, (120, 40))
        data = Dataset(trials, obs_descriptors={"stimulus": labels, "fold": folds})
        for noise in ("shrinkage_diag", "shrinkage_eye", "diag", "full"):
            theirs = prec_from_unbalanced(data, "stimulus", method=noise)
            note(f"noise precision, {noise}", theirs, noise_precision(trials, labels, method=noise))
        precision = noise_precision(trials, labels)
        for ours, theirs in methods.items():
            given = {"noise": precision} if ours in ("mahalanobis", "crossnobis") else {}
            cross = {"cv_descriptor": "fold"} if ours == "crossnobis" else {}
            found = calc_rdm(data, method=theirs, descriptor="stimulus", **given, **cross).dissimilarities[0]
            weight = precision if given else None
            note(
                f"RDM, {ours}",
                found,
                rdm(trials, labels, method=ours, precision=weight, folds=folds if cross else None),
            )
        stack = np.stack([rdm(rng.normal(size=(6, 12))).round(2) for _ in range(7)])
        for ours, theirs in comparisons.items():
            pair = their_compare(RDMs(stack[:3]), RDMs(stack[3:]), method=theirs)
            note(f"comparison, {ours}", pair, compare(stack[:3, None], stack[3:], method=ours))
        animals = RDMs(stack, rdm_descriptors={"index": np.arange(7)})
        for ours, theirs in (("pearson", "corr"), ("cosine", "cosine"), ("rho-a", "rho-a"), ("spearman", "spearman")):
            bounds = boot_noise_ceiling(animals, method=theirs, rdm_descriptor="index")
            note(f"noise ceiling, {ours}", bounds, tuple(noise_ceiling(stack, method=ours)))
    return [[what, f"{error:.0e}"] for what, error in worst.items()]


def make_animals(count: int = 11, units: int = 91, repeats: int = 60) -> list[Trials]:
    """Sessions of the size of the Rodgers recordings: 999 units over 11 animals."""
    rng = np.random.default_rng(1)
    latent = rng.normal(size=(6, 4))
    labels = np.repeat(np.arange(6), repeats)
    blocks = []
    for animal in range(count):
        means = latent @ rng.normal(size=(4, units))
        responses = means[labels] + 4 * rng.normal(size=(len(labels), units))
        blocks.append(Trials(responses, labels, [f"{animal}/{i}" for i in range(len(labels))]))
    return blocks


class Stopwatch:
    """Wall and processor seconds of what happens inside."""

    def __enter__(self) -> Stopwatch:
        self._start = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        self.wall, self.processor = time.perf_counter() - self._start[0], time.process_time() - self._start[1]


def score_rows() -> list[list[str]]:
    """Time a whole score and sixty-four models on one brain side."""
    rng = np.random.default_rng(2)
    blocks = make_animals()
    models = {f"m{j}": {f"l{i}": rdm(rng.normal(size=(6, 12))) for i in range(12)} for j in range(64)}
    rows = []

    def add(what: str, goal: str, *parts: Stopwatch) -> None:
        rows.append([what, f"{sum(p.wall for p in parts):.2f}", f"{sum(p.processor for p in parts):.2f}", goal])

    with Stopwatch() as brain:
        subjects = [subject_rdm(f"a{i}", [block], 6) for i, block in enumerate(blocks)]
    add("brain side: 11 animals, 1,000 splits", "", brain)
    with Stopwatch() as one:
        score = score_rdms(models["m0"], subjects, name="m0", stimuli=STIMULI)
        between = RSA(comparison="pearson").score_animals(subjects, stimuli=STIMULI)
    add("one model: 12 layers, 5,040 orders at most; animal to animal, 499 orders", "", one)
    add("**full score**", "3", brain, one)
    with Stopwatch() as many:
        compare_models(models, subjects, stimuli=STIMULI)
    add("**64 models, corrected and paired, with the brain side**", "60", brain, many)
    errors = score.provenance["statistics"]["monte_carlo_error"]
    print("Monte-Carlo errors:", {key: f"{value:.2g}" for key, value in errors.items()}, between.status)
    return rows


def large_row() -> list[str]:
    """Time and measure the RDM of 2,000 stimuli and 100,000 units, float32."""
    responses = np.empty((2000, 100_000), dtype=np.float32)
    rng = np.random.default_rng(3)
    for row in responses:
        rng.standard_normal(out=row, dtype=np.float32)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with Stopwatch() as watch:
        rdm(responses)
    extra = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
    what = "RDM of 2,000 stimuli × 100,000 units, float32"
    return [what, f"{watch.wall:.1f}", f"{watch.processor:.1f}", f"{extra:.2f} GiB above the input (2)"]


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--parity", action="store_true")
    options = parser.parse_args()
    if options.parity:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            body = table(["quantity", "largest relative difference"], parity_rows())
        publish(options, "Metrics: parity with rsatoolbox", body, "--parity")
        return
    large = [large_row()] if options.large else []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        first = table(["job", "rsatoolbox ms", "ours ms", "ratio", "goal", "largest difference"], rsatoolbox_rows())
    second = table(["job", "s", "processor s", "goal"], score_rows() + large)
    body = f"{first}\n\n{second}"
    publish(options, "Metrics beside rsatoolbox", body, "--large")


if __name__ == "__main__":
    main()
