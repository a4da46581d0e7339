"""The animals behind a score, the layers of a model against them, the choice of layer, and the permutation test.

The best of many layers looks good by luck alone: with six stimuli the largest of 40 unrelated comparisons is expected
near .56. So the layer for an animal is the one that compares best with the *other* animals, unless one was committed to
beforehand. Comparisons are not divided by reliability before they vote, which would give the noisiest animals the
loudest vote. Ties go to the first layer.

Layers compete on a common scale (:class:`CommonScale`). Raw values would not do: a layer of many unrelated features has
nearly equal distances, which by themselves have a cosine of .4 and more with those of any animal, and would win against
layers that know something.

Other animals saw the same few stimuli, so what they share by luck is not held out: ten layers that know nothing score
.41 on average against animals of one geometry and six stimuli. The permutation p-value does account for it, because the
rules here broadcast over leading axes and a test repeats the whole choice inside every permutation; the mean score
under permutation is a score's ``chance``. A layer that has no value for some stimuli is compared over the rest, in
every order alike, but chosen only where no layer has a value for more: over fewer stimuli it reaches more by luck,
which every layer would have to beat.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np

from brainbench.core.errors import UsageError, check_name, repeats
from brainbench.core.records import Ceiling, Interval
from brainbench.core.statistics import t_interval
from brainbench.metrics.arrays import Floats, Ints, finite_mean
from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.inference import permutation
from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE, Corrected, noise_ceiling
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat


@dataclass(frozen=True)
class Animals:
    """Subjects in the order of their names, and the indices of those that can be used."""

    subjects: tuple[SubjectRDM, ...]
    corrections: tuple[Corrected, ...]
    """Correction of a raw comparison of 1: the factor for each subject."""
    usable: tuple[int, ...]
    """Subjects with a factor."""
    scored: tuple[int, ...]
    """Subjects that the score averages: the reliable ones, else (unreliable score) all usable ones."""
    reliable: bool
    reasons: tuple[str, ...]

    def rdms(self, index: Sequence[int]) -> Floats:
        """Return RDMs [len(index), P]."""
        return np.stack([self.subjects[i].rdm for i in index])

    def factors(self, index: Sequence[int]) -> Floats:
        """Return correction factors [len(index)]."""
        return np.array([self.corrections[i].value for i in index])

    @cached_property
    def order(self) -> Ints:
        """An order of the stimuli [K] that depends on the scored animals alone, not on how stimuli were listed."""
        return permutation.canonical_order(self.rdms(self.scored))

    @cached_property
    def sorted(self) -> tuple[SubjectRDM, ...]:
        """The scored subjects, their stimuli in :attr:`order`."""
        return tuple(self.subjects[i].take(self.order) for i in self.scored)


def gather(metric: MetricHooks, subjects: Sequence[SubjectRDM], stimuli: int, *, estimator: str = "default") -> Animals:
    """Sort subjects by name, correct each for noise as the metric does and decide who is scored."""
    check_name(f"estimator of the metric {metric.name!r}", estimator, metric.estimators)
    if not subjects:
        raise UsageError("There are no animals to score against; give at least one SubjectRDM.")
    ordered = tuple(sorted(subjects, key=lambda subject: subject.subject))
    names = [subject.subject for subject in ordered]
    if twice := repeats(names):
        raise UsageError(f"Subject {twice[0]!r} appears twice; join the sessions of an animal in one SubjectRDM.")
    for subject in ordered:
        if subject.count != stimuli:
            raise UsageError(f"{subject.subject!r} has an RDM of {subject.count} stimuli; {stimuli} are scored.")
    corrections = tuple(_correction(metric, subject, estimator) for subject in ordered)
    usable = tuple(i for i, found in enumerate(corrections) if found.status != "undefined")
    good = tuple(i for i in usable if corrections[i].status == "ok")
    # The published estimators knew no gate: they average whatever has a value.
    scored = good if good and estimator == "default" else usable
    # Whoever is not averaged is named, so no animal disappears in silence.
    reasons = [f"animal {names[i]} left out: {corrections[i].reason}" for i in range(len(ordered)) if i not in scored]
    # The study is gated, not the animal: see ``ANIMAL_GATE``.
    if estimator == "default" and good:
        # The mean of those that pass is too high where most do not: the median of all counts as well.
        every = np.array([each.reliability for each in corrections])
        measured = [subject.problem is None for subject in ordered]
        reliability = min(float(every[list(good)].mean()), float(np.median(np.nan_to_num(every[measured]))))
        if not reliability >= RELIABILITY_GATE:
            why = f"the animals' reliability, {reliability:.2f}, is below {RELIABILITY_GATE}: no correction holds"
            corrections = tuple(
                replace(each, status="unreliable", reason=why) if i in good else each
                for i, each in enumerate(corrections)
            )
    reliable = bool(scored) and all(corrections[i].status == "ok" for i in scored)
    if scored and not reliable:
        single = [f"{names[i]}: {corrections[i].reason}" for i in scored if corrections[i].status != "ok"]
        reasons += [corrections[scored[0]].reason] if good and estimator == "default" else single
    reasons += [f"{ordered[i].subject}: {note}" for i in usable for note in ordered[i].notes]
    return Animals(ordered, corrections, usable, scored, reliable, tuple(reasons))


def _correction(metric: MetricHooks, subject: SubjectRDM, estimator: str) -> Corrected:
    if subject.problem is not None:
        return Corrected(math.nan, "undefined", subject.problem)
    if is_flat(subject.rdm):
        return Corrected(math.nan, "undefined", "its RDM has missing pairs or no differences between pairs")
    return metric.correction(subject, estimator)


def mean_reliability(animals: Animals) -> tuple[float, Interval | None]:
    """Return the mean reliability over the scored animals with its interval; of one animal it has none."""
    values = np.array([animals.corrections[i].reliability for i in animals.scored])
    if not values.size:
        return math.nan, None
    return float(values.mean()), t_interval(values, over="animals")


def ceiling_of(animals: Animals, comparison: str) -> Ceiling | None:
    """Return the raw noise ceiling of the scored animals, or None for fewer than two."""
    if len(animals.scored) < 2:
        return None
    bounds = noise_ceiling(animals.rdms(animals.scored), method=comparison)
    return None if bounds.reason else Ceiling(bounds.lower, bounds.upper)


def mean_rdm(animals: Animals) -> tuple[float, ...]:
    """Return the mean RDM of the scored animals [P]; empty without any."""
    return recorded_rdm(animals.rdms(animals.scored).mean(axis=0)) if animals.scored else ()


def recorded_rdm(values: Floats) -> tuple[float, ...]:
    """Return an RDM [P] as records hold it, to show and to compare: seven digits, half the size of all."""
    return tuple(map(float, (len(values) * "%.7g " % tuple(values.tolist())).split()))


_TIE = 1e-12

Kind = Literal["fixed", "others", "halves", "maximum", "each"]


@dataclass(frozen=True)
class LayerRule:
    """Choice of the layer for each animal among comparisons [..., L, A]."""

    kind: Kind
    words: str
    """The rule, as a record states it."""
    fixed: int = 0
    """The layer, where it is given."""
    factors: Floats | None = None
    """[A] weights of the animals, where the maximum of the corrected mean is taken."""
    competing: Ints | None = None
    """Layers among which is chosen: those that have a value for the same stimuli. None for all."""

    def choose(self, r: Floats) -> Ints:
        """Return the layer [..., A] for each animal."""
        if self.competing is not None and self.kind in ("others", "halves", "maximum"):
            return self.competing[replace(self, competing=None).choose(r[..., self.competing, :])]
        if self.kind == "others":
            return choose_on_others(r)
        if self.kind == "halves":
            # Animals are the halves of one animal's splits: each is scored by the layer best on its other half.
            pairs = r.reshape(*r.shape[:-1], -1, 2)[..., ::-1]
            return first_best(pairs.reshape(r.shape))
        shape = (*r.shape[:-2], r.shape[-1])
        if self.kind == "each":
            return np.broadcast_to(np.arange(r.shape[-1]), shape)
        if self.kind == "maximum":
            weighted = r if self.factors is None else r * self.factors
            return np.broadcast_to(first_best(weighted.mean(axis=-1)[..., None]), shape)
        return np.full(shape, self.fixed)

    def held(self, r: Floats) -> Floats:
        """Return the comparison [..., A] of each animal with the layer chosen for it."""
        return r[..., self.fixed, :] if self.kind == "fixed" else take_layers(r, self.choose(r))


def layer_rule(
    names: list[str], animals: int, *, committed: str | None = None, estimator: str = "default", factors: Floats
) -> LayerRule:
    """Return the rule for layers ``names`` [L] and a number of animals (a single one whose halves are not known)."""
    if committed is not None:
        return LayerRule("fixed", "committed to beforehand", names.index(committed))
    if len(names) == 1:
        return LayerRule("fixed", "only layer")
    if estimator != "default":
        # The published rule; the test takes the same maximum, so its p stays honest where the value is not.
        words = "maximum over layers on the data that are scored (as published; optimistic)"
        return LayerRule("maximum", words, factors=factors)
    if animals == 1:
        words = "maximum over layers on the only animal (optimistic; the permutation takes the same maximum)"
        return LayerRule("maximum", words)
    return LayerRule("others", "chosen on the other animals, evaluated on the animal held out")


EACH = LayerRule("each", "every animal has a layer of its own")
HALVES = LayerRule("halves", "chosen on one half of the only animal's trials, evaluated on the other half")


def choose_on_others(r: Floats) -> Ints:
    """Return the layer [..., A] that compares best with all animals but each.

    From raw comparisons [..., L, A], A ≥ 2.
    """
    # All leave-one-out means from one sum over animals.
    others = (r.sum(axis=-1, keepdims=True) - r) / (r.shape[-1] - 1)
    return first_best(others)


def held_out(r: Floats) -> Floats:
    """Return the comparison [..., A] of each animal with the layer chosen on the others, from r [..., L, A]."""
    return take_layers(r, choose_on_others(r))


def most_chosen(chosen: Ints) -> int:
    """Return the layer chosen most often; the first among equals."""
    return int(np.argmax(np.bincount(np.ravel(chosen))))


def first_best(values: Floats) -> Ints:
    """Return the first index [..., A] of the layers [..., L, A] whose value equals the largest up to rounding."""
    # A tolerance for ties: layers with equal RDMs differ by rounding, and the first of them is to win on every machine.
    return np.argmax(values >= values.max(axis=-2, keepdims=True) - _TIE, axis=-2)


def take_layers(values: Floats, index: Ints) -> Floats:
    """Return the values [..., A] of one layer for each animal, from [..., L, A] and layers [A] or [..., A]."""
    index = np.broadcast_to(index, (*values.shape[:-2], values.shape[-1]))
    return np.take_along_axis(values, index[..., None, :], axis=-2)[..., 0, :]


Orders = Callable[[], Iterable[Ints]]  # gives chunks of orders of the stimuli [N, K], the same at every call


@dataclass(frozen=True)
class LayerComparisons:
    """Verdict of a metric on the layers of one model and a number of animals."""

    metric: MetricHooks
    layers: Sequence[Floats] = field(repr=False)
    """[L] what :meth:`Metric.layer` made of each."""
    animals: Sequence[SubjectRDM] = field(repr=False)
    """[A]"""
    device: Any = None

    @cached_property
    def defined(self) -> np.ndarray:
        """[L, K] where a layer has a value for a stimulus."""
        return np.stack([self.metric.defined(layer) for layer in self.layers])

    def among(self, rows: Iterable[int], animals: Sequence[SubjectRDM]) -> LayerComparisons:
        """Return the comparisons of the layers in some rows with some animals."""
        return LayerComparisons(self.metric, [self.layers[row] for row in rows], animals, self.device)

    def given(self) -> Floats:
        """Return comparisons [L, A] of the stimuli as they are."""
        return next(self.under(lambda: [np.arange(self.defined.shape[1])[None]]))[0]

    def under(self, orders: Orders) -> Iterator[Floats]:
        """Yield comparisons [N, L, A] with the model's stimuli in each order of a chunk [N, K]."""
        if self.defined.all():
            yield from self.metric.compare_layers(self.layers, self.animals, orders(), self.device)
            return
        patterns, group = np.unique(self.defined, axis=0, return_inverse=True)
        streams = [
            self._some(np.flatnonzero(group.ravel() == index), np.flatnonzero(present), orders)
            for index, present in enumerate(patterns)
        ]
        for parts in zip(*streams, strict=True):
            values = np.empty((len(parts[0]), len(self.layers), len(self.animals)))
            for index, part in enumerate(parts):
                values[:, group.ravel() == index] = part
            yield values

    def _some(self, layers: Ints, stimuli: Ints, orders: Orders) -> Iterator[Floats]:
        """Yield comparisons of some layers over the stimuli that they have."""
        count = self.defined.shape[1]
        place = np.full(count, -1)
        place[stimuli] = np.arange(len(stimuli))
        # A random order of all stimuli is a random order of those that are left, when the others are passed over.
        shorter = (place[chunk][place[chunk] >= 0].reshape(len(chunk), -1) for chunk in orders())
        reps = [self.metric.take(self.layers[layer], stimuli) for layer in layers]
        yield from self.metric.compare_layers(reps, [one.take(stimuli) for one in self.animals], shorter, self.device)

    def without_each(self) -> Floats:
        """Return comparisons [K, L, A] without each stimulus in turn."""
        if self.defined.all():
            return self.metric.compare_without(self.layers, self.animals)
        values = np.repeat(self.given()[None], self.defined.shape[1], axis=0)
        for layer, stimuli in enumerate(map(np.flatnonzero, self.defined)):
            part = [self.metric.take(self.layers[layer], stimuli)], [one.take(stimuli) for one in self.animals]
            values[stimuli, layer] = self.metric.compare_without(*part)[:, 0]
        return values


@dataclass(frozen=True)
class CommonScale:
    """What chance and a perfect model reach by each layer: brings comparisons to the scale of one of them."""

    chance: Floats
    """[L] mean over orders of the stimuli."""
    span: Floats
    """[L] what a perfect model reaches above chance; infinite where it does not."""
    layer: int = 0
    """The layer whose comparisons stay as they are."""

    def __call__(self, r: Floats, rows: Any = slice(None)) -> Floats:
        """Return raw comparisons [..., L, A] of all layers, or of some, on the scale."""
        factor = self.span[self.layer] / self.span[rows, None]
        return r * factor + (self.chance[self.layer] - factor * self.chance[rows, None])


_CHUNK_ELEMENTS = 1 << 22
_KEPT_ELEMENTS = 1 << 23  # comparisons under permutation that are kept; more are computed again
_HALVES_IN_PERMUTATIONS = 100  # splits of a single animal that every permutation repeats; more only cost time


@dataclass(frozen=True)
class LayerEvaluation:
    """A score's parts. L counts the layers that have a value."""

    rule: LayerRule
    values: Floats
    """[A] corrected."""
    r: Floats
    """[A] raw comparisons."""
    chosen: Ints
    """[A] layers."""
    layer_values: Floats
    """[L, A] corrected comparisons of every layer."""
    layer_r: Floats
    without: Floats
    """[K] the score without each stimulus."""
    test: permutation.PermutationTest
    layer_null: Floats
    """[N, L] mean of every layer under the orders of the stimuli; empty without a test."""
    competing: Ints
    """Layers among which was chosen."""
    scale: CommonScale
    attainable: float
    """Value of a perfect model."""
    attainable_error: float
    """Standard error that the number of its draws leaves."""


def defined_layers(metric: MetricHooks, layers: Mapping[str, Floats]) -> list[str]:
    """Return the layers with a value for enough stimuli: at least half of them, and as many as the metric needs."""
    names = []
    for label, layer in layers.items():
        defined = metric.defined(layer)
        enough = defined.sum() >= max(metric.fewest, len(defined) / 2)
        if enough and metric.varies(metric.take(layer, np.flatnonzero(defined))):
            names.append(label)
    return names


def evaluate(
    every: LayerComparisons,
    names: list[str],
    animals: Animals,
    estimator: str,
    committed: str | None,
    seed: int,
    *,
    each: bool = False,
) -> tuple[LayerEvaluation | None, list[str], tuple[str, ...]]:
    """Compare, choose layers by the rule and test; also return the layers with a value, and notes."""
    metric, factors = every.metric, animals.factors(animals.scored)
    r = every.given()
    rows = np.flatnonzero(np.isfinite(r).all(axis=1)).tolist()
    names, r = [names[row] for row in rows], r[rows]
    if not names or (committed is not None and committed not in names) or (each and len(names) < len(every.animals)):
        return None, names, ()
    compared = every.among(rows, every.animals)
    voters = 1 if metric.of_model_alone else len(factors)
    rule = EACH if each else layer_rule(names, voters, committed=committed, estimator=estimator, factors=factors)
    votes = _Votes(rule, compared, r, compared, factors)
    if rule.kind == "maximum" and estimator == "default" and len(factors) == 1:
        halves = metric.halves(animals.subjects[animals.scored[0]], animals.order)
        if halves is not None:
            parts, factor = halves
            if not parts:
                return None, names, ()
            votes = _Votes.of_halves(compared, parts, factor)
    null, weights, counts = votes.null(seed), votes.weights, compared.defined.sum(axis=1)
    some = weights[: len(votes.permuted.animals)]
    (ceilings, errors), competing = _ceilings(compared, animals, seed), np.flatnonzero(counts == counts.max())
    scale = CommonScale(np.zeros(len(names)), np.ones(len(names)))
    if estimator == "default" and len(names) > 1 and not each:
        chance = finite_mean(np.concatenate([(r * some).mean(axis=-1) for r in null()]), axis=0) / some.mean()
        span = ceilings / weights.mean() - chance
        able = competing[span[competing] > 0]
        # Where a perfect model is no better than chance, there is no scale.
        if len(able) and (rule.kind != "fixed" or span[rule.fixed] > 0):
            scale, competing = CommonScale(chance, np.where(span > 0, span, np.inf), able[0]), able
    rule = replace(votes.rule, competing=competing)
    chosen = rule.choose(scale(votes.r))
    scale = replace(scale, layer=most_chosen(chosen))
    chosen_r, values = take_layers(votes.r, chosen), take_layers(scale(votes.r), chosen) * weights
    # The layers of the data serve without a stimulus too, unless a metric repeats the choice: where it jumps between
    # layers that are nearly alike, a jackknife that repeats it measures the jumps instead of the stimuli.
    single = rule.kind == "halves" or estimator != "default"
    factors_without = weights if single else metric.factors_without(votes.compared.animals, weights)
    anew = metric.chooses_anew and rule.kind in ("others", "maximum")
    ever, place = np.unique(competing if anew else chosen, return_inverse=True)
    jackknife = scale(votes.compared.among(ever, votes.compared.animals).without_each(), ever)
    if anew:
        place = replace(rule, competing=None).choose(jackknife)
    without = (take_layers(jackknife, place) * factors_without).mean(axis=-1)
    test, layer_null = _test(null, votes.permuted, scale, rule, some)
    # The halves of an animal are noisier than the animal.
    whole = replace(scale, chance=scale.chance * weights.mean() / factors.mean())
    if rule.kind == "halves":
        values, chosen_r = values.mean(keepdims=True), chosen_r.mean(keepdims=True)
        chosen = np.array([most_chosen(chosen)])
    parts = values, chosen_r, chosen, whole(r) * factors, r, without, test, layer_null, competing, whole
    attained = float(ceilings[scale.layer]), float(errors[scale.layer])
    return LayerEvaluation(rule, *parts, *attained), names, _partly(compared, names)


@dataclass(frozen=True)
class _Votes:
    """What chooses the layers and gives the score: the animals, or the halves of a single one."""

    rule: LayerRule
    compared: LayerComparisons
    r: Floats  # [L, A] its comparisons of the stimuli as they are
    permuted: LayerComparisons  # the part that every permutation repeats
    weights: Floats  # [A] factors of the comparisons

    @classmethod
    def of_halves(cls, compared: LayerComparisons, halves: Sequence[SubjectRDM], factor: float) -> _Votes:
        """Let the halves of an animal's splits stand for animals; fewer of them serve the permutations."""
        parts = replace(compared, animals=halves)
        some = replace(compared, animals=halves[: 2 * _HALVES_IN_PERMUTATIONS])
        return cls(HALVES, parts, parts.given(), some, np.full(len(halves), factor))

    def null(self, seed: int) -> Callable[[], Iterable[Floats]]:
        """Return what gives the comparisons [N, L, A] under the orders of the stimuli, in chunks, as often as asked."""
        judged, draws = self.permuted, self.permuted.metric.orders
        count, exact = judged.animals[0].count, permutation.most_exact(draws)
        size = len(judged.layers) * len(judged.animals)
        # Of many stimuli no more than one order is held at a time.
        step = max(1, _CHUNK_ELEMENTS // max(len(judged.layers) * min(count, 64) ** 2, size))
        orders = partial(permutation.label_orders, count, seed, exact=exact, draws=draws, step=step)
        number = math.factorial(count) if count <= exact else draws + 1
        stored = list(judged.under(orders)) if number * size <= _KEPT_ELEMENTS else None
        return lambda: judged.under(orders) if stored is None else stored


def _test(
    null: Callable[[], Iterable[Floats]], judged: LayerComparisons, scale: CommonScale, rule: LayerRule, weights: Floats
) -> tuple[permutation.PermutationTest, Floats]:
    """Test the score by orders of the stimuli, the choice of layer repeated in each; also return layers' means."""
    metric, count = judged.metric, judged.animals[0].count
    smallest = permutation.smallest_p(count, metric.orders)
    if count < permutation.SMALLEST_STIMULI:
        reason = f"{count} stimuli allow no p below {smallest:.3g}; at least {permutation.SMALLEST_STIMULI} are needed"
        return permutation.PermutationTest(math.nan, smallest, True, 0, math.nan, np.empty(0), reason), np.empty((0, 0))
    scores, means = [], []
    for r in map(scale, null()):
        scores.append(rule.held(r) @ weights / len(weights))
        means.append((r * weights).mean(axis=-1))
    every = np.concatenate(scores)
    # An order under which a comparison has no value says nothing.
    every = np.where(np.isfinite(every), every, -np.inf)
    return permutation.make_test(
        every, exact=count <= permutation.most_exact(metric.orders), smallest=smallest
    ), np.concatenate(means)


def without_scale(result: LayerEvaluation) -> str:
    """Return why a score has no scale: chance reaches a perfect model in one of twenty orders; empty if it has one."""
    null = result.test.null[np.isfinite(result.test.null)]
    if null.size and not result.attainable > (reached := float(np.quantile(null, 0.95))):
        return f"no scale: a perfect model would score {result.attainable:.2f}, which chance reaches ({reached:.2f})"
    return ""


def _ceilings(compared: LayerComparisons, animals: Animals, seed: int) -> Floats:
    """Return value and error [2, L] of a perfect model over the stimuli that each layer has a value for."""
    patterns, group = np.unique(compared.defined, axis=0, return_inverse=True)
    values = []
    for stimuli in (animals.order[present] for present in patterns):
        metric, subjects = compared.metric, [animals.subjects[i] for i in animals.scored]
        # The reliability of an RDM is stated for all stimuli.
        if len(stimuli) < len(animals.order) and not metric.of_rdms:
            metric, subjects = metric.among(stimuli), [subject.take(stimuli) for subject in subjects]
        draws, factors = metric.attainable(subjects, seed), animals.factors(animals.scored)
        # Draws of all animals begin alike: their errors do not average out.
        by_draw = (draws * factors[:, None]).mean(axis=0)
        error = by_draw.std(ddof=1) / math.sqrt(len(by_draw)) if len(by_draw) > 1 else 0.0
        values.append(((finite_mean(draws) * factors).mean(), error))
    return np.array(values)[group.ravel()].T


def _partly(compared: LayerComparisons, names: Sequence[str]) -> tuple[str, ...]:
    counts = [(name, (~known).sum(), len(known)) for name, known in zip(names, compared.defined, strict=True)]
    lacking = [f"{name} ({number} of {count})" for name, number, count in counts if number]
    if not lacking:
        return ()
    text = "layers without a value for some stimuli, compared over the others and chosen only where no layer has more"
    return (f"{text}: {', '.join(lacking)}",)
