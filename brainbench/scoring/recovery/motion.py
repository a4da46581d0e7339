"""Choose how to whisk, or where to hold objects, so that two networks are told apart best.

A recovery compares a network with animals by the whitened cosine of RDMs of squared distances, which is the linear
centred kernel alignment (CKA) of their responses (Diedrichsen et al. 2020, arXiv 2007.02789). The less alike two
networks are by it, the larger the lead of the true one on a board, at equal noise; so 1 − CKA is raised, by its
gradient where both networks can be differentiated: through the network by PyTorch, and through the simulation by
:mod:`brainbench.stimuli.fitting.gradients`. Every other object is searched on. For the others animals are drawn from
each network as for boards, which say what the motion is worth. Search and gradients lie in the optional folder
``brainbench/stimuli/fitting``. Letters: K stimulus, F feature, p variable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import GRID_SHAPE, SUB_STEPS
from brainbench.core.errors import DataError, UsageError, check_number
from brainbench.core.plugins import OptionalPart
from brainbench.core.records import Interval, Status
from brainbench.core.statistics import t_interval
from brainbench.metrics.measures.metric import get_metric
from brainbench.metrics.measures.patterns import LinearCKA
from brainbench.scoring.model_responses import ResolvedModel, resolve_model, takes_si
from brainbench.scoring.options import ScoreOptions
from brainbench.scoring.recovery.boards import SMALLEST_RDM, Candidate, RecoveryDesign
from brainbench.scoring.recovery.selection import Margins
from brainbench.stimuli import Scene, load_stimuli, simulate
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity

Array = NDArray[np.float64]
FINER = 5  # divisor of the time step for a gradient of whiskers that cannot be trusted
BOARDS = 10  # boards of each network on which motions are compared


@dataclass(frozen=True)
class NetworkDesign:
    """The chosen motion, and how well it tells two networks apart."""

    status: Status
    """``unreliable``: on other objects and animals the lead does not surely grow; ``undefined``: there is none."""
    reason: str
    values: Mapping[str, float]
    """Chosen values, in their units."""
    start: Mapping[str, float]
    layers: Mapping[str, str]
    """Layer of each network that is compared."""
    search: str
    """``gradient``, or ``trials`` where a network cannot be differentiated."""
    contrast: tuple[float, float]
    """1 − similarity (CKA) of the networks' responses to the objects of the search: given, chosen motion."""
    held_out: tuple[float, float]
    """The same on the other objects."""
    leads: tuple[float, float]
    """Mean lead of the true network over the other in scores, on animals drawn for the other objects."""
    gain: Interval | None
    """Of the difference of the leads, over boards with the same noise."""
    won: tuple[float, float]
    """Share of these boards that the true network wins."""
    scenes: tuple[Scene, ...] = field(repr=False)
    """All scenes with the chosen motion."""
    evaluations: int = 0
    """Motions that were simulated in the search."""


def design_for_networks(
    scenes: Sequence[Scene],
    networks: Sequence[Any],
    variables: Sequence[str],
    *,
    options: Any = None,
    study: RecoveryDesign | None = None,
    boards: int = BOARDS,
    backend: str = DEFAULT_ENGINE,
) -> NetworkDesign:
    """Choose the motion with which two networks are told apart best.

    Args:
        scenes: the same whiskers and motion, each with another object; at least eight, every other one is held out.
        networks: two models as :func:`brainbench.score` takes them; no files of activations.
        variables: names of :data:`brainbench.stimuli.fitting.design.VARIABLES`.
        options: ``brainbench.stimuli.fitting.design.DesignOptions``, search and simulation; noise and rate of its
            sensor do not count, the noise is that of animals.
        study: animals that are drawn to compare motions; its layer is that of networks that commit to none: ``any``
            and ``last`` stand for the last.
        boards: boards of each network on which motions are compared, at least 2.
        backend: physics engine.
    """
    search = _search()
    options, study = options or search.DesignOptions(), replace(study or RecoveryDesign(), stimuli=None)
    check_number("number of scenes, half of which are held out,", len(scenes), least=2 * SMALLEST_RDM)
    if len(networks) != 2:
        raise UsageError(f"A design tells two networks apart; received {len(networks)}.")
    begin, limits = search.read_limits(scenes, variables, {})
    models = [_Network.of(model, study.layer) for model in networks]
    if models[0].name == models[1].name:
        raise UsageError(f"The network {models[0].name!r} is given twice; give two different ones.")
    names = tuple(variables)
    evaluator = _Evaluator(scenes[::2], names, models, options.fidelity, backend)
    slope = evaluator.slope if evaluator.differentiable else None
    points = search.find_motions(evaluator.worths, slope, begin, limits, options)
    # What is best at the coarse setting need not be at the finer one, which has the last word.
    fine = _Evaluator(scenes[::2], names, models, options.check, backend)
    held_out = _Evaluator(scenes[1::2], names, models, options.check, backend)
    if held_out.features(begin) is None:
        raise DataError("Whiskers are unstable with the given motion; simulate the scenes more finely.")
    worths = np.nan_to_num(fine.worths(points), nan=-math.inf)
    order = np.argsort(-worths, kind="stable").tolist()
    chosen = next(points[index] for index in order if held_out.features(points[index]) is not None)
    margins = [held_out.margins(point, study, boards) for point in (begin, chosen)]
    gain = t_interval(margins[1] - margins[0], over="boards")
    status, reason = _judge(gain, bool(np.array_equal(begin, chosen)))
    first, last = (fine.contrast(point) for point in (begin, chosen))
    return NetworkDesign(
        status=status,
        reason=reason,
        values=dict(zip(variables, chosen.tolist(), strict=True)),
        start=dict(zip(variables, begin.tolist(), strict=True)),
        layers={model.name: model.layer for model in models},
        search="gradient" if evaluator.differentiable else "trials",
        contrast=(first, last),
        held_out=(held_out.contrast(begin), held_out.contrast(chosen)),
        leads=(float(margins[0].mean()), float(margins[1].mean())),
        gain=gain,
        won=(float((margins[0] > 0).mean()), float((margins[1] > 0).mean())),
        scenes=tuple(search.changed(scene, names, chosen) for scene in scenes),
        evaluations=evaluator.count,
    )


def _search() -> Any:
    """Return the module that searches for motions."""
    return OptionalPart("", "motions", "brainbench.stimuli.fitting.design").load("search for")


def _judge(gain: Interval | None, same: bool) -> tuple[Status, str]:
    """Return the status of a design, and why."""
    if gain is None:
        return "undefined", "A network responds alike to all held-out objects, so that nothing tells the two apart."
    if same:
        return "unreliable", "Nothing was gained: at the finer setting no motion was better than the given one."
    if not gain.low > 0:
        return "unreliable", "Nothing was gained that holds for other objects and animals; the interval contains zero."
    return "ok", ""


@dataclass(frozen=True)
class _Network:
    """A network and the layer that is compared."""

    name: str
    model: ResolvedModel
    layer: str
    read: Callable[[Any], Mapping[str, Any]] | None
    """Activations of the layer [K, T, …] of an input, which PyTorch can differentiate; None where it cannot."""

    @classmethod
    def of(cls, model: Any, layer: str) -> _Network:
        """Find a network; the layer is the one it commits to, or else the one asked for."""
        from brainbench.models.activations import named_reader
        from brainbench.models.proof import named_layers

        resolved = resolve_model(model)
        if resolved.module is None:
            raise UsageError(
                f"{resolved.card.name} is a file of activations and cannot be run on other motions; give the network."
            )
        layers = named_layers(resolved.module)
        chosen = resolved.card.layer if layer in ("any", "last") else layer
        if chosen is None:
            if not layers:
                raise UsageError(f"{resolved.card.name} commits to no layer and names none; choose one with --layer.")
            chosen = layers[-1]
        # Other modules are read by hooks, which keep no gradient.
        read = named_reader(resolved.module, (chosen,)) if takes_si(resolved.module) else None
        return cls(resolved.card.name, resolved, chosen, read)

    def features(self, dataset: Any) -> Array:
        """Return the responses [K, F] to a stimulus set, averaged over time."""
        responses = self.model.respond(
            ScoreOptions(stimuli=load_stimuli(dataset), layers=(self.layer,), layer=self.layer)
        )
        return responses.features(list(range(len(responses.labels))))[self.layer].astype(float)


class _Evaluator:
    """How unlike two networks respond to the objects of scenes, at values of the variables."""

    def __init__(
        self, scenes: Sequence[Scene], names: tuple[str, ...], networks: Sequence[_Network], fidelity: str, backend: str
    ) -> None:
        self.scenes, self.names, self.networks, self.backend = list(scenes), names, networks, backend
        self.search, self.engine = _search(), get_engine(backend)
        twist = self.engine.twists and any(scene.twist for scene in scenes)
        self.fidelity = Fidelity.of(fidelity).resolved(twist)
        frames = scenes[0].frames
        plain = frames.lowpass is None and frames.clip is None and frames.axes == "world" and not scenes[0].others
        self.differentiable = plain and all(network.read for network in networks)
        self.count = 0
        self._kept: dict[bytes, list[Array] | None] = {}

    def worths(self, points: Sequence[Array]) -> list[float]:
        """Return log(1 − CKA) at each of some values; NaN with unstable whiskers."""
        self.count += len(points)
        return [math.log(max(value, math.exp(self.search.NOTHING))) for value in map(self.contrast, points)]

    def contrast(self, values: Array) -> float:
        """Return 1 − CKA at some values; 0 where a network responds alike to all, NaN with unstable whiskers."""
        responses = self.features(values)
        if responses is None:
            return math.nan
        alike = LinearCKA().similarity(*responses)
        return 0.0 if math.isnan(alike) else 1 - alike

    def features(self, values: Array) -> list[Array] | None:
        """Return the responses [K, F] of both networks at some values; None with unstable whiskers."""
        key = values.tobytes()
        if key not in self._kept:
            some = [self.search.changed(scene, self.names, values) for scene in self.scenes]
            dataset = simulate(some, fidelity=self.fidelity, backend=get_engine(self.backend), cache=False)
            sound = bool((dataset["status"].values == "ok").all())
            self._kept[key] = [network.features(dataset) for network in self.networks] if sound else None
        return self._kept[key]

    def slope(self, values: Array, scales: Array) -> tuple[float, Array]:
        """Return log(1 − CKA) at some values [p], and its derivatives by them; NaN and 0 with unstable whiskers."""
        import torch

        from brainbench.models.activations import evaluating

        self.count += 1
        nothing = np.zeros(len(values))
        # As the engine does, steps are taken finer where a whisker cannot be trusted.
        for finer in (1, FINER):
            fidelity = replace(self.fidelity, time_step=self.fidelity.time_step / finer)
            run = self.search.GradientRun(self._jobs, values, scales=scales, fidelity=fidelity)
            if all(trace.status == "ok" for trace in run.traces):
                break
        else:
            return math.nan, nothing
        readings = np.stack([trace.wrench for trace in run.traces])
        wrench = torch.tensor(readings, dtype=torch.float64, requires_grad=True)
        grid = self._input(wrench)
        grams = []
        for network in self.networks:
            assert network.read is not None
            assert network.model.module is not None
            like = next(network.model.module.parameters())
            with evaluating(network.model.module):
                response = network.read(grid.to(like.device, like.dtype))[network.layer].cpu().double()
            response = response.mean(dim=1).flatten(1)
            centred = response - response.mean(dim=0)
            grams.append(centred @ centred.T)
        apart = 1 - (grams[0] * grams[1]).sum() / (grams[0].norm() * grams[1].norm())
        if not apart.item() > math.exp(self.search.NOTHING):
            return self.search.NOTHING, nothing
        worth = apart.log()
        (by_wrench,) = torch.autograd.grad(worth, wrench)
        return worth.item(), run.gradient(list(by_wrench.numpy())).values

    def margins(self, values: Array, study: RecoveryDesign, boards: int) -> Array:
        """Return the leads of the true network at some values [2 boards]; NaN where there are none."""
        responses = self.features(values)
        if responses is None or not all(np.ptp(some, axis=0).any() for some in responses):
            return np.full(2 * boards, math.nan)
        labels = [scene.label for scene in self.scenes]
        candidates = [
            Candidate.of(network.name, labels, {network.layer: some})
            for network, some in zip(self.networks, responses, strict=True)
        ]
        design = replace(study, layer="last")
        return Margins(candidates, design, get_metric(design.metric), boards)(np.arange(len(labels)))

    def _jobs(self, values: Array) -> list[Any]:
        return [job for scene in self.scenes for job in self.search.changed(scene, self.names, values).jobs()]

    def _input(self, wrench: Any) -> Any:
        """Return the networks' input [K, T, S·C, H, W] of readings [K·whisker, n, 6] in the frames of the jobs.

        As simulated stimuli are read (:mod:`brainbench.stimuli.simulation`), by operations that PyTorch differentiates.
        """
        import torch

        scene, frames = self.scenes[0], self.scenes[0].frames
        count, whiskers = len(self.scenes), len(scene.names)
        turn = torch.tensor(scene.head.matrix)
        means = wrench.reshape(count, whiskers, frames.count, frames.average, 2, 3).mean(dim=3) @ turn.T
        cells = torch.tensor([mount.row * GRID_SHAPE[1] + mount.col for mount in scene.mounts])
        grid = torch.zeros(count, frames.count, 6, GRID_SHAPE[0] * GRID_SHAPE[1], dtype=wrench.dtype)
        grid = grid.index_copy(3, cells, means.flatten(3).permute(0, 2, 3, 1))
        return grid.reshape(count, frames.count // SUB_STEPS, SUB_STEPS * 6, *GRID_SHAPE)
