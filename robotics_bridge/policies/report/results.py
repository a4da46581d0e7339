"""Compare distilled students: success with intervals over seeds, per task, observation type and encoder.

A student's folder holds ``evaluation.json``: a list of evaluations, one per evaluation seed, each with ``seed`` and, as
one number per episode, ``success``, ``metric`` and, where hardly any episode succeeds, more telling: ``goals`` reached,
``turn_rate`` about the commanded axis (rad/s), ``seconds`` until the object dropped, ``returns``. Students that differ
only in their training seed belong together.
"""

from __future__ import annotations

import logging
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from brainbench.core.errors import DataError, DataFileNotFoundError, shown
from brainbench.core.files import read_json
from brainbench.core.reading.regular import reason
from brainbench.core.records import Interval
from brainbench.core.statistics import newcombe_interval, t_interval, wilson_interval
from robotics_bridge.policies.contrasts import MixedModel, TrainedPolicy
from robotics_bridge.policies.evaluate import mean_of_episodes
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.task import TASK_VERSION

_LOG = logging.getLogger(__name__)

EVALUATION, AGENTS = "evaluation.json", "agents.json"
"""Of a student; of the teacher and the agents that do nothing and anything, as ``policy evaluate --out`` writes it."""
GRADED = ("metric", "goals", "turn_rate", "seconds", "returns", "dropped")
"""Quantities of an episode beside its success."""
STOPPED = "stopped after"
_DRAWN = ("seed", "pretrained", "calibration")
"""Settings of an encoder that differ between its draws, or were measured in each run."""
_FREE = {"seed", "teacher", "iterations", "save_interval"}
"""Settings in which students of one arm may differ; of how many iterations they learned the report tells."""
FEWEST_SEEDS = 3
"""Training seeds below which an interval says little about a new student."""

_Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
_Count = Annotated[int, msgspec.Meta(ge=0)]
_Number = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)] | None
_Success = Annotated[list[_Share | bool], msgspec.Meta(min_length=1)]
_Evaluation = msgspec.defstruct(
    "_Evaluation",
    [("seed", _Count), ("success", _Success), ("iterations", _Count | None, None)]
    + [(name, list[_Number | bool] | None, None) for name in GRADED],
)
_Agent = msgspec.defstruct(
    "_Agent",
    [("agent", str), ("task", str), ("success_rate", _Share), ("success_interval", tuple[_Share, _Share])]
    + [(name + end, _Number, None) for name in GRADED for end in ("", "_half_width")],
)


@dataclass(frozen=True)
class LeftOut:
    """An evaluated student that a result does not count."""

    seed: int
    """Training seed."""
    iterations: int | None
    """That it learned; None where it is not said."""
    reason: str


@dataclass(frozen=True)
class StudentResult:
    """Students that differ in their training seed only."""

    config: DistillConfig
    """Configuration of the first of them."""
    seeds: tuple[int, ...]
    """Training seed of each student; several may have the same, with another draw of their encoder."""
    success: tuple[float, ...]
    """Share of successful episodes of each student."""
    episodes: int
    """In all."""
    metric: float
    """Mean of the task's own metric."""
    interval: Interval | None
    """Interval of the mean success."""
    note: str
    """Note on what the interval does not cover; empty if nothing."""
    gain: float | None = None
    """Success beyond that of ``none``, over training seeds in common."""
    difference: Interval | None = None
    """Interval of the gain; with one training seed in common it covers chance in evaluation alone."""
    graded: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Quantity of :data:`GRADED` → mean over all episodes and half width of its 95 % interval: t over training seeds,
    with one training seed normal over episodes."""
    iterations: int | None = None
    """Fewest that any of the students learned."""
    learned: tuple[int | None, ...] = ()
    """Iterations that each of the students learned, in the order of their seeds; None where it is not said."""
    left_out: tuple[LeftOut, ...] = ()
    """Evaluated students of this group that do not count, and why."""
    configs: tuple[DistillConfig, ...] = ()
    """Configuration of each student."""

    @property
    def name(self) -> str:
        """Name without the seed."""
        return self.config.name.rpartition("_seed")[0]

    @property
    def value(self) -> float:
        """Mean success."""
        return float(np.mean(self.success))

    @property
    def nested(self) -> bool:
        """Whether some of the students share a training seed or, of several, a draw, so that they are no repeats."""
        draws = [config.draw for config in self.configs if config.draw is not None]
        return len(set(self.seeds)) < len(self.seeds) or 1 < len(set(draws)) < len(draws)

    @property
    def world(self) -> tuple[str, str, str]:
        """Task, hand and contacts: results of different worlds are not compared."""
        return self.config.task, self.config.hand, self.config.contacts or "–"


def read_results(folders: Iterable[str | Path], *, at_least: int = 0) -> list[StudentResult]:
    """Return the results of all evaluated students below some folders, best first within each task, hand and contacts.

    Where a student was trained more than once with the same training seed and draw of its encoder, the one that learned
    longest counts: two runs of one seed are no two seeds. Students of another version of the tasks are left out, and
    those that learned fewer iterations than ``at_least``; those that do not say how many stay. Where students of an
    arm share draws or seeds, its interval is that of :func:`mixed_model`.

    Raises:
        DataFileNotFoundError: no student was evaluated there, or none of them learned so long.
    """
    groups: dict[str, list[_Member]] = defaultdict(list)
    for root in folders:
        for path in sorted(Path(root).rglob(EVALUATION)):
            described = read_json(path.parent / "config.json")
            if not isinstance(described, dict) or not isinstance(described.get("distill"), dict):
                continue
            if described.get("task_version", 1) != TASK_VERSION:
                _LOG.warning("%s is of another version of the tasks, and left out.", path.parent)
                continue
            config = DistillConfig.of(described["distill"])
            evaluations = _listed(path, _Evaluation, "evaluations with 'seed' and 'success'")
            groups[config.name.rpartition("_seed")[0]].append(_Member(config, tuple(evaluations)))
    if not groups:
        raise DataFileNotFoundError(
            "No evaluated student was found; brainbench policy distill evaluates what it has trained."
        )
    for name, members in groups.items():
        _check_same(name, members)
    results = [result for members in groups.values() if (result := _result(*_counted(members, at_least))) is not None]
    if not results:
        longest = max(member.learned or 0 for members in groups.values() for member in members)
        raise DataFileNotFoundError(
            f"None of the students learned {at_least} iterations; the longest that any did is {longest}."
        )
    nested = {result.world for result in results if result.nested}
    models = {world: mixed_model([r for r in results if r.world == world]) for world in nested}
    results = [
        replace(r, interval=_share(models[r.world].mean(r.name).interval or r.interval)) if r.nested else r
        for r in results
    ]
    # With memory and without, the better of the two is what touch has to beat.
    bare = {r.world: r for r in sorted(results, key=lambda r: r.value) if r.config.observe == "none"}
    found = [_against(result, bare.get(result.world)) for result in results]
    return sorted(found, key=lambda r: (r.world, -r.value, r.config.name))


def mixed_model(results: Sequence[StudentResult]) -> MixedModel:
    """Return the model of students of one task, hand and contacts, whose arms are their names without the seed."""
    found = [
        TrainedPolicy(result.name, share, config.seed, config.draw)
        for result in results
        for share, config in zip(result.success, result.configs, strict=True)
    ]
    return MixedModel(tuple(found))


@dataclass(frozen=True)
class _Member:
    config: DistillConfig
    evaluations: tuple[dict[str, Any], ...]

    @property
    def learned(self) -> int | None:
        """Iterations; None where no evaluation says how many."""
        return min((item["iterations"] for item in self.evaluations if item.get("iterations")), default=None)


def _check_same(name: str, members: Sequence[_Member]) -> None:
    """Check that students of one name differ in nothing but seed, draw and what does not reach their weights."""
    told = [asdict(member.config) for member in members]
    for plain in told:
        own = plain.pop("encoder_settings")
        plain |= {f"encoder_settings.{key}": own[key] for key in own if key not in _DRAWN}
    for key in sorted({key for plain in told for key in plain} - _FREE):
        values = {shown(plain.get(key)): None for plain in told}
        if len(values) > 1:
            raise DataError(
                f"Students of the arm {name!r} differ in {key!r} ({', '.join(values)}), so they are no seeds of one "
                "arm; report their folders one at a time."
            )


def _counted(members: Sequence[_Member], at_least: int) -> tuple[list[_Member], tuple[LeftOut, ...]]:
    """Return one student per training seed and draw, by seed, and the others."""
    best: dict[tuple[int, str], _Member] = {}
    others = []
    for member in sorted(members, key=lambda member: -(member.learned or 0)):
        seed, learned = member.config.seed, member.learned
        if learned is not None and learned < at_least:
            others.append(LeftOut(seed, learned, f"fewer than {at_least}"))
        elif (cell := (seed, member.config.draw or "")) in best:
            others.append(LeftOut(seed, learned, f"trained once more, for {best[cell].learned}"))
        else:
            best[cell] = member
    return [best[cell] for cell in sorted(best)], tuple(others)


def _listed(path: Path, kind: type, what: str) -> list[dict[str, Any]]:
    """Return the items of a list in a file, checked against a structure; fields that it does not name are kept."""
    found = read_json(path)
    try:
        msgspec.convert(found, Annotated[list[kind], msgspec.Meta(min_length=1)])
    except msgspec.ValidationError as error:
        raise DataError(f"{shown(str(path))} is no list of {what} ({reason(error)}).") from error
    return found


def _result(members: Sequence[_Member], left_out: tuple[LeftOut, ...]) -> StudentResult | None:
    if not members:
        return None
    shares = [float(np.mean([np.mean(item["success"]) for item in member.evaluations])) for member in members]
    graded = {name: found for name in GRADED if (found := _grade(members, name)) is not None}
    episodes = sum(len(item["success"]) for member in members for item in member.evaluations)
    interval = t_interval(shares, over="training seeds")
    first, seeds = members[0].config, tuple(member.config.seed for member in members)
    note = "" if len(set(seeds)) >= FEWEST_SEEDS else f"only {len(set(seeds))} training seeds"
    if len(members) == 1:
        note = "one training seed: the interval covers chance in evaluation alone"
    if interval is None or len(set(shares)) == 1:
        # Equal shares, such as no success at all, tell nothing of their spread.
        interval = wilson_interval(float(np.mean(shares)) * episodes, episodes, over="episodes")
    metric = graded.get("metric", (math.nan, math.nan))[0]
    learned = tuple(member.learned for member in members)
    fewest = min((number for number in learned if number is not None), default=None)
    if fewest is not None and first.iterations is not None and fewest < first.iterations:
        note = "; ".join(filter(None, (note, f"{STOPPED} {learned_of(learned)} of {first.iterations} iterations")))
    return StudentResult(
        first, seeds, tuple(shares), episodes, metric, _share(interval), note, graded=graded, iterations=fewest,
        learned=learned, left_out=left_out, configs=tuple(member.config for member in members),
    )  # fmt: skip


def _share(interval: Interval | None) -> Interval | None:
    """Return the interval of a share, which lies within 0 and 1; of few seeds a t interval goes beyond."""
    return interval and replace(interval, low=max(interval.low, 0.0), high=min(interval.high, 1.0))


def learned_of(learned: Iterable[int | None]) -> str:
    """Return the fewest and the most iterations that some students learned; empty where none is said."""
    numbers = sorted({number for number in learned if number is not None})
    return " to ".join(str(number) for number in numbers[:: max(len(numbers) - 1, 1)])


def _grade(members: Sequence[_Member], name: str) -> tuple[float, float] | None:
    """Return the mean of a quantity and the half width of its interval; None where no student tells of it."""
    told = [[np.asarray(item.get(name) or [], dtype=float) for item in member.evaluations] for member in members]
    seeds = [found[np.isfinite(found)] for found in map(np.concatenate, told)]
    values = np.concatenate(seeds)
    if not len(values):
        return None
    over = t_interval([float(found.mean()) for found in seeds if len(found)])
    if over is not None:
        return float(values.mean()), (over.high - over.low) / 2
    return mean_of_episodes(values) if len(values) > 1 else (float(values.mean()), math.nan)


def _against(result: StudentResult, bare: StudentResult | None) -> StudentResult:
    if bare is None or bare is result:
        return result
    own, other = (_by_seed(r) for r in (result, bare))
    common = sorted(set(own) & set(other))
    if not common:
        return result
    gains = [own[seed] - other[seed] for seed in common]
    interval = t_interval(gains, over="paired training seeds")
    if len(common) == 1:
        count, others = (r.episodes // len(r.seeds) for r in (result, bare))
        share, bare_share = own[common[0]], other[common[0]]
        interval = newcombe_interval(share * count, count, bare_share * others, others, over="episodes")
    return replace(result, gain=float(np.mean(gains)), difference=interval)


def _by_seed(result: StudentResult) -> dict[int, float]:
    """Return the mean success of each training seed, over the draws of the encoder."""
    pairs = list(zip(result.seeds, result.success, strict=True))
    return {seed: float(np.mean([share for other, share in pairs if other == seed])) for seed in result.seeds}


def read_agents(folders: Iterable[str | Path]) -> list[dict[str, Any]]:
    """Return what stands in the files :data:`AGENTS` below some folders: one summary per agent and task."""
    files = [path for root in folders for path in sorted(Path(root).rglob(AGENTS))]
    what = "evaluated agents; brainbench policy evaluate --out writes one"
    return [summary for path in files for summary in _listed(path, _Agent, what)]
