"""Populations of synthetic neurons: tuning from features or a geometry, trials, and spike counts around expected rates.

Every unit has a mean rate b (log-normal over units) and Gaussian weights w on the axes of a geometry
(:class:`ResponseGeometry`). Its expected rate for stimulus k is b · max(0, 1 + m (√(1−ι) x_k·w + √ι y_k·w′)): x_k is
the shared direction of the stimulus, y_k the animal's own random one, m the ``modulation``, ι the ``individual`` share.
Each animal multiplies the axes by its own log-normal ``emphasis``. Squared Euclidean distances over many units are then
proportional to those between directions; rectification touches less than 0.7 % of the rates at the largest modulation.

Counts are Poisson around that rate, times a gamma gain per unit and trial (``dispersion`` φ: variance =
mean + φ mean², the negative binomial), times one gain common to all units of a trial (``shared_gain``).

Letters: K stimulus, F feature, R trial, U unit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.core.limits import Count, Limit, NotNegative, Positive, Share, limited
from brainbench.core.reading.ranges import check_number

MODULATION = 0.4  # largest modulation: beyond it too many rates would be cut off at zero for the truth to hold


@dataclass(frozen=True)
@limited
class PopulationDesign:
    """Size of synthetic recordings, and how noisy they are; the defaults make RDMs of about half reliability."""

    animals: Count = 10
    sessions: Count = 1
    """Sessions per animal; each has its own units."""
    units: Count = 60
    """Units per session."""
    trials: int | tuple[int, int] = (16, 20)
    """Trials of each stimulus in a session: one number, or the fewest and the most, drawn evenly."""
    rate: Positive = 6.0
    """Mean rate of a unit, Hz."""
    window: Positive = 0.5
    """Duration in which spikes are counted, s."""
    modulation: Annotated[float, Limit(least=0, most=MODULATION)] = 0.2
    """Standard deviation of a unit's rate over stimuli, as a share of its mean; 0 is the null."""
    individual: Share = 0.0
    """Share of the tuning variance that is an animal's own and not the shared geometry."""
    emphasis: NotNegative = 0.3
    """Standard deviation over animals of the logarithm of the weight of each axis of the geometry."""
    spread: NotNegative = 0.4
    """Standard deviation of the logarithm of mean rates over units."""
    dispersion: NotNegative = 0.2
    """φ of the negative binomial: variance = mean + φ mean² per unit and trial; 0 is Poisson."""
    shared_gain: NotNegative = 0.2
    """Standard deviation of a gain (mean one) that all units of a trial share."""
    session_gain: NotNegative = 0.0
    """Standard deviation of the logarithm of each session's overall rate."""
    drift: Annotated[float, Limit(above=-1)] = 0.0
    """Relative change of all rates from the first trial of a session to the last, above −1."""
    missing: tuple[tuple[int, int], ...] = ()
    """Pairs (animal, stimulus) without any trial."""

    def __post_init__(self) -> None:
        fewest, most = self.trial_range
        if not 1 <= fewest <= most:
            raise UsageError(f"A design needs at least one of trials, fewest before most; received {self.trials}.")

    @property
    def trial_range(self) -> tuple[int, int]:
        """Fewest and most trials of a stimulus in a session."""
        return (self.trials, self.trials) if isinstance(self.trials, int) else self.trials


@dataclass(frozen=True)
class ResponseGeometry:
    """Directions of K stimuli in tuning space; the distances between them are the truth of synthetic recordings."""

    directions: NDArray[np.float64]
    """[K, D] on their principal axes, D < K or so; the mean of their squared lengths is one."""
    labels: tuple[str, ...]
    """[K] names of the stimuli."""

    @classmethod
    def from_features(cls, features: ArrayLike, labels: Sequence[str] | None = None) -> ResponseGeometry:
        """Take the correlations between the rows of features [K, F], such as a model's activations.

        The truth is then 1 − Pearson between rows, the model's own correlation-distance RDM.
        """
        values = _checked(features, 2)
        # Inner products of centred rows of length one are Pearson correlations (r), so the RDM below is 1 − r.
        centred = values - values.mean(axis=1, keepdims=True)
        norms = np.linalg.norm(centred, axis=1)
        if np.any(norms <= 1e-12 * np.maximum(np.abs(values).max(axis=1), 1e-300)):
            raise DataError(f"The features of stimulus {int(np.argmin(norms))} are constant, so it has no direction.")
        return cls(principal_axes(centred / norms[:, None]), _check_labels(labels, len(values)))

    @classmethod
    def from_activations(cls, features: ArrayLike, labels: Sequence[str] | None = None) -> ResponseGeometry:
        """Take the Euclidean distances between stimuli over features [K, F], each standardised over the stimuli.

        Constant features are left out. Unlike :meth:`from_features`, stimuli may be near to the mean response. Raises
        UsageError: the features are not [K, F] with K ≥ 2, or labels do not fit; DataError: a value is not finite, or
        every feature is constant.
        """
        values = _checked(features, 1)
        spread = values.std(axis=0)
        varied = spread > 1e-9 * np.maximum(np.abs(values).max(axis=0), 1e-300)
        if not varied.any():
            raise DataError("Every feature is the same for all stimuli, so there is nothing for neurons to encode.")
        standard = (values[:, varied] - values[:, varied].mean(axis=0)) / spread[varied]
        # Each standardised feature has a mean square of one over stimuli, so /√F makes the mean squared length one.
        return cls(principal_axes(standard / np.sqrt(standard.shape[1])), _check_labels(labels, len(values)))

    @property
    def rdm(self) -> NDArray[np.float64]:
        """The truth [P]: half the squared distance between directions, for unit vectors one minus their cosine."""
        rows, columns = np.triu_indices(len(self.directions), 1)
        return 0.5 * np.sum((self.directions[rows] - self.directions[columns]) ** 2, axis=1)


def _checked(features: ArrayLike, width: int) -> NDArray[np.float64]:
    """Return features [K, F] as finite numbers, K ≥ 2 and F ≥ width."""
    given = np.asarray(features)
    if given.dtype.kind not in "biuf":
        raise UsageError(f"Features are real numbers; received {given.dtype}.")
    values = given.astype(np.float64)
    if values.ndim != 2 or len(values) < 2 or values.shape[1] < width:
        raise UsageError(f"Features are [stimulus, feature], at least 2 × {width}; received shape {values.shape}.")
    if not np.isfinite(values).all():
        raise DataError(f"{int((~np.isfinite(values)).sum())} feature values are not finite.")
    return values


def principal_axes(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate K vectors [K, F] into the at most K axes that they span; every angle and length stays."""
    # X = U S Vᵀ: the rows of U S have the same inner products as those of X, and no more axes than its rank.
    left, values, _ = np.linalg.svd(vectors, full_matrices=False)
    present = values > 1e-9 * values[0]
    # A singular vector's sign is the machine's choice; the largest entry is made positive.
    signs = np.sign(left[np.abs(left).argmax(axis=0), np.arange(left.shape[1])])
    return (left * signs * values)[:, present]


def _check_labels(labels: Sequence[str] | None, stimuli: int) -> tuple[str, ...]:
    if labels is None:
        return tuple(f"s{index + 1}" for index in range(stimuli))
    if len(labels) != stimuli or len(set(labels)) != stimuli:
        raise UsageError(f"{stimuli} stimuli need as many different labels; received {len(set(labels))}.")
    return tuple(str(label) for label in labels)


@dataclass(frozen=True)
class DrawnSession:
    """One session as drawn: counts around expected rates."""

    subject: str
    session: str
    stream: tuple[int, ...]
    """Seed of this session's random numbers."""
    counts: NDArray[np.int64]
    """[R, U] spikes in the window."""
    labels: NDArray[np.int64]
    """[R] stimulus of each trial."""
    expected: NDArray[np.float64]
    """[K, U] expected rate, Hz."""
    window: float
    """Duration in which spikes are counted, s."""

    @property
    def trials(self) -> Trials:
        """Firing rates [R, 1, U] in Hz, with their labels and keys."""
        keys = tuple(f"{self.subject}/{self.session}/{row}" for row in range(len(self.labels)))
        return Trials(self.counts[:, None] / self.window, self.labels, keys)


def draw_animals(
    features: ArrayLike | ResponseGeometry, design: PopulationDesign | None = None, seed: int | Sequence[int] = 0
) -> dict[str, tuple[Trials, ...]]:
    """Draw animals whose units mix features linearly, such as the activations of a network.

    Every animal and session has its own random stream, so the first animals of a larger design are those of a smaller
    one. Features [K, F] are each standardised over stimuli (:meth:`ResponseGeometry.from_activations`). The seed is one
    integer, or several (such as study and simulation). Returns subject → its sessions: ``responses`` [R, 1, U] Hz,
    ``labels`` [R], ``keys``.
    """
    geometry = features if isinstance(features, ResponseGeometry) else ResponseGeometry.from_activations(features)
    animals: dict[str, tuple[Trials, ...]] = {}
    for drawn in draw_sessions(geometry, design, seed):
        animals[drawn.subject] = (*animals.get(drawn.subject, ()), drawn.trials)
    return animals


def draw_sessions(
    geometry: ResponseGeometry, design: PopulationDesign | None, seed: int | Sequence[int]
) -> Iterator[DrawnSession]:
    """Draw the sessions of every animal; each is a pure function of geometry, design, seed, animal and session."""
    design = design or PopulationDesign()
    for animal in range(design.animals):
        for session in range(design.sessions):
            yield _draw_session(geometry, design, animal, session, entropy(seed))


def _draw_session(
    geometry: ResponseGeometry, design: PopulationDesign, animal: int, session: int, seed: tuple[int, ...]
) -> DrawnSession:
    stimuli = len(geometry.labels)
    absent = [which for owner, which in design.missing if owner == animal]
    if any(not 0 <= which < stimuli for which in absent):
        raise UsageError(f"Missing stimuli are numbered 0 to {stimuli - 1}; received {absent} for animal {animal}.")
    # One stream for each animal and each session: a larger design begins with the animals of a smaller one.
    animal_random = np.random.default_rng([*seed, animal])
    random = np.random.default_rng([*seed, animal, session])
    expected = expected_rates(geometry, design, animal_random, random)
    labels = _labels(design, stimuli, absent, random)
    counts = draw_counts(random, design, expected[labels], design.window)
    names = {"subject": f"synthetic{animal + 1:02d}", "session": f"{session + 1:02d}"}
    drawn = {"counts": counts, "labels": labels, "expected": expected}
    return DrawnSession(**names, **drawn, stream=(*seed, animal, session), window=design.window)


def expected_rates(
    geometry: ResponseGeometry,
    design: PopulationDesign,
    traits: np.random.Generator,
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Draw units and return their expected rates [K, U], Hz.

    ``own`` is the random stream of the animal, fresh: all of its sessions draw the same differences from it; ``random``
    is that of the session.
    """
    stimuli = len(geometry.labels)
    # Log-normal weights of the axes; their mean square is one, so that the depth of tuning does not depend on them.
    weight = np.exp(design.emphasis * traits.standard_normal(geometry.directions.shape[1]))
    axes = geometry.directions * weight
    axes *= np.sqrt(np.sum(geometry.directions**2) / np.sum(axes**2))
    # Variances add up to one: 1 − ι of the shared geometry and ι of the animal's own.
    tuning = np.sqrt(1 - design.individual) * _project(axes, design.units, random)
    if design.individual:
        private = traits.standard_normal((stimuli, stimuli + 1))
        # Length one, the root mean square length of the shared axes: before ι weighs them both parts have variance one.
        private /= np.linalg.norm(private, axis=1, keepdims=True)
        tuning += np.sqrt(design.individual) * _project(private, design.units, random)
    # Log-normal over units with the mean rate kept, since E exp(σz − σ²/2) = 1.
    mean = design.rate * np.exp(design.spread * random.standard_normal(design.units) - design.spread**2 / 2)
    mean *= np.exp(design.session_gain * random.standard_normal())
    # Rectified-linear rates b max(0, 1 + m w·x): their covariance over units follows the cosines of the geometry.
    return mean * np.maximum(0.0, 1.0 + design.modulation * tuning)


def draw_counts(
    random: np.random.Generator,
    design: PopulationDesign,
    rates: NDArray[np.float64],
    window: float | NDArray[np.float64],
) -> NDArray[np.int64]:
    """Draw spike counts [R, U] around expected rates [R, U] (Hz) in windows of one length or one each [R, 1], s."""
    # Drift is linear from the first trial to the last, with a mean of one.
    gain = np.linspace(1 - design.drift / 2, 1 + design.drift / 2, len(rates))[:, None]
    if design.shared_gain:
        # A gamma with shape 1/σ² and scale σ² has mean one and standard deviation σ.
        shape = design.shared_gain**-2
        gain = gain * random.gamma(shape, 1 / shape, (len(rates), 1))
    rates = rates * gain
    if design.dispersion:
        # A Poisson count with a gamma rate is negative binomial: variance = mean + φ mean².
        rates *= random.gamma(1 / design.dispersion, design.dispersion, rates.shape)
    return random.poisson(rates * window)


def _project(directions: NDArray[np.float64], units: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return the tuning [K, U] of units with random preferred directions: normal, covariance over units = cosines."""
    return directions @ random.standard_normal((directions.shape[1], units))


def _labels(
    design: PopulationDesign, stimuli: int, absent: list[int], random: np.random.Generator
) -> NDArray[np.int64]:
    fewest, most = design.trial_range
    number = random.integers(fewest, most + 1, size=stimuli)
    number[absent] = 0
    labels = np.repeat(np.arange(stimuli), number)
    random.shuffle(labels)
    return labels


def entropy(seed: int | Sequence[int]) -> tuple[int, ...]:
    """Return a seed as the beginning of a list of integers; one that is none of 0 or more is a UsageError."""
    several: tuple[Any, ...] = tuple(seed) if isinstance(seed, (tuple, list)) else (seed,)
    for number in several:
        check_number("A seed", number, least=0, whole=True)
    return several
