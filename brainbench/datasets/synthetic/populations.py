"""Populations of synthetic neurons: tuning from features or a geometry, trials, and spike counts around expected rates.

Every unit has a mean rate b (log-normal over units) and Gaussian weights w on the axes of a geometry
(:class:`ResponseGeometry`). Its expected rate for stimulus k is b · max(0, 1 + m (√(1−ι) x_k·w + √ι y_k·w′)): x_k is
the shared direction of the stimulus, y_k the animal's own random one, m the ``modulation``, ι the ``individual`` share.
Each animal multiplies the axes by its own log-normal ``emphasis``. Squared Euclidean distances over many units are then
proportional to those between directions; rectification touches less than 0.7 % of the rates at the largest modulation.

Counts are Poisson around that rate, times a gamma gain per unit and trial (``dispersion`` φ: variance =
mean + φ mean², the negative binomial), times one gain common to all units of a trial (``shared_gain``).

Files of sessions have ``truth.json`` beside them, the geometry that their units were given; they are made once per
machine and then read from the cache. Letters: K stimulus, F feature, R trial, U unit.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError, check_name, check_number
from brainbench.core.files import cache_dir, check_folder, content_hash, file_hash, read_json, write_json
from brainbench.core.limits import Count, Limit, NotNegative, Positive, Share, limited
from brainbench.core.progress import Progress
from brainbench.core.reading.hdf5 import trust_hdf5
from brainbench.core.reading.sealed import is_sealed, keeping, seal_file
from brainbench.datasets.hdf5 import write_recordings
from brainbench.datasets.nwb import write_nwb
from brainbench.datasets.sessions import Session, make_session

MODULATION = 0.4  # largest modulation: beyond it too many rates would be cut off at zero for the truth to hold


@limited
class PopulationDesign:
    """Size of synthetic recordings, and how noisy they are; the defaults make RDMs of about half reliability."""

    animals: Count = 10
    sessions: Count = 1
    """Sessions per animal; each has its own units."""
    units: Count = 60
    """Units per session."""
    trials: Count | Annotated[tuple[Count, Count], Limit(rising=True)] = (16, 20)
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

    ``traits`` is the random stream of the animal, fresh: all of its sessions draw the same differences from it;
    ``random`` is that of the session.
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


TRUTH = "truth.json"
NOTE = "SYNTHETIC recordings: ranks of models on them say nothing about brains."

write_synthetic_nwb = partial(
    write_nwb,
    description="simulated stimuli encoded by simulated neurons, made by brainbench.",
    general={
        "experimenter": ["Simulation, A"],
        "institution": "none (synthetic data)",
        "lab": "none (synthetic data)",
        "experiment_description": NOTE,
        "keywords": ["synthetic", "whisker", "barrel cortex", "demo"],
    },
    subject={
        "species": "Mus musculus",
        "sex": "U",
        "age": "P90D",
        "description": "SYNTHETIC subject: no animal was recorded.",
    },
)
"""Writes a session as NWB that says in every description that it is synthetic."""


def write_with_truth(
    folder: str | os.PathLike[str],
    sessions: Iterable[tuple[Session, NDArray[np.float64]]],
    *,
    write: Callable[[Path, Session], Path],
    suffix: str,
    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    **about: Any,
) -> list[Path]:
    """Write sessions as files ``sub-…_ses-…SUFFIX``, and last their truth.

    A session comes with its units' expected responses [K, U] (Hz) to each stimulus in the window that is counted, and
    sessions of one subject come together. ``write`` writes one of them atomically, ``distance`` makes the RDM [P] of
    expected responses [K, U], and ``about`` is what else the truth holds: ``labels``, and ``shared``, the RDM [P] of
    the shared geometry. Returns the files of the sessions.
    """
    folder = Path(folder)
    expected: dict[str, list[NDArray[np.float64]]] = {}
    paths = []
    for session, rates in sessions:
        paths.append(write(folder / f"sub-{session.subject}_ses-{session.session}{suffix}", session))
        expected.setdefault(session.subject, []).append(rates)
    write_json(
        folder / TRUTH,
        {
            "note": NOTE,
            "synthetic": True,
            **about,
            "subjects": {name: distance(np.concatenate(own, axis=1)) for name, own in expected.items()},
            "files": {path.name: {"bytes": path.stat().st_size, "hash": file_hash(path)} for path in paths},
        },
    )
    return paths


def read_truth(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the truth of synthetic recordings: labels, and RDMs [P] of ``shared`` and ``subjects``."""
    truth = read_json(Path(folder) / TRUTH)
    truth["shared"] = np.array(truth["shared"])
    truth["subjects"] = {name: np.array(values) for name, values in truth["subjects"].items()}
    return truth


def squared_euclidean_rdm(responses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared Euclidean distances [P] between rows [K, U], divided by the number of units."""
    rows, columns = np.triu_indices(len(responses), 1)
    # The mean over units, not the sum (as rsatoolbox does), so that populations of different sizes compare.
    return np.mean((responses[rows] - responses[columns]) ** 2, axis=1)


def correlation_rdm(responses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the correlation distances [P] between rows [K, U]; NaN for rows without variance."""
    rows, columns = np.triu_indices(len(responses), 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Distance 1 − Pearson r over units, upper triangle row by row, as the metrics compute it.
        return 1.0 - np.atleast_2d(np.corrcoef(responses))[rows, columns]


_log = logging.getLogger(__name__)


def ensure_recordings(name: str, *key: object, make: Callable[[Path], object]) -> Path:
    """Return the folder of synthetic recordings, making them if this machine has none.

    Two processes may ask at once and either may be killed: every file is written whole, the truth comes last, and a
    folder without it, or with files missing or of another size or hash, is made again. The folder's name begins with
    ``name``; ``key`` is everything on which the recordings depend, and ``make`` writes them into a folder, last their
    truth.
    """
    target = cache_dir("recordings") / f"{name}-{content_hash(*key)}"
    if not _complete(target):
        if (target / TRUTH).exists():
            _log.warning("The %s recordings in %s are damaged and are replaced.", name, target)
        # Before the stimuli are simulated, which is slow.
        check_folder(target, "The cache")
        make(target)
        with keeping("recordings"):
            seal_file(target / TRUTH)
    return target


def _complete(folder: Path) -> bool:
    if not is_sealed(folder / TRUTH):
        return False
    try:
        for name, stated in read_json(folder / TRUTH)["files"].items():
            path = folder / name
            if path.stat().st_size != stated["bytes"] or file_hash(path) != stated["hash"]:
                return False
            trust_hdf5(path)
    except (DataError, OSError, KeyError, TypeError, AttributeError):
        return False
    return True


_EXACT = 2e-4  # largest error of the modulation that calibration leaves, on the studies it draws


def measure_ceiling(
    geometry: ResponseGeometry, design: PopulationDesign, *, simulations: int = 50, seed: int | Sequence[int] = 0
) -> tuple[float, float]:
    """Measure the noise ceiling of a design: what the true geometry itself scores.

    That is the mean Pearson correlation between the true RDM and the RDM measured in one animal (correlation distance
    of mean responses, sessions joined). Animals without an RDM, because they lack a stimulus or did not answer one at
    all, are left out. ``simulations`` studies are drawn, each of ``design.animals`` animals. Returns the ceiling and
    its Monte-Carlo standard error; NaN if no animal has all stimuli, an RDM is flat (two stimuli), or there is one
    animal only for the error.
    """
    check_number("simulations", simulations, least=1, whole=True)
    truth, stimuli = geometry.rdm, len(geometry.labels)
    scores: list[float] = []
    for number in range(simulations):
        for sessions in draw_animals(geometry, design, (*entropy(seed), number)).values():
            means = np.concatenate([stimulus_means(block, stimuli) for block in sessions], axis=1)
            scores.append(_pearson(correlation_rdm(means), truth))
    finite = np.array([score for score in scores if np.isfinite(score)])
    if not len(finite):
        return float("nan"), float("nan")
    # Animals are drawn independently around a fixed geometry, so their comparisons have a standard error.
    error = finite.std(ddof=1) / np.sqrt(len(finite)) if len(finite) > 1 else np.nan
    return float(finite.mean()), float(error)


def calibrate(
    geometry: ResponseGeometry,
    design: PopulationDesign,
    *,
    ceiling: float,
    simulations: int = 50,
    seed: int | Sequence[int] = 0,
) -> PopulationDesign:
    """Return the design with the modulation at which it has a given noise ceiling.

    Found by Brent's method with common random numbers: the same animals are drawn at every step. ``ceiling`` is the
    wanted value of :func:`measure_ceiling`; the result is as exact as the Monte-Carlo error of so many ``simulations``.
    """

    from scipy.optimize import root_scalar

    check_number("ceiling", ceiling, above=0, most=1)

    def excess(modulation: float) -> float:
        """Return by how much the ceiling at a modulation exceeds the wanted one."""
        tried = replace(design, modulation=modulation)
        return measure_ceiling(geometry, tried, simulations=simulations, seed=seed)[0] - ceiling

    highest = excess(MODULATION)
    if not highest >= 0:
        raise UsageError(
            f"A noise ceiling of {ceiling:g} is out of reach: this design has up to {highest + ceiling:.3f}. "
            f"More units or trials, a higher rate, less dispersion or a smaller individual share raise it."
        )
    # Both ends are known: without modulation the expected comparison is zero.
    ends = {0.0: -ceiling, MODULATION: highest}
    # With the same seed at every step the ceiling depends on the modulation alone, as a root finder needs.
    root = root_scalar(
        lambda modulation: ends.get(modulation) or excess(modulation), bracket=(0.0, MODULATION), xtol=_EXACT
    )
    return replace(design, modulation=float(root.root))


def stimulus_means(block: Trials, stimuli: int) -> NDArray[np.float64]:
    """Return the mean response [K, U] to every stimulus; NaN where there is no trial."""
    # Indicators [K, R]: one product sums the trials of every stimulus.
    member = np.zeros((stimuli, len(block.labels)))
    member[block.labels, np.arange(len(block.labels))] = 1.0
    number = member.sum(axis=1, keepdims=True)
    total = member @ block.responses.mean(axis=1)
    return np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)


def _pearson(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    a, b = first - first.mean(), second - second.mean()
    size = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / size) if size > 0 else float("nan")


_LATENCY, _JITTER = 0.012, 0.003  # onset response after contact, s
_ONSET = 0.15  # share of the spikes in a window that belong to the onset response
_DEAD = 0.002  # refractory time, s


def spike_trains(
    random: np.random.Generator,
    counts: NDArray[np.int64],
    begin: NDArray[np.float64],
    length: float | NDArray[np.float64],
    rest: NDArray[np.float64],
    span: tuple[float, float],
) -> list[NDArray[np.float64]]:
    """Place the spikes of a session: counted ones in the trials' windows, and others at a constant rate between them.

    ``counts`` [R, U] are the spikes in windows that do not overlap, with ``begin`` [R] (ascending, s) and ``length`` of
    all or of each [R], s; ``rest`` [U] are the rates outside of them, Hz, and ``span`` the first and last second.
    Returns spike times of each unit [U], s; 15 % of those in a window come about 12 ms after its begin.
    """
    # The margins keep the refractory time between the spikes of a window and those around it.
    opened = np.concatenate([[span[0]], begin + length]) + _DEAD
    pause = np.concatenate([begin, [span[1]]]) - _DEAD - opened
    trains = []
    for unit in range(counts.shape[1]):
        window = _place_spikes(random, counts[:, unit], begin, length, _ONSET)
        idle = _place_spikes(random, random.poisson(rest[unit] * pause), opened, pause, 0.0)
        trains.append(np.sort(np.concatenate([window, idle])))
    return trains


def _place_spikes(
    random: np.random.Generator,
    counts: NDArray[np.int64],
    begin: NDArray[np.float64],
    length: float | NDArray[np.float64],
    onset: float,
) -> NDArray[np.float64]:
    """Place counted spikes [R] in windows, none within the refractory time of another.

    Positions are drawn in the window shortened by all refractory times, sorted, and spread apart by them: exactly
    ``counts`` spikes, at least the refractory time between any two. ``onset`` is the share of the spikes at the latency
    after the begin of their window. Returns spike times, s, window after window.
    """
    long = np.broadcast_to(np.asarray(length, dtype=np.float64), counts.shape)
    # At high counts the refractory time shrinks, so that it fills at most half of any window.
    dead = min(_DEAD, float(np.min(0.5 * long / np.maximum(counts, 1))))
    which = np.repeat(np.arange(len(counts)), counts)
    # A hair less than the window, which is half open and must hold the last spike after rounding.
    free = (long[which] - counts[which] * dead) * (1 - 1e-9)
    # Given their number, Poisson spikes lie evenly in the window; an onset response is moved to its latency below.
    position = random.random(len(which)) * free
    early = random.random(len(which)) < onset
    latency = _LATENCY + _JITTER * random.standard_normal(int(early.sum()))
    position[early] = np.clip(latency, 0.0, free[early])
    order = np.lexsort((position, which))
    # The i-th spike of a window moves by i refractory times, which keeps the order and makes the gaps.
    rank = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return begin[which] + position[order] + rank * dead


_BEFORE = 0.5  # from trial start to contact, s
_AFTER = (0.25, 1.25)
"""Least and most time from the end of the window to the end of the trial, s: no two trials are alike in
length, so that a shifted clock cannot hide behind a regular rhythm."""
REST = 0.5  # rate between windows, as a share of a unit's mean rate
_TOUCH = 0.05  # duration of a contact, s


def write_files(
    folder: str | os.PathLike[str],
    geometry: ResponseGeometry,
    design: PopulationDesign | None = None,
    *,
    seed: int | Sequence[int] = 0,
    format: str = "nwb",
    stimuli: str = "",
    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]] = correlation_rdm,
    progress: Progress | None = None,
    **about: Any,
) -> list[Path]:
    """Write synthetic animals as files, one per session, with ``truth.json`` beside them.

    Opened again (layout ``synthetic``) they give the counts of :func:`~brainbench.datasets.synthetic.draw_animals`;
    ``read_truth`` reads the truth. Files of the same names are replaced. The format is ``nwb`` or ``h5``, ``stimuli`` a
    recipe that the files then name. ``distance`` makes the RDM of each animal's expected rates [K, U] for the truth,
    ``about`` is what else that holds.
    """
    writers: dict[str, Callable[[Path, Session], Path]] = {"nwb": write_synthetic_nwb, "h5": write_recordings}
    check_name("format", format, writers)
    design = design or PopulationDesign()

    def draw() -> Iterator[tuple[Session, NDArray[np.float64]]]:
        """Yield each session with its expected rates [K, U] (spikes/s), one in memory at a time."""
        for done, drawn in enumerate(draw_sessions(geometry, design, seed), start=1):
            yield replace(spike_session(geometry, drawn), stimuli=stimuli), drawn.expected
            if progress is not None:
                progress(done, design.animals * design.sessions, f"synthetic recordings {drawn.subject}")

    return write_with_truth(
        folder,
        draw(),
        write=writers[format],
        suffix=f".{format}",
        distance=distance,
        seed=seed,
        design=design,
        stimuli=stimuli,
        labels=geometry.labels,
        shared=geometry.rdm,
        **about,
    )


def trial_times(drawn: DrawnSession) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the contact and the end of every trial [R], s."""
    # A stream of its own, apart from that of the spikes: data set and files have equal times, whatever else is drawn.
    pause = np.round(np.random.default_rng([*drawn.stream, 2]).uniform(*_AFTER, len(drawn.labels)), 4)
    # A trial is lead, window and pause, and the next one follows at once; the first begins at 1 s.
    stop = 1.0 + np.cumsum(_BEFORE + drawn.window + pause)
    return stop - pause - drawn.window, stop


def spike_session(geometry: ResponseGeometry, drawn: DrawnSession) -> Session:
    """Return the spike times of a session whose counts were drawn.

    A trial begins 0.5 s before a whisker touches (table ``contacts_by_whisker_C1``); 15 % of the spikes that are
    counted come about 12 ms after that touch, the others anywhere in the window; between windows units fire at half
    their mean rate, and never twice within 2 ms (less at rates above 250 Hz). The window is ``first-contact..choice``.
    """
    random = np.random.default_rng([*drawn.stream, 1])
    begin, stop = trial_times(drawn)
    choice, end = begin + drawn.window, float(stop[-1])
    # The rate between windows is the same for all stimuli: a reader that mistakes the window loses the geometry.
    spikes = spike_trains(random, drawn.counts, begin, drawn.window, REST * drawn.expected.mean(axis=0), (0.0, end))
    tables: dict[str, dict[str, Any]] = {
        "trials": {
            "id": np.arange(len(begin)),
            "start_time": begin - _BEFORE,
            "stop_time": stop,
            "stimulus": np.array(geometry.labels, dtype=str)[drawn.labels],
            "choice_time": choice,
        },
        "contacts_by_whisker_C1": {"start_time": begin, "stop_time": begin + _TOUCH},
    }
    observed = [np.array([[0.0, end]])] * len(spikes)
    about = {"start": "2025-01-01T12:00:00+00:00", "synthetic": True}
    return make_session(drawn.subject, drawn.session, spikes, tables, observed=observed, **about)
