"""Boards of a recovery: animals drawn from a candidate network, and the score of every candidate against them.

Boards run on this machine or a cluster, and go on where an earlier run stopped. :func:`find_cheapest` repeats that with
growing designs until the true candidate comes first often enough.

Scores are those of the engine, :func:`brainbench.metrics.score.score_layers`, with few orders of the stimuli: the
value, chance and what is attainable need no p. Letters: A animal, C candidate, F feature, K stimulus.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations, product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, brief, check_name, check_number, listing, repeats
from brainbench.core.figures import INK, PALE, check_format, new_figure, save_figure
from brainbench.core.files import content_hash, read_json, to_plain, write_json
from brainbench.core.limits import Count, Limit, Seed, limited
from brainbench.core.progress import Progress, track
from brainbench.core.reading.values import typed_values
from brainbench.core.records import Interval, NullIsNaN, Number, Score
from brainbench.core.runs.folder import begin_run
from brainbench.core.runs.jobs import run_jobs
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, compare_scores, wilson_interval
from brainbench.datasets.synthetic.populations import PopulationDesign, ResponseGeometry, principal_axes
from brainbench.metrics.arrays import Floats, Ints, finite_mean
from brainbench.metrics.inference.multiple import adjust
from brainbench.metrics.measures.metric import Metric, get_metric
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE
from brainbench.metrics.score import score_layers
from brainbench.scoring.options import ScoreOptions

WANTED = 0.8  # share of boards that the true candidate is to win
_ROUNDING = 1e-9  # difference of scaled scores that is none


@dataclass(frozen=True)
class Recovery:
    """Boards of every candidate, counted."""

    names: tuple[str, ...]
    """[C] candidates."""
    design: RecoveryDesign
    stimuli: int
    """Stimuli of one board."""
    boards: tuple[RecoveryBoard, ...]

    @cached_property
    def firsts(self) -> Ints:
        """[C, C] boards in which the animals were drawn from one candidate (row) and another came first (column)."""
        count = np.zeros((len(self.names),) * 2, dtype=np.int64)
        for board in self.boards:
            if board.first is not None:
                count[board.true, board.first] += 1
        return count

    @cached_property
    def counts(self) -> Ints:
        """[C] boards of each candidate."""
        return np.bincount([board.true for board in self.boards], minlength=len(self.names))

    @cached_property
    def won(self) -> Floats:
        """[C, C] share of the boards of a candidate (row) in which it is told apart above another (column)."""
        return self._share(1)

    @cached_property
    def lost(self) -> Floats:
        """[C, C] share of the boards of a candidate (row) in which another (column) is told apart above it."""
        return self._share(-1)

    def _share(self, sign: int) -> Floats:
        count = np.zeros((len(self.names),) * 2)
        for board in self.boards:
            count[board.true] += np.array(board.verdicts) == sign
        return count / np.maximum(self.counts[:, None], 1)

    def wins(self, candidate: int | None = None) -> Interval:
        """Return Wilson's interval of the share of boards in which the true candidate comes first."""
        rows = slice(None) if candidate is None else candidate
        return wilson_interval(int(np.diag(self.firsts)[rows].sum()), int(self.counts[rows].sum()), over="boards")

    @property
    def win_rate(self) -> float:
        """Share of all boards in which the true candidate comes first."""
        return float(np.diag(self.firsts).sum() / len(self.boards))

    @property
    def outcomes(self) -> dict[str, float]:
        """Shares of pairs (true candidate, another): win, tie and loss by the test of a board."""
        rivals = ~np.eye(len(self.names), dtype=bool)
        win, loss = float(self.won[rivals].mean()), float(self.lost[rivals].mean())
        return {"win": win, "tie": 1 - win - loss, "loss": loss}

    @property
    def reliability(self) -> float:
        """Mean split-half reliability of the animals."""
        return float(finite_mean(np.array([board.reliability for board in self.boards])))

    def answer(self, wanted: float = WANTED) -> str:
        """Say in one sentence whether the design can tell the candidates apart.

        Yes or no where the interval of the win rate lies above or below ``wanted``. Yes also needs that as many
        of the pairs with the true network are told apart: a tied pair may stand in another order for other stimuli.
        Where two candidates have equal scores on every board no design tells them apart.
        """
        if self.alike:
            pairs = listing((f"{left!r} from {right!r}" for left, right in self.alike), quoted=False)
            return f"No design tells {pairs} by this metric: their scores are equal on every board; leave out the copy."
        interval = self.wins()
        said = f"the true network comes first in {self.win_rate:.0%} of {len(self.boards)} boards"
        said += f" [{interval.low:.0%}, {interval.high:.0%}]; by chance it would in {1 / len(self.names):.0%}"
        if interval.low >= wanted > np.mean([board.reliable for board in self.boards]):
            return f"Not by scores that count: {said}, but the animals' reliability is below {RELIABILITY_GATE:g}."
        tie = self.outcomes["tie"]
        if interval.low >= wanted and self.outcomes["win"] < wanted:
            return f"Not beyond these stimuli: {said}, but {tie:.0%} of the pairs with it tie."
        if interval.low >= wanted:
            return f"Yes, this design finds the true network: {said}."
        if interval.high < wanted:
            return f"No, not in the {wanted:.0%} of boards that are wanted: {said}."
        return f"Undecided beside the {wanted:.0%} that are wanted, more boards would tell: {said}."

    @property
    def alike(self) -> list[tuple[str, str]]:
        """Pairs of candidates whose scores are equal up to rounding on every board, such as a network and a copy."""
        scaled = np.array([board.scaled for board in self.boards])
        scaled = scaled[np.isfinite(scaled).all(axis=1)]
        pairs = combinations(range(len(self.names)), 2)
        equal = [pair for pair in pairs if len(scaled) and np.ptp(scaled[:, pair], axis=1).max() <= _ROUNDING]
        return [(self.names[left], self.names[right]) for left, right in equal]

    def hardest(self, count: int = 3) -> list[tuple[str, str, float]]:
        """Return the pairs (true, mistaken for, share of the true one's boards) that are confused most often."""
        share = self.firsts / np.maximum(self.counts[:, None], 1)
        np.fill_diagonal(share, 0)
        order = np.argsort(-share, axis=None, kind="stable")[:count]
        pairs = [np.unravel_index(place, share.shape) for place in order.tolist()]
        return [(self.names[i], self.names[j], float(share[i, j])) for i, j in pairs if share[i, j] > 0]

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for a reader, beside the numbers."""
        notes = []
        if self.design.population.animals < FEWEST_ANIMALS or self.stimuli < FEWEST_STIMULI:
            notes.append(f"All pairs tie: tests need {FEWEST_ANIMALS} animals and {FEWEST_STIMULI} stimuli.")
        if undefined := sum(not np.isfinite(board.scaled).any() for board in self.boards):
            notes.append(f"{undefined} boards have no score: their animals cannot be compared.")
        if shared := sum(board.first is None for board in self.boards) - undefined:
            notes.append(f"{shared} boards have no first: the highest score is shared.")
        return tuple(notes)


FORMATS = (".png", ".svg", ".pdf")


def plot_confusion(recovery: Recovery, path: str | os.PathLike[str]) -> Path:
    """Draw, for every true candidate (row), the share of its boards in which each candidate (column) came first.

    The suffix of the path is the format.
    """
    target = Path(path)
    check_format(target, FORMATS)
    count = len(recovery.names)
    share = recovery.firsts / np.maximum(recovery.counts[:, None], 1)
    size = 260 + 42 * count
    figure = new_figure(size + 160, size)
    figure.set_layout_engine("constrained")
    axes = figure.subplots()
    image = axes.imshow(share, cmap="BuGn", vmin=0, vmax=1)
    figure.colorbar(image, ax=axes, label="share of the boards in which it came first", shrink=0.6)
    for row, column in np.argwhere(share > 0).tolist():
        value = share[row, column]
        ink = "white" if value > 0.6 else INK
        axes.text(column, row, f"{value:.0%}", ha="center", va="center", fontsize=7, color=ink)
    axes.set_xticks(range(count), recovery.names, rotation=90, fontsize=8, color=INK)
    axes.set_yticks(range(count), recovery.names, fontsize=8, color=INK)
    axes.set_xlabel("network that came first", color=PALE)
    axes.set_ylabel("network that made the data", color=PALE)
    interval = recovery.wins()
    population = recovery.design.population
    axes.set_title(
        f"true network first in {recovery.win_rate:.0%} of {len(recovery.boards)} boards "
        f"[{interval.low:.0%}, {interval.high:.0%}]\n{recovery.stimuli} stimuli, {population.animals} animals of "
        f"{population.units} units",
        fontsize=9,
        color=INK,
    )
    axes.tick_params(length=0)
    for side in axes.spines.values():
        side.set_visible(False)
    return save_figure(figure, target, dpi=150)


SMALLEST_RDM = 4  # fewest stimuli whose RDMs can be compared after one is left out


@limited(of="{} of a recovery")
class RecoveryDesign:
    """An experiment that is repeated on the computer with every candidate in turn as the truth."""

    population: PopulationDesign = field(default_factory=PopulationDesign)
    """Animals, units, trials and noise."""
    stimuli: Annotated[int, Limit(least=SMALLEST_RDM)] | None = None
    """Stimuli of one board, drawn anew for each from those that the candidates saw; all of them by default."""
    metric: str = "rsa"
    """Metric of the scores."""
    layer: str = "any"
    """Layer whose units the animals mix: any (drawn anew for each board), last, or the name of one."""
    splits: Count = 100
    """Split halves that tell the reliability of an animal's RDM."""
    orders: Annotated[int, Limit(least=40)] = 50
    """Random orders of the stimuli that tell the score expected by chance; the observed score counts among them, so
    with fewer than about 40 it looks like chance."""
    seed: Seed = 0
    """Seed of the animals."""


def parse_trials(text: str) -> int | tuple[int, int]:
    """Return the trials of a stimulus: ``18``, or the fewest and the most as in ``16-20``.

    >>> parse_trials("16-20")
    (16, 20)
    """
    match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", text)
    first, last = (int(part or 0) for part in match.groups()) if match else (0, 0)
    if first < 1 or (match and match[2] and last < first):
        raise UsageError(f"Trials are a number above 0 or a range such as 16-20; received {brief(text)}.")
    return (first, last) if last else first


@dataclass(frozen=True)
class Candidate:
    """A network that may have made the data."""

    name: str
    stimuli: tuple[str, ...]
    """[K] names."""
    features: Mapping[str, NDArray[np.float64]]
    """Layer → [K, F]; without layers that are the same for all stimuli or not finite."""
    weights: str | None = None
    """Content hash of its weights."""

    @classmethod
    def of(
        cls, name: str, stimuli: Sequence[str], layers: Mapping[str, ArrayLike], weights: str | None = None
    ) -> Candidate:
        """Take the layers that can be compared."""
        usable = {}
        for layer, values in layers.items():
            array = np.asarray(values, dtype=np.float64)
            if array.ndim != 2 or len(array) != len(stimuli):
                raise UsageError(f"Layer {layer!r} of {name} is {list(array.shape)}; expected [{len(stimuli)}, F].")
            if np.isfinite(array).all() and np.ptp(array, axis=0).any():
                usable[str(layer)] = array
        if not usable:
            raise UsageError(f"No layer of {name} differs between the stimuli, so nothing can be drawn from it.")
        return cls(name, tuple(stimuli), usable, weights)

    def choose(self, layer: str, random: np.random.Generator) -> str:
        """Return the layer that ``any``, ``last`` or a name means."""
        names = list(self.features)
        check_name(f"layer of {self.name}", layer, ["any", "last", *names])
        if layer in names:
            return layer
        return names[-1] if layer == "last" else names[int(random.integers(len(names)))]

    def geometry(self, layer: str, rows: NDArray[np.int64]) -> ResponseGeometry:
        """Return the Euclidean geometry of a layer for some stimuli.

        Features are mixed as they are, not standardised, so that the truth is the layer's own RDM of squared
        Euclidean distances.
        """
        directions = self._axes[layer][rows]
        directions = directions - directions.mean(axis=0)
        size = np.sqrt((directions**2).sum() / len(rows))
        return ResponseGeometry(directions / (size or 1.0), tuple(self.stimuli[row] for row in rows))

    def layers(self, metric: Metric) -> dict[str, NDArray[np.float64]]:
        """Return what a metric compares of every layer, such as an RDM [P], computed once."""
        key = (metric.name, str(metric))
        if key not in self._layers:
            self._layers[key] = {name: metric.layer(values) for name, values in self.features.items()}
        return self._layers[key]

    @cached_property
    def _layers(self) -> dict[tuple[str, str], dict[str, NDArray[np.float64]]]:
        return {}

    @cached_property
    def _axes(self) -> dict[str, NDArray[np.float64]]:
        """Layer → [K, ≤ K] stimuli on the principal axes of its features: the same distances in fewer columns."""
        return {layer: principal_axes(values - values.mean(axis=0)) for layer, values in self.features.items()}

    @property
    def identity(self) -> str:
        """Content hash of its name, stimuli and features."""
        parts = [part for layer, values in self.features.items() for part in (layer, values)]
        return content_hash(self.name, list(self.stimuli), *parts)


def open_candidates(
    models: Sequence[Any], options: ScoreOptions, *, progress: Progress | None = None
) -> tuple[tuple[Candidate, ...], dict[str, Any]]:
    """Run the models on the stimuli of ``options``; return them as candidates, and the provenance of the stimuli."""
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.stimuli import load_stimuli

    check_number("number of candidates, which a recovery tells apart,", len(models), least=2)
    # Whatever can be wrong with a name is found before stimuli are simulated.
    resolved = [resolve_model(model, seed=options.model_seed) for model in models]
    names = [item.card.name for item in resolved]
    if twice := repeats(names):
        raise UsageError(f"The candidate {twice[0]!r} is given twice; candidates have different names.")
    if any(item.labels is None for item in resolved):
        how = {"whiskers": options.whiskers, "fidelity": options.fidelity}
        simulated = load_stimuli(options.stimuli or "objects", **how, progress=progress)
        options, stimuli = replace(options, stimuli=simulated, whiskers="all"), simulated.labels
    else:  # activations from files alone, whose labels name the stimuli
        stimuli = next(item.labels for item in resolved if item.labels)
    candidates, origin = [], {}
    for network in track(resolved, "running networks", progress):
        responses = network.respond(options)
        lacking = [label for label in stimuli if label not in responses.labels]
        if lacking:
            raise UsageError(f"{network.card.name} has no activations for the stimulus {lacking[0]!r}.")
        rows = [responses.labels.index(label) for label in stimuli]
        candidates.append(Candidate.of(network.card.name, stimuli, responses.features(rows), responses.card.weights))
        origin = dict(responses.origin.get("stimuli") or origin)
    return tuple(candidates), origin


LEVEL = 0.05  # false discovery rate over all pairs of a board


@dataclass(frozen=True)
class RecoveryBoard(NullIsNaN):
    """Result of one board that a recovery keeps."""

    true: int
    """Candidate from which the animals were drawn."""
    number: int
    layer: str
    """Layer whose units they mix."""
    scaled: tuple[Number, ...]
    """[C] scores between chance (0) and all that is reliable (1)."""
    verdicts: tuple[int, ...]
    """[C] 1 where the true candidate is told apart above this one, −1 below, 0 where they tie."""
    reliability: Number
    """Mean split-half reliability of the animals."""

    @property
    def reliable(self) -> bool:
        """False where scores are unreliable, which no leaderboard ranks."""
        return not self.reliability < RELIABILITY_GATE

    @property
    def first(self) -> int | None:
        """Candidate with the highest score; None where no score is defined or the highest is shared."""
        values = np.array(self.scaled)
        if not np.isfinite(values).any():
            return None
        # Networks with equal RDMs differ by rounding, which is no lead.
        best = np.flatnonzero(values >= np.nanmax(values) - _ROUNDING)
        return int(best[0]) if len(best) == 1 else None


def make_board(candidates: Sequence[Candidate], design: RecoveryDesign, true: int, number: int) -> RecoveryBoard:
    """Draw the animals of a board from candidate ``true`` and score all candidates, by the arguments alone."""
    layer, rows, animals = draw_board(candidates, design, true, number)
    scores = score_board(candidates, rows, animals, design)
    scaled, verdicts = tuple(score.scaled for score in scores), tuple(told_apart(scores)[true].tolist())
    return RecoveryBoard(true, number, layer, scaled, verdicts, scores[true].reliability)


def draw_board(
    candidates: Sequence[Candidate], design: RecoveryDesign, true: int, number: int
) -> tuple[str, Ints, tuple[Any, ...]]:
    """Return the true layer, the stimuli [K] that are shown, and the animals as the metric prepares them."""
    from brainbench.datasets.synthetic.populations import draw_animals

    stream = (design.seed, true, number)
    random = np.random.default_rng(stream)
    pool = len(candidates[true].stimuli)
    count = design.stimuli or pool
    rows = np.sort(random.permutation(pool)[:count]) if count < pool else np.arange(pool)
    layer = candidates[true].choose(design.layer, random)
    metric, animals = get_metric(design.metric), []
    for subject, sessions in draw_animals(candidates[true].geometry(layer, rows), design.population, stream).items():
        trials = [replace(item, responses=item.responses[:, 0]) for item in sessions]
        animals.append(metric.animal(subject, trials, count, seed=design.seed, splits=design.splits))
    return layer, rows, tuple(animals)


def score_board(
    candidates: Sequence[Candidate], rows: Ints, animals: Sequence[Any], design: RecoveryDesign
) -> list[Score]:
    """Return the score of every candidate against prepared animals, over the stimuli ``rows`` [K]."""
    metric = copy.copy(get_metric(design.metric))
    # Metrics may be frozen; the copy is ours.
    object.__setattr__(metric, "orders", design.orders)
    scores = []
    for candidate in candidates:
        layers = {name: metric.take(layer, rows) for name, layer in candidate.layers(metric).items()}
        labels = [candidate.stimuli[row] for row in rows]
        scores.append(score_layers(metric, layers, animals, name=candidate.name, stimuli=labels, seed=design.seed)[0])
    return scores


def told_apart(scores: Sequence[Score]) -> Ints:
    """Return [C, C]: 1 where a candidate is told apart above another, −1 below, 0 where they tie.

    By the test of a board (:func:`brainbench.core.statistics.compare_scores`: differences of scaled scores
    over animals and stimuli), false discovery rate 5 % over all pairs.
    """
    result = np.zeros((len(scores), len(scores)), dtype=np.int64)
    places = list(combinations(range(len(scores)), 2))
    tests = [compare_scores(scores[first], scores[second]) for first, second in places]
    for (first, second), test, p in zip(places, tests, adjust([test.p for test in tests], "fdr"), strict=True):
        if p <= LEVEL:
            result[first, second] = 1 if test.difference > 0 else -1
            result[second, first] = -result[first, second]
    return result


BOARDS = 10
_TOGETHER = 5  # boards that one job makes and one file keeps


@dataclass(frozen=True)
class _Job:
    """Some boards of one true candidate."""

    true: int
    numbers: tuple[int, ...]

    @property
    def file(self) -> str:
        """Name of the file of its boards in the folder of a study."""
        return f"boards-{self.true:03d}-{self.numbers[0]:05d}.json"


def recover(
    candidates: Sequence[Candidate],
    design: RecoveryDesign | None = None,
    *,
    boards: int = BOARDS,
    first: int = 0,
    folder: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Recovery:
    """Draw boards from every candidate and count how often the true one wins.

    Neither ``workers`` nor the scheduler changes a number. With a folder, a run that was killed goes on when it is
    started again. ``first`` is the number of the first board: boards of other numbers have other animals. A folder
    keeps finished boards; ``scheduler`` is the address of a Dask scheduler, whose workers make the boards instead of
    processes here.
    """
    design = design or RecoveryDesign()
    check_candidates(candidates, design, boards)
    check_number("The number of the first board", first, least=0, whole=True)
    jobs = [
        _Job(true, tuple(range(start, min(start + _TOGETHER, first + boards))))
        for start in range(first, first + boards, _TOGETHER)
        for true in range(len(candidates))
    ]
    results: dict[_Job, list[RecoveryBoard]] = {}
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        config = {"candidates": [item.identity for item in candidates], "design": design}
        begin_run(folder, config, "recovery", results="boards-*.json")
        for job in jobs:
            if (folder / job.file).is_file():
                stated = read_json(folder / job.file, "part of a recovery")
                name = repr(str(folder / job.file))
                stored = typed_values(list[RecoveryBoard], stated, name, advice=" Delete it to make it again.")
                if [item.number for item in stored] == list(job.numbers):
                    results[job] = stored
    missing = [job for job in jobs if job not in results]
    total = done = sum(len(job.numbers) for job in jobs)
    done -= sum(len(job.numbers) for job in missing)
    work = partial(_make_boards, tuple(candidates), design)
    for place, finished in run_jobs(work, missing, workers=workers, scheduler=scheduler):
        job = missing[place]
        results[job] = finished
        done += len(finished)
        if folder is not None:
            write_json(folder / job.file, to_plain(finished))
        if progress is not None:
            progress(done, total, "scoring boards")
    every = sorted((board for job in jobs for board in results[job]), key=lambda board: (board.true, board.number))
    count = design.stimuli or len(candidates[0].stimuli)
    return Recovery(tuple(item.name for item in candidates), design, count, tuple(every))


def _make_boards(candidates: tuple[Candidate, ...], design: RecoveryDesign, job: _Job) -> list[RecoveryBoard]:
    return [make_board(candidates, design, job.true, number) for number in job.numbers]


def check_candidates(candidates: Sequence[Candidate], design: RecoveryDesign, boards: int) -> None:
    """Raise UsageError for what cannot be run, before any work."""
    check_number("number of candidates, which a recovery tells apart,", len(candidates), least=2)
    check_number("The number of boards", boards, least=1, whole=True)
    pool = len(candidates[0].stimuli)
    if any(item.stimuli != candidates[0].stimuli for item in candidates):
        raise UsageError("The candidates saw different stimuli; run all of them on the same ones in the same order.")
    if design.stimuli is not None and design.stimuli > pool:
        raise UsageError(f"A board of {design.stimuli} stimuli was asked for; the pool has {pool}.")
    if get_metric(design.metric).of_model_alone:
        raise UsageError(
            f"The metric {design.metric!r} scores a model without looking at the animals, so it cannot tell who made "
            "their data; choose another, such as 'rsa'."
        )
    if design.layer not in ("any", "last"):
        for candidate in candidates:
            candidate.choose(design.layer, np.random.default_rng(0))


ANIMALS = (2, 4, 6, 10, 16)
UNITS = (20, 60, 120)
TRIALS = (5, 10, 20)
STIMULI = (6, 10, 20, 40, 80)
"""Numbers that are tried, as far as the pool allows."""


@dataclass(frozen=True)
class TriedDesign:
    """One design of the search."""

    animals: int
    units: int
    trials: int
    """Trials of each stimulus."""
    stimuli: int
    win_rate: float
    """Share of boards in which the true candidate came first, by scores that are reliable."""
    interval: Interval
    """Wilson's interval of ``win_rate``."""


def find_cheapest(
    candidates: Sequence[Candidate],
    design: RecoveryDesign,
    wanted: float,
    *,
    boards: int = 5,
    progress: Progress | None = None,
    **where: Any,
) -> tuple[TriedDesign | None, tuple[TriedDesign, ...]]:
    """Try designs from the cheapest on, and return the first that reaches a win rate, with all that were tried.

    Cost is the number of trials of all animals, then the number of units. A design with no more of anything than one
    that failed clearly (interval below ``wanted``) is not tried. The one returned reaches the rate on boards of other
    numbers too. The design's numbers of animals, units, trials and stimuli are replaced; ``where`` are ``workers`` and
    ``scheduler`` of :func:`recover`.
    """
    check_number("The wanted rate", wanted, above=0, below=1)
    pool = len(candidates[0].stimuli)
    sizes = [size for size in STIMULI if size < pool] + [pool]
    # By trials of all animals together, then units, then animals.
    grid = sorted(product(ANIMALS, UNITS, TRIALS, sizes), key=lambda of: (of[0] * of[2] * of[3], of[1], of[0]))
    tried: list[TriedDesign] = []
    failed: list[tuple[int, ...]] = []

    def measured(animals: int, units: int, trials: int, stimuli: int, **counted: int) -> TriedDesign:
        """Return what boards of a design recover."""
        population = replace(design.population, animals=animals, units=units, trials=trials)
        changed = replace(design, population=population, stimuli=stimuli)
        results = recover(candidates, changed, **counted, **where).boards
        won = sum(board.reliable and board.first == board.true for board in results)
        interval = wilson_interval(won, len(results), over="boards")
        return TriedDesign(animals, units, trials, stimuli, won / len(results), interval)

    for numbers in track(grid, "trying designs", progress):
        if any(all(mine <= other for mine, other in zip(numbers, one, strict=True)) for one in failed):
            continue
        attempt = measured(*numbers, boards=boards, first=0)
        tried.append(attempt)
        if attempt.interval.high < wanted:
            failed.append(numbers)
        elif attempt.win_rate >= wanted:
            # The first to reach a rate by luck would be returned too often: it must do so again.
            again = measured(*numbers, boards=2 * boards, first=boards)
            tried[-1] = again
            if again.win_rate >= wanted:
                return again, tuple(tried)
    return None, tuple(tried)
