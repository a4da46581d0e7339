"""Distinct jobs of some scenes, and the work that their simulation did and could leave out.

Told are whisker runs, time steps, contact pairs and seconds.

A *run* is one whisker in one stimulus. Runs that cannot differ are simulated once and shared; runs that
cannot feel anything are not simulated. A contact *pair* is one link of a whisker against one convex part of
an object, or against one triangle where the engine touches surfaces: what it has to tell apart in every step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import content_hash
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.reach import Reach, reachable
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.motion.trajectories import Still
from brainbench.stimuli.objects.solid import Solid
from brainbench.stimuli.scenes.scene import Scene

if TYPE_CHECKING:
    import xarray as xr

SAMPLING = 1000.0
"""Instants per second at which reach is judged; what moves in between counts as an error bound."""


@dataclass(frozen=True, eq=False)
class JobSchedule:
    """Distinct jobs of some scenes, and where each whisker of each scene finds its trace."""

    jobs: tuple[Job, ...]
    """Jobs to run: a whisker that reaches no object does the same in every scene with the same motion."""
    places: tuple[tuple[int, ...], ...]
    """[scene][whisker] index into ``jobs``."""
    reaches: tuple[tuple[Reach, ...], ...]
    """[scene][whisker] what of its scene the whisker could ever touch."""
    surfaces: bool = False
    """True for an engine that touches exact surfaces where there are some, instead of convex parts."""


def plan(scenes: Sequence[Scene], *, surfaces: bool = False) -> JobSchedule:
    """Find the distinct jobs of ``scenes``, for an engine that touches exact ``surfaces`` or convex parts."""
    distinct: dict[str, int] = {}
    jobs: list[Job] = []
    places, reaches = [], []
    for scene in scenes:
        row, near = [], []
        digests: dict[tuple[int, bool], str] = {}
        owners = [part for part in scene.split() for _ in part.array]
        for mount, owner, job in zip(scene.mounts, owners, scene.jobs(), strict=True):
            reach = reach_of(job, surfaces=surfaces)
            travels = not isinstance(owner.head.motion, Still)
            # Of one animal the whiskers differ by their mounts alone, and a scene may have a thousand objects.
            what = id(owner), bool(travels or reach)
            if what not in digests:
                seen = owner.config() if travels or reach else {"whisking": owner.whisking.config()}
                digests[what] = content_hash({**seen, "label": None})
            # A head that is turned otherwise feels gravity and air in another direction.
            pull = {"pull": job.gravity} if any(job.gravity) else {}
            pull |= {} if job.air_flow is None else {"air": job.air_flow}
            key = content_hash(mount, digests[what], pull)
            if key not in distinct:
                distinct[key] = len(jobs)
                jobs.append(job)
            row.append(distinct[key])
            near.append(reach)
        places.append(tuple(row))
        reaches.append(tuple(near))
    return JobSchedule(tuple(jobs), tuple(places), tuple(reaches), surfaces)


def reach_of(job: Job, *, surfaces: bool = False) -> Reach:
    """Return what of its obstacles the whisker of this job could ever touch."""
    times = np.linspace(job.start, job.times[-1], max(2, math.ceil((job.times[-1] - job.start) * SAMPLING)))
    return reachable(job.whisker, job.follicle.pose(times)[0], job.obstacles, times, surfaces=surfaces)


ATTRIBUTE = "explanation"  # attribute of a stimulus set that holds the explanation as JSON
SECONDS = "seconds"
"""Key of a stimulus set's ``encoding`` under which this process keeps what took how long."""


@dataclass(frozen=True)
class Explanation:
    """Work of one simulation, beside the work of simulating every whisker of every stimulus in full.

    Kept in the stimulus set, so a set from the cache tells how it was once made. Where the set came from
    and how long that took differ from time to time and are known only to the process that made it.
    """

    stimuli: int
    whiskers: int
    """Whiskers per stimulus."""
    links: tuple[int, int]
    """Fewest and most links of a whisker."""
    simulated: int
    """Runs that were integrated."""
    shared: int
    """Runs that took over the trace of an equal run."""
    silent: int
    """Runs without any motion, load or object within reach: their wrench is exactly zero, without simulation."""
    steps: int
    """Time steps of all whiskers that were computed, the shorter ones of contacts that need them (``rod``) included."""
    steps_in_full: int
    """Time steps of the asked for length that all runs together would take."""
    pairs: int
    """Contact pairs of the simulated runs that lie within reach; no others were built."""
    pairs_in_full: int
    """Contact pairs of all links of all runs with all parts of their objects."""
    out_of_reach: Mapping[str, tuple[str, ...]]
    """Stimulus → whiskers that its objects cannot touch, whatever these whiskers do."""
    unsolved: int = 0
    """Time steps whose contact forces were not solved (:attr:`Trace.unsolved`)."""
    bodies: str = "convex parts"
    """Bodies that the contact pairs count: ``convex parts``, ``triangles`` or both."""
    # What is not known yet when a set is kept is not in it, so that equal sets are equal.
    seconds: Mapping[str, float] = field(default_factory=dict, metadata={"later": True, "before": {}})
    """Elapsed time of each part [s]: ``plan``, ``simulate``, ``assemble``, and ``processor``, the processor time of
    ``simulate`` on all threads together; or ``read`` alone. Empty when this process did not make the set."""
    source: str | None = field(default=None, metadata={"later": True})
    """File from which the finished set was read; None when it was simulated now."""

    @classmethod
    def of(cls, dataset: xr.Dataset) -> Explanation:
        """Read the explanation that :func:`brainbench.stimuli.simulate` left in a stimulus set."""
        text = dataset.attrs.get(ATTRIBUTE)
        if text is None:
            raise UsageError("This stimulus set does not say how it was made; simulate it again to have it explained.")
        try:
            explanation = msgspec.json.decode(text, type=cls)
        except (TypeError, msgspec.MsgspecError) as error:
            raise DataError(f"The explanation in this stimulus set is damaged ({error!r}).") from error
        source = dataset.encoding.get("source")
        return replace(
            explanation, seconds=dataset.encoding.get(SECONDS, {}), source=None if source is None else str(source)
        )

    def __str__(self) -> str:
        (low, high), runs = self.links, self.stimuli * self.whiskers
        links = f"{low}" if low == high else f"{low}–{high}"
        elapsed = ", ".join(f"{name} {value:.2f} s" for name, value in self.seconds.items())
        more = self.steps / max(1, self.steps_in_full) - 1
        saved = f"{_share(self.steps, self.steps_in_full)} of the steps"
        if more > 0:
            saved = f"none of the steps ({100 * more:.0f} % more: some contacts needed shorter ones)"
        far = [f"{label}: {', '.join(names) or 'none'}" for label, names in self.out_of_reach.items()]
        rows = {
            "asked for": f"{self.stimuli} stimuli × {self.whiskers} whiskers = {runs} runs of {links} links",
            "simulated": f"{self.simulated} runs, {self.steps:,} of {self.steps_in_full:,} time steps",
            "shared": f"{self.shared} runs equal to another stimulus's",
            "silent": f"{self.silent} runs that can feel nothing: exactly zero without simulation",
            "not solved": f"contact forces of {self.unsolved:,} time steps" if self.unsolved else "",
            "contact pairs": f"{self.pairs:,} of {self.pairs_in_full:,} (links × {self.bodies}) can ever meet",
            "saved": f"{saved}, {_share(self.pairs, self.pairs_in_full)} of the contact pairs",
            "time": elapsed or "not known: made by another process",
            "made": "now" if self.source is None else f"earlier, read from {self.source}",
            "out of reach": f"\n{'':15}".join(far),
        }
        return "\n".join(f"{name:<13}  {value}" for name, value in rows.items() if value)


def explain(scenes: Sequence[Scene], plan: JobSchedule, traces: Sequence[Trace], fidelity: Fidelity) -> Explanation:
    """Sum up a finished simulation of ``scenes``, with one trace per job of their ``plan``."""
    chains = {whisker: fidelity.chain(whisker) for whisker in {job.whisker for job in plan.jobs}}
    pairs = pairs_in_full = steps_in_full = 0
    kinds: set[str] = set()
    counted: set[int] = set()
    for scene, places, reaches in zip(scenes, plan.places, plan.reaches, strict=True):
        bodies = [_bodies(item.solid, plan.surfaces) for item in scene.objects]
        kinds.update(kind for kind, count in bodies if count)
        parts = sum(count for _, count in bodies)
        for index, reach in zip(places, reaches, strict=True):
            job = plan.jobs[index]
            chain = chains[job.whisker]
            pairs_in_full += chain.links * parts
            steps_in_full += math.ceil((job.times[-1] - job.start) / fidelity.step_of(chain) - 1e-6) + 1
            if index not in counted and traces[index].steps:
                pairs += reach.links(chain) * (reach.parts + reach.triangles)
            counted.add(index)
    counts = [chain.links for chain in chains.values()]
    silent = sum(traces[index].steps == 0 for places in plan.places for index in places)
    simulated = sum(trace.steps > 0 for trace in traces)
    runs = sum(len(places) for places in plan.places)
    return Explanation(
        stimuli=len(scenes),
        whiskers=len(scenes[0].names),
        links=(min(counts), max(counts)),
        simulated=simulated,
        shared=runs - simulated - silent,
        silent=silent,
        steps=sum(trace.steps for trace in traces),
        unsolved=sum(trace.unsolved for trace in traces),
        steps_in_full=steps_in_full,
        pairs=pairs,
        pairs_in_full=pairs_in_full,
        out_of_reach={
            scene.label: tuple(name for name, reach in zip(scene.names, reaches, strict=True) if not reach)
            for scene, reaches in zip(scenes, plan.reaches, strict=True)
        },
        bodies=" and ".join(sorted(kinds)) or "convex parts",
    )


def _bodies(solid: Solid, surfaces: bool) -> tuple[str, int]:
    """Return what an engine has to tell apart of a solid, and how many there are."""
    if solid.surface is not None and (surfaces or not solid.parts):
        return "triangles", len(solid.surface.faces)
    return "convex parts", len(solid.parts)


def _share(part: int, whole: int) -> str:
    """Return what is saved of ``whole`` as a percentage."""
    return f"{100 * (1 - part / whole):.0f} %" if whole else "none"
