"""The published score of a model, computed on the authors' arrays as their code takes them.

An array holds one animal's rates [R, K, U], with zeros in the slots of stimuli that a trial did not show. Their code
(2025-tactile-whisking, 3420db6, with brainmodel_utils) averages trials with those zeros, takes the stimuli in the order
of the file and all units, and splits trials into halves with fixed seeds. Splits whose halves' RDMs correlate below .5
are dropped, the others are corrected one by one, and the score is the maximum over layers and over targets: every
animal, and the pool of all units.

Activations are read as the published scores read them. Their scripts average the second axis of whatever a layer gives.
That is time for graphs, ResNet and Mamba, but all 44 tokens of GPT (action tokens included) and the channels of S4's
blocks, whose 22 time points are then the features. A node of a graph is read from the step that the first number of its
name sets: conv1 from 0, fc8 from 7. What is returned has that axis second, so that its mean is what was scored. Unlike
theirs, the network is in evaluation mode: they left dropout and batch statistics on, which no seed reproduces.

Letters: B batch, T step, F features.

The walk leads from the published estimator to the default one, one switch per fault, one line per step. Faults that
happen before the estimator (other stimuli filled with zeros, stimuli numbered by first appearance) are in
``brainbench.datasets.synthetic`` and their damage is in docs/calibration.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import nn

from brainbench.core.errors import DataError, UsageError, brief, check_each
from brainbench.core.files import to_plain
from brainbench.core.progress import Progress
from brainbench.core.provenance import Provenance
from brainbench.core.reading.tensors import read_npz
from brainbench.core.records import LayerScore, Score, Status, SubjectScore
from brainbench.metrics.arrays import Floats
from brainbench.metrics.evaluation import gather, held_out, recorded_rdm
from brainbench.metrics.inference.permutation import EXACT_STIMULI, canonical_order, label_orders, make_test
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import compare, permuted_comparisons, permuted_pairs, rdm_stack, stimulus_count
from brainbench.metrics.rdms.dissimilarity import correlation_distances, rdm
from brainbench.metrics.reliability.noise_correction import (
    ANIMAL_GATE,
    RELIABILITY_GATE,
    THESIS_FILTER,
    corrected_splits,
    noise_corrected,
    spearman_brown,
)
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, is_flat
from brainbench.models.encoders import GPTAttender, MambaAttender, ResNet18Encoder, S4Encoder
from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.parts import AllStepsDecoder, Attender
from brainbench.published.recordings import read_arrays

POOL = "concatenated"  # name of the target that holds the units of all animals
SPLITS, FIRST_SEED = 1000, 1234  # random halves, and the seed of the first; every split has a seed of its own
_CHUNK = 1 << 24


def compare_published(
    inputs: Any, features: Mapping[str, Mapping[str, ArrayLike]], *, agreement: bool
) -> tuple[list[Score], Score | None]:
    """Score features by model, and the animals against one another, on the arrays of the published file.

    ``inputs`` are those of :class:`brainbench.scoring.scores.ScoreInputs`; the first of the features are its model's.
    """
    brain, labels, options = inputs.brain, inputs.labels, inputs.options
    arrays, _ = read_arrays(Path(brain.dataset.attrs["source"]))
    slots = [brain.vocabulary.index(label) for label in labels]
    arrays = {name: array[:, slots] for name, array in arrays.items()}
    if options.layer is not None:
        model = next(iter(features))
        features = {**features, model: {options.layer: features[model][options.layer]}}
    targets, how = make_targets(arrays), {"stimuli": labels, "estimator": options.estimator}
    scores = [score_published(layers, targets, name=name, **how) for name, layers in features.items()]
    return scores, score_published_animals(arrays, stimuli=labels) if agreement else None


@dataclass(frozen=True)
class Target:
    """One animal, or the pool, as the published code takes it."""

    name: str
    rdm: Floats = field(repr=False)
    """[P] correlation distances of the means over trials, zeros included."""
    split_half_r: Floats = field(repr=False)
    """[S] correlations of the halves' RDMs; NaN for a split that their code skips."""
    units: int
    trials: int


def make_targets(arrays: Mapping[str, Floats], *, splits: int = SPLITS) -> tuple[Target, ...]:
    """Return the animals and, of several, their pool.

    ``arrays`` are rates [R, K, U] by animal, NaN where a unit's session had fewer trials.
    """
    targets = dict(arrays) if len(arrays) == 1 else {**arrays, POOL: concatenate(list(arrays.values()))}
    return tuple(_target(name, array, splits) for name, array in targets.items())


def concatenate(arrays: Sequence[Floats]) -> Floats:
    """Return the units of all animals side by side, padded with NaN to the most trials."""
    most = max(map(len, arrays))
    padded = [np.pad(one, ((0, most - len(one)), (0, 0), (0, 0)), constant_values=np.nan) for one in arrays]
    return np.concatenate(padded, axis=2)


def _target(name: str, array: Floats, splits: int) -> Target:
    trials, count, units = array.shape
    flat = array.reshape(trials, -1)
    seen = np.isfinite(flat).astype(np.float64)
    flat = np.nan_to_num(flat)

    def distances(member: Floats) -> Floats:
        """Return the RDMs [S, P] of the mean rates over the trials in ``member`` [S, R]."""
        with np.errstate(invalid="ignore", divide="ignore"):
            # A unit without a trial among them is 0/0 = NaN, and so is then the whole RDM.
            return correlation_distances((member @ flat / (member @ seen)).reshape(-1, count, units))

    correlations = np.empty(splits)
    step = max(1, _CHUNK // (8 * count * units))
    for start in range(0, splits, step):
        index = range(start, min(start + step, splits))
        first = np.stack([first_half(trials, FIRST_SEED + split) for split in index]).astype(np.float64)
        correlations[start : index.stop] = _correlations(distances(first), distances(1 - first))
    return Target(name, distances(np.ones((1, trials)))[0], correlations, units, trials)


def _correlations(first: Floats, second: Floats) -> Floats:
    """Return Pearson's r [S]; NaN where either RDM lacks a pair."""
    return np.where(np.isfinite(first + second).all(axis=-1), compare(first, second), np.nan)


def first_half(trials: int, seed: int) -> NDArray[np.bool_]:
    """Return which trials [R] the published code puts into the first half: the smaller one of an odd number."""
    # Their generator: numpy keeps the stream of RandomState as it is.
    return np.isin(np.arange(trials), np.random.RandomState(seed).permutation(trials)[: trials // 2])


def score_published(
    features: Mapping[str, ArrayLike],
    targets: Sequence[Target],
    *,
    name: str,
    stimuli: Sequence[str],
    estimator: str = "thesis",
) -> Score:
    """Score a model as published; the value is a maximum over layers and targets, and so never ``ok``.

    The permutation test takes the same maximum under every order of the stimuli. ``features`` [K, F] of each layer have
    the stimuli in the order of the slots. ``thesis-input`` is the bar of the raw input: the last target alone, median
    over all splits.
    """
    targets = targets[-1:] if estimator == "thesis-input" else targets
    rdms = {layer: correlation_distances(np.asarray(values, dtype=float)) for layer, values in features.items()}
    names = [layer for layer, values in rdms.items() if np.ptp(values) > 0]
    corrected = {target.name: noise_corrected(1.0, target.split_half_r, estimator=estimator) for target in targets}
    used = [item for item in targets if np.isfinite(corrected[item.name].value) and np.isfinite(item.rdm).all()]
    lost = ", ".join(item.name for item in targets if item not in used)
    notes = (f"left out, no split counts (raw correlation of halves below {THESIS_FILTER}): {lost}",) if lost else ()
    about = {
        "name": name,
        "estimator": estimator,
        "stimuli": tuple(map(str, stimuli)),
        "metric": "RSA: correlation RDM of mean rates with their zeros, pearson comparison",
        "provenance": Provenance.of({"splits": len(targets[0].split_half_r), "seed": 0}),
    }
    if not names or not used:
        return Score(value=math.nan, status="undefined", reasons=notes or ("no layer has an RDM",), **about)
    layers, brain = np.stack([rdms[layer] for layer in names]), np.stack([item.rdm for item in used])
    factors = np.array([corrected[item.name].value for item in used])
    raw = compare(layers[:, None], brain[None])
    values = raw * factors
    best, place = np.unravel_index(int(values.argmax()), values.shape)
    # Sorted by the brain, orders do not depend on how stimuli were listed.
    pairs, orders = permuted_pairs(canonical_order(brain)[None])[0], label_orders(len(stimuli), 0, step=1024)
    r = np.concatenate(list(permuted_comparisons(layers[:, pairs], brain[:, pairs], orders, "pearson")))
    null = (r * factors).max(axis=(-2, -1))
    test = make_test(null, exact=len(stimuli) <= EXACT_STIMULI)
    return Score(
        value=float(values.max()),
        status="unreliable",
        reasons=(
            f"optimistic: as published, the maximum over {len(names)} layers and {len(used)} targets (best: "
            f"{used[place].name}; mean of the targets' maxima {values.max(axis=0).mean():.2f})",
            "the published estimator averages zeros of slots that a trial did not show, and knows no gate",
            *notes,
        ),
        r=float(raw[best, place]),
        reliability=corrected[used[place].name].reliability,
        p=test.p,
        p_method=test.summary(0, "maximum over layers and targets taken anew in each"),
        p_smallest=test.smallest,
        layer=names[best],
        layer_rule="maximum over layers and targets on the data that are scored (as published; optimistic)",
        best_layer=names[best],
        best_layer_value=float(values.max()),
        layers=tuple(
            LayerScore(layer, float(values[row, column]), float(raw[row, column]), "unreliable")
            for row, (layer, column) in enumerate(zip(names, values.argmax(axis=1), strict=True))
        ),
        subjects=tuple(
            _part(target, values[row, column], raw[row, column], corrected[target.name].reliability, names[row])
            for column, (target, row) in enumerate(zip(used, values.argmax(axis=0), strict=True))
        ),
        model_rdm=recorded_rdm(layers[best]),
        brain_rdm=recorded_rdm(brain[place]),
        chance=float(null.mean()),
        attainable=1.0,
        **about,
    )


def _part(target: Target, value: float, r: float, reliability: float, layer: str | None = None) -> SubjectScore:
    status = "undefined" if math.isnan(value) else "unreliable"
    return SubjectScore(target.name, float(value), float(r), reliability, status, target.units, target.trials, layer)


def score_published_animals(arrays: Mapping[str, Floats], *, stimuli: Sequence[str], splits: int = SPLITS) -> Score:
    """Score every animal against the units of all others, both sides corrected; the value is the mean over animals."""
    parts = []
    for name, array in arrays.items() if len(arrays) > 1 else ():
        others = concatenate([other for label, other in arrays.items() if label != name])
        animal, rest = _target(name, array, splits), _target(POOL, others, splits)
        # As for models: a split counts where both sides' halves correlate by .5 or more.
        halves = np.where(rest.split_half_r >= THESIS_FILTER, animal.split_half_r, np.nan)
        r = float(_correlations(animal.rdm, rest.rdm))
        corrected = noise_corrected(r, halves, estimator="thesis", other_split_half_r=rest.split_half_r)
        parts.append(_part(animal, corrected.value, r, corrected.reliability))
    defined = [item for item in parts if math.isfinite(item.value)]
    return Score(
        name="animal-to-animal",
        value=float(np.mean([item.value for item in defined])) if defined else math.nan,
        status="unreliable" if defined else "undefined",
        reasons=(
            f"as published: mean over {len(defined)} of {len(arrays)} animals, each against the units of the others",
        ),
        r=float(np.mean([item.r for item in defined])) if defined else math.nan,
        subjects=tuple(parts),
        estimator="thesis",
        stimuli=tuple(map(str, stimuli)),
    )


Named = dict[str, torch.Tensor]
Layers = list[tuple[str, Callable[[torch.Tensor], torch.Tensor]]]


def published_layers(model: nn.Module) -> tuple[str, ...]:
    """Return the names that a network's layers have in the study, from stimulus to output."""
    if not isinstance(model, EncoderAttenderDecoder):
        raise UsageError(
            f"The published readout knows the networks of the study; received {type(model).__name__}. Leave "
            "readout='default' for other models."
        )
    encoder = model.encoder
    if isinstance(encoder, TemporalGraph):
        names = list(encoder.layers)
    elif isinstance(encoder, S4Encoder):
        names = ["enc_s4_emb", *(f"enc_s4_l{index}" for index in range(len(encoder.blocks))), "enc_s4_dec"]
    elif isinstance(encoder, ResNet18Encoder):
        names = [name for name, _ in _resnet_layers(encoder)]
    else:
        raise UsageError(f"The published readout does not know the encoder {type(encoder).__name__}.")
    return (*names, *(name for name, _ in (*_attender_layers(model.attender), *_decoder_layers(model.decoder))))


def published_activations(model: nn.Module, x: torch.Tensor, layers: Collection[str] | None = None) -> Named:
    """Return ``{layer: [B, averaged axis, F]}`` of sweeps [B, T, C, H, W] in SI, by the names of the study."""
    names = published_layers(model)
    check_each("published layer", layers or (), names)
    assert isinstance(model, EncoderAttenderDecoder)
    features, activities = _encode(model, model.normaliser(x), names)
    attended, stream = _through(features, _attender_layers(model.attender))
    if isinstance(model.attender, MambaAttender):
        # What a block adds to the stream, without the stream itself.
        streams = [features, *attended.values()]
        for name, before, after in zip(list(attended)[:-1], streams, streams[1:], strict=False):
            attended[name] = after - before
    elif isinstance(model.attender, GPTAttender):
        stream = stream[:, 1::2]
    stream = stream if isinstance(model.decoder, AllStepsDecoder) else stream[:, -1]
    read, _ = _through(stream, _decoder_layers(model.decoder))
    activities |= attended | {name: value[:, None] for name, value in read.items()}
    return {name: activities[name].flatten(2) for name in names if layers is None or name in layers}


def _encode(model: EncoderAttenderDecoder, x: torch.Tensor, names: Iterable[str]) -> tuple[torch.Tensor, Named]:
    encoder = model.encoder
    if isinstance(encoder, ResNet18Encoder):
        maps, y = _through(x.flatten(0, 1), _resnet_layers(encoder))
        return y.unflatten(0, x.shape[:2]), {name: value.unflatten(0, x.shape[:2]) for name, value in maps.items()}
    if isinstance(encoder, TemporalGraph):
        y, activities = encoder(x, unroll=model.unroll, return_activations=True)
        for name, value in activities.items():
            # A node is read from the step that the first number in its name sets, if the sweep is that long.
            if number := re.search(r"\d+", name):
                activities[name] = value[:, min(max(int(number[0]) - 1, 0), value.shape[1] - 1) :]
        return y, activities
    y, activations = encoder(x, return_activations=True)
    activities = dict(zip(names, activations.values(), strict=False))
    return y, {name: value.transpose(1, 2) if "_l" in name else value for name, value in activities.items()}


def _attender_layers(attender: Attender | None) -> Layers:
    if isinstance(attender, GPTAttender):
        blocks = [(f"att_gpt_b{i}", lambda x, block=block: block(x)[0]) for i, block in enumerate(attender.blocks)]
        embed = ("att_gpt_emb", lambda x: attender.tokens(x, 0))
        return [embed, *blocks, ("att_gpt_ln", attender.norm), ("att_gpt_lm_head", attender.lm_head)]
    if isinstance(attender, MambaAttender):
        blocks = [(f"att_mamba_l{index}", block) for index, block in enumerate(attender.blocks)]
        return [*blocks, ("att_mamba_norm", attender.norm)]
    if attender is not None:
        raise UsageError(f"The published readout does not know the attender {type(attender).__name__}.")
    return []


def _resnet_layers(encoder: ResNet18Encoder) -> Layers:
    stem, fc = list(encoder.conv1), list(encoder.fc)
    blocks = [
        (f"layer{index}.{place}", block)
        for index in range(1, 5)
        for place, block in enumerate(encoder.get_submodule(f"layer{index}").children())
    ]
    ends = [("avgpool", fc[0]), ("fc", nn.Sequential(*fc[1:]))]
    return [("relu", nn.Sequential(*stem[:3])), ("maxpool", stem[3]), *blocks, *ends]


def _decoder_layers(decoder: nn.Module) -> Layers:
    """Return the linear layers, each with the rectifier that follows it."""
    modules = list(decoder.children()) or [decoder]
    if isinstance(decoder, AllStepsDecoder):
        relu, *rest = decoder.rest
        modules = [nn.Sequential(nn.Flatten(1), decoder.first), relu, *rest]
    pairs = [nn.Sequential(*modules[start : start + 2]) for start in range(0, len(modules), 2)]
    return [(f"dec_mlp_l{index}", pair) for index, pair in enumerate(pairs)]


def _through(x: torch.Tensor, layers: Layers) -> tuple[Named, torch.Tensor]:
    activities: Named = {}
    for name, layer in layers:
        x = activities[name] = layer(x)
    return activities, x


@dataclass(frozen=True)
class LayerReadout:
    """How layers are named and read."""

    layers: Callable[[nn.Module], tuple[str, ...]]
    activations: Callable[..., Named]


READOUT = LayerReadout(published_layers, published_activations)  # the published readout, as find_readout gives it


@dataclass(frozen=True)
class Switches:
    """Published faults that are on (True: as published).

    ``best_target``      the maximum over targets (every animal and their pool) is the score
    ``best_layer``       the maximum over layers, on the data that are scored
    ``drop_splits``      splits whose halves correlate below .5 are left out (models), which keeps the lucky ones
    ``median``           ratios are summarised by their median (raw input), by their mean (models): bars of one
                         figure came from two estimators
    ``ratio_per_split``  every split is corrected by its own reliability before averaging; splits with negative
                         reliability have no real value and vanish
    ``negative_pairs``   two negative reliabilities have a positive product and pass
    ``no_gate``          animals are averaged however unreliable they are
    """

    best_target: bool = True
    best_layer: bool = True
    drop_splits: bool = True
    median: bool = False
    negative_pairs: bool = True
    ratio_per_split: bool = True
    no_gate: bool = True


PUBLISHED = Switches()  # the bars of models
PUBLISHED_INPUT = Switches(drop_splits=False, median=True)  # the bar of the raw input
CORRECTED = Switches(*(False for _ in fields(Switches)))
_AVERAGED = "split halves averaged before the correction instead of after"


@dataclass(frozen=True)
class WalkStep:
    """One line of the walk."""

    change: str
    """The switch, in words."""
    value: float
    status: Status
    detail: str
    """Number of splits and animals that entered, or why there is no value."""
    switches: Switches


def corrected_value(
    r_xy: ArrayLike, r_yy: ArrayLike, switches: Switches, *, r_xx: ArrayLike | None = None
) -> tuple[float, int]:
    """Return one comparison corrected for noise under the switches, and the splits that entered.

    ``r_xy`` is the raw comparison [S] or a number, ``r_yy`` are the raw split-half comparisons [S] of the brain and
    ``r_xx`` those of the other side; 1 (a model) by default. Of the switches ``drop_splits``, ``median``,
    ``negative_pairs`` and ``ratio_per_split`` matter here.
    """
    halves = np.asarray(r_yy, dtype=np.float64).ravel()
    others = np.ones(len(halves)) if r_xx is None else np.broadcast_to(np.asarray(r_xx, dtype=np.float64), halves.shape)
    raw = np.broadcast_to(np.asarray(r_xy, dtype=np.float64), halves.shape)
    # Splits without a correlation (a half with a flat RDM) have no say under any switch.
    keep = np.isfinite(halves) & np.isfinite(others) & np.isfinite(raw)
    if switches.drop_splits:
        keep &= halves >= THESIS_FILTER
    if not keep.any():
        return math.nan, 0
    if not switches.ratio_per_split:
        # The default: splits are averaged before one ratio is formed.
        sides = [float(spearman_brown(side[keep].mean())) for side in (halves, others)]
        value = float(raw[keep].mean()) / math.sqrt(math.prod(sides)) if min(sides) > 0 else math.nan
        return value, int(keep.sum())
    ratios = corrected_splits(raw[keep], halves[keep], others[keep])
    real = ratios[np.isfinite(ratios) & (switches.negative_pairs | (halves[keep] > 0))]
    if not real.size:
        return math.nan, 0
    return float(np.median(real) if switches.median else real.mean()), real.size


def add_walk(inputs: Any, *, progress: Progress | None = None) -> dict[str, Any]:
    """Return what ``--explain-estimator`` adds to the statistics of a record.

    ``inputs`` are those of :class:`brainbench.scoring.scores.ScoreInputs`.
    """
    rdms = {layer: rdm(values) for layer, values in inputs.features.items()}
    return {"estimator_walk": to_plain(explain_score(rdms, inputs.animals))}


def explain_file(path: str | Path) -> tuple[WalkStep, ...]:
    """Walk through the split halves in an ``.npz`` file: arrays ``r_xy``, ``r_yy`` and maybe ``r_xx``."""
    arrays = read_npz(path, ".npz file of plain arrays")
    if missing := {"r_xy", "r_yy"} - arrays.keys():
        raise DataError(f"{path} lacks the array {sorted(missing)[0]!r}; it has {sorted(arrays)}.")
    for name in ("r_xy", "r_yy", "r_xx"):
        array = arrays.get(name, np.zeros(()))
        fits = array.ndim == 0 or array.shape == (arrays["r_yy"].size,)
        if array.dtype.kind not in "fiu" or not fits or (np.abs(array) > 1 + 1e-6).any():
            raise DataError(
                f"{name!r} in {brief(str(path))} is {list(array.shape)} of {array.dtype}; needed are as many "
                "correlations (-1 to 1, NaN for none) as 'r_yy' has."
            )
    return explain_splits(arrays["r_xy"], arrays["r_yy"], r_xx=arrays.get("r_xx"))


def explain_splits(r_xy: ArrayLike, r_yy: ArrayLike, *, r_xx: ArrayLike | None = None) -> tuple[WalkStep, ...]:
    """Walk through stored split halves of one model and one target, from the published bars to the default.

    Arguments are those of :func:`corrected_value`.
    """
    halves = np.asarray(r_yy, dtype=np.float64).ravel()
    if not np.isfinite(halves).any():
        raise UsageError("There are no split halves to explain; give r_yy with one correlation per split.")
    reliability = float(spearman_brown(halves[np.isfinite(halves)].mean()))
    negative = int((halves < 0).sum())
    walk = (
        ("as published for the raw input: median of the splits' ratios", PUBLISHED_INPUT),
        ("mean instead of median of the ratios", Switches(drop_splits=False)),
        (f"splits with a raw correlation below {THESIS_FILTER} left out: as published for models", PUBLISHED),
        (
            "all splits again, two negative reliabilities no longer pass",
            Switches(drop_splits=False, negative_pairs=False),
        ),
        (_AVERAGED, replace(CORRECTED, no_gate=True)),
    )
    steps = []
    for change, switches in walk:
        value, used = corrected_value(r_xy, halves, switches, r_xx=r_xx)
        detail = f"{used:,} of {len(halves):,} splits"
        if switches.ratio_per_split and not switches.drop_splits:
            detail += f"; {negative} with negative reliability have no real ratio and vanish"
        steps.append(WalkStep(change, value, "ok" if math.isfinite(value) else "undefined", detail, switches))
    value, status = steps[-1].value, "ok" if reliability >= RELIABILITY_GATE else "unreliable"
    detail = f"reliability {reliability:.2f}"
    if not reliability > 0:
        value, status = math.nan, "undefined"
    elif status == "ok":
        detail += f" is at least {RELIABILITY_GATE}"
    else:
        detail += f" is below {RELIABILITY_GATE}: no correction of these data is trustworthy"
    return (*steps, WalkStep("gate on reliability: the default", value, status, detail, CORRECTED))


def explain_score(layer_rdms: Mapping[str, ArrayLike], subjects: Sequence[SubjectRDM]) -> tuple[WalkStep, ...]:
    """Walk a model's score from the published estimator to the default one, on the same RDMs, by Pearson's r.

    The published pool of all animals' units is represented by their mean RDM and halves.
    """
    rdms = rdm_stack(list(layer_rdms.values()), "layer_rdms")
    rdms = rdms[~is_flat(rdms)]
    animals = gather(RSA(comparison="pearson"), subjects, stimulus_count(rdms.shape[-1]), estimator="thesis-input")
    # Without the published estimators' own demands: whoever has an RDM takes part.
    usable = [subject for subject in animals.subjects if subject.problem is None and not is_flat(subject.rdm)]
    if not len(rdms) or not usable:
        raise UsageError("There is nothing to explain: no layer or no animal has a usable RDM.")
    averaged = replace(PUBLISHED, best_target=False)
    unfiltered = replace(averaged, drop_splits=False)
    walk = (
        ("as published: maximum over layers and over targets", PUBLISHED),
        ("mean over animals instead of the best target", averaged),
        ("no split is left out", unfiltered),
        ("two negative reliabilities no longer pass", replace(unfiltered, negative_pairs=False)),
        (_AVERAGED, replace(CORRECTED, best_layer=True, no_gate=True)),
        (f"animals with a reliability below {ANIMAL_GATE} left out", replace(CORRECTED, best_layer=True)),
        ("layer chosen on the other animals: the default", CORRECTED),
    )
    return tuple(_step(change, switches, rdms, usable) for change, switches in walk)


def _step(change: str, switches: Switches, rdms: Floats, subjects: list[SubjectRDM]) -> WalkStep:
    targets = [(subject.subject, subject.rdm, subject.split_half_by("pearson")) for subject in subjects]
    if not switches.no_gate:
        trusted = [float(spearman_brown(r[np.isfinite(r)].mean())) >= ANIMAL_GATE for _, _, r in targets]
        targets = [target for target, keep in zip(targets, trusted, strict=True) if keep]
    if switches.best_target and len(subjects) > 1:
        # The published pool joined units, which are not kept here; the animals' mean RDM stands for it.
        splits = min(len(subject.halves) for subject in subjects)
        halves = np.mean([subject.halves[:splits] for subject in subjects], axis=0)
        # Halves are averaged split by split over animals, so the pool's halves hold different trials too.
        agreement = compare(halves[:, 0], halves[:, 1])
        targets.append(("the pool", np.mean([subject.rdm for subject in subjects], axis=0), agreement))
    if not targets:
        return WalkStep(change, math.nan, "undefined", "no animal is reliable", switches)
    r = compare(rdms[:, None], np.stack([target[1] for target in targets])[None])
    # A correction is a factor of the raw comparison: one per target.
    corrections = [corrected_value(1.0, target[2], switches) for target in targets]
    factors = np.array([item[0] for item in corrections])
    finite = np.isfinite(factors)
    if not finite.any():
        return WalkStep(change, math.nan, "undefined", "no split half has a positive reliability", switches)
    names = [target[0] for target, keep in zip(targets, finite, strict=True) if keep]
    used = sum(item[1] for item in corrections)
    values = (r * factors)[:, finite]
    detail = f"{len(names)} of {len(targets)} targets, {used:,} splits"
    if switches.best_target:
        place = int(np.argmax(values.max(axis=0)))
        return WalkStep(change, float(values.max()), "ok", f"{detail}; the best is {names[place]}", switches)
    if switches.best_layer or len(rdms) == 1:
        return WalkStep(change, float(values.mean(axis=1).max()), "ok", detail, switches)
    if len(names) == 1:
        return WalkStep(
            change, math.nan, "undefined", "one animal: the default chooses on halves of its trials", switches
        )
    value = float((held_out(r[:, finite]) * factors[finite]).mean())
    return WalkStep(change, value, "ok", detail, switches)
