"""Simulate scenes into a stimulus set, or the shapes of their whiskers over time, with a cache.

A stimulus set holds forces only; shapes, and the bending moments along them, are simulated when a picture asks for
them, up to the last instant it shows, and kept in the cache too.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import BrainbenchError, UsageError
from brainbench.core.files import cache_dir, content_hash, portable, to_json
from brainbench.core.progress import PREPARATION, Progress
from brainbench.core.reading import sealed
from brainbench.core.reading.sealed import keep_entry, read_sealed, write_sealed
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines import PHYSICS_VERSION, get_engine
from brainbench.stimuli.engines.error_estimates import RULE
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.explain import ATTRIBUTE, SECONDS, explain, plan
from brainbench.stimuli.motion.jobs import Job, Trace
from brainbench.stimuli.scenes.scene import Scene, clip_wrenches
from brainbench.stimuli.stimulus_set import (
    ORIENTATION,
    find_entry,
    hash_stimulus_set,
    new_stimulus_set,
    read_stimulus_set,
    turn,
    with_kept_errors,
    write_stimulus_set,
)
from brainbench.stimuli.whiskers.whisker import build_chain

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)


def simulate(
    scenes: Scene | Iterable[Scene],
    *,
    fidelity: Fidelity | str | None = None,
    backend: WhiskerEngine | str = DEFAULT_ENGINE,
    progress: Progress | None = None,
    cache: bool = True,
) -> xr.Dataset:
    """Simulate one scene or several into a stimulus set.

    Args:
        scenes: scenes with different labels, the same whiskers and the same frames.
        fidelity: how finely; a preset's name or a :class:`Fidelity`; ``balanced`` when None.
        backend: an engine's name, or any :class:`brainbench.stimuli.engines.protocol.WhiskerEngine` (never cached).
        progress: called as ``progress(done, total, what)`` after each simulated whisker.
        cache: read what the package ships, and read and keep results under
            ``brainbench.core.files.cache_dir("stimuli")``.

    Returns:
        The data set of :func:`brainbench.core.contracts.check_stimulus_set`: ``wrench`` [stimulus, time, whisker,
        channel] (float32; N, N·m; action of the whisker on its base, about the base point, axes as the frames say) with
        ``contact`` [stimulus, time, whisker], ``contact_arc`` (m along the whisker, NaN without contact),
        ``first_contact`` (s, when the first reading with contact was taken; NaN without), ``penetration`` (m, deepest
        overlap; a poor contact when large), ``error`` (estimated, as a share of force or moment; NaN where it is not),
        ``damping`` (ratio of the first mode), ``status``, ``reason``, ``remark`` [stimulus, whisker]; where follicles
        give way ``displacement`` [stimulus, time, whisker, axis] (m, rad; along the axes of a rigid base). The remark
        says that an error is beyond what the fidelity promises. From the instant a whisker became ``unstable`` its
        numbers are NaN. Attributes say how frames were made (``readout``), their ``axes`` and
        how many components were clipped in each stimulus (``clipped``). The attribute ``config_hash`` names what was
        asked for and is equal on every machine; ``content_hash`` names the numbers, whose last digits depend on the
        processor. :meth:`brainbench.stimuli.explain.Explanation.of` reads what was simulated, shared and left out.
    """
    chosen = _checked(scenes)
    engine, fidelity = resolve(backend, fidelity, chosen, errors=True)
    path = cache_path(chosen, fidelity, engine) if cache and isinstance(backend, str) else None
    if path is not None and (dataset := read_entry(path)) is not None:
        return dataset
    dataset = simulate_uncached(chosen, fidelity, engine, progress=progress)
    for i, j in np.argwhere(dataset["status"].values != "ok"):
        words = dataset["whisker"].values[j], dataset["stimulus"].values[i], dataset["reason"].values[i, j]
        _LOG.warning("whisker %s became unstable in %s: %s", *words)
    if path is not None:
        keep_entry(path, "stimuli", lambda file: write_stimulus_set(dataset, file))
    return dataset


def read_entry(path: Path) -> xr.Dataset | None:
    """Return a stimulus set that the package or the cache keeps; None without one, or with a damaged one."""

    def _read(file: Path) -> xr.Dataset:
        state = file.stat()
        # A score asks for its stimuli twice, for the demo recordings and for the network.
        return _read_entry(file, state.st_size, state.st_mtime_ns).copy(deep=True)

    # The package's own entry goes first; a damaged one does not hide that of the cache.
    candidates = (
        sealed.read_entry(file, "set of stimuli", _read) for file in dict.fromkeys((find_entry(path) or path, path))
    )
    return next((dataset for dataset in candidates if dataset is not None), None)


@functools.lru_cache(maxsize=1)
def _read_entry(path: Path, *state: int) -> xr.Dataset:
    started = time.perf_counter()
    dataset = with_kept_errors(read_stimulus_set(path), path)
    dataset.encoding[SECONDS] = {"read": time.perf_counter() - started}
    return dataset


def prepare(
    scenes: Iterable[Scene],
    *,
    fidelity: Fidelity | str | None = None,
    backend: str = DEFAULT_ENGINE,
    progress: Progress | None = None,
) -> None:
    """Begin, in a thread, what simulating these scenes will wait for, unless the cache holds their simulation.

    An engine that compiles at first use does so beside whatever the caller does before :func:`simulate`, which takes
    the same arguments and waits for the rest.
    """
    chosen = list(scenes)
    engine, fidelity = resolve(backend, fidelity, chosen, errors=True)
    if find_entry(cache_path(chosen, fidelity, engine)) is None:
        _begin(engine, chosen, fidelity, progress)


def resolve(
    backend: WhiskerEngine | str, fidelity: Fidelity | str | None, scenes: Iterable[Scene], *, errors: bool = False
) -> tuple[WhiskerEngine, Fidelity]:
    """Return the engine of some scenes, one by name estimating ``errors``, and the fidelity with whether they twist."""
    engine = get_engine(backend, errors=errors) if isinstance(backend, str) else backend
    return engine, Fidelity.of(fidelity).resolved(engine.twists and any(scene.twist for scene in scenes))


def _begin(
    engine: WhiskerEngine, scenes: Sequence[Scene], fidelity: Fidelity, progress: Progress | None
) -> threading.Thread:
    """Let an engine get ready in a thread."""
    lengths = {mount.whisker.arc_length for scene in scenes for mount in scene.mounts}
    if engine.smooth:
        fidelity = fidelity.touching(item.solid for scene in scenes for item in scene.objects)

    def _work() -> None:
        # What is wrong here is wrong again in the simulation, which says so; Python refuses a pool when it ends.
        with contextlib.suppress(BrainbenchError, RuntimeError):
            engine.prepare(lengths, fidelity, progress=progress)

    thread = threading.Thread(target=_work, name=PREPARATION)
    thread.start()
    return thread


def _checked(scenes: Scene | Iterable[Scene]) -> list[Scene]:
    chosen = [scenes] if isinstance(scenes, Scene) else list(scenes)
    if not chosen:
        raise UsageError("There is no scene to simulate.")
    first = chosen[0]
    labels = [scene.label for scene in chosen]
    if len(set(labels)) < len(labels):
        raise UsageError(f"The labels of the scenes must differ; received {labels}.")
    for scene in chosen[1:]:
        if (scene.names, [mount.side for mount in scene.mounts]) != (first.names, [m.side for m in first.mounts]):
            raise UsageError(f"The scenes {first.label!r} and {scene.label!r} have different whiskers.")
        if scene.frames != first.frames:
            raise UsageError(f"The scenes {first.label!r} and {scene.label!r} are read at different times.")
    return chosen


def simulate_uncached(
    scenes: Sequence[Scene],
    fidelity: Fidelity,
    engine: WhiskerEngine,
    *,
    progress: Progress | None = None,
    workers: int | None = None,
) -> xr.Dataset:
    """Simulate every distinct job of scenes that fit together once, and return their stimulus set.

    Arguments are those of :func:`simulate`; ``workers`` are native threads, all usable processors when None.
    """
    clock = [time.perf_counter()]
    making = _begin(engine, scenes, fidelity, progress)
    planned = plan(scenes, surfaces=engine.surfaces)
    clock.append(time.perf_counter())
    making.join()
    report = None if progress is None else lambda done, total: progress(done, total, "simulating whiskers")
    traces = engine.run(planned.jobs, fidelity, progress=report, workers=workers)
    clock.append(time.perf_counter())
    dataset = _assemble(scenes, [[traces[i] for i in row] for row in planned.places], fidelity, engine.name)
    clock.append(time.perf_counter())
    seconds = dict(zip(("plan", "simulate", "assemble"), np.diff(clock).tolist(), strict=True))
    dataset.attrs[ATTRIBUTE] = to_json(explain(scenes, planned, traces, fidelity), indent=None)
    dataset.encoding[SECONDS] = {**seconds, "processor": sum(trace.seconds for trace in traces)}
    return dataset


def _assemble(
    scenes: Sequence[Scene], traces: Sequence[Sequence[Trace]], fidelity: Fidelity, backend: str
) -> xr.Dataset:
    names, mounts, array, frames = scenes[0].names, scenes[0].mounts, scenes[0].array, scenes[0].frames
    grid, over_time = ("stimulus", "whisker"), ("stimulus", "time", "whisker")
    text = functools.partial(to_json, indent=None)
    wrench = np.stack([_to_world(scene, row) for scene, row in zip(scenes, traces, strict=True)])
    orientation = None
    if frames.axes == "follicle":
        orientation = np.stack([scene.orientations() for scene in scenes])
        wrench = turn(wrench, np.swapaxes(orientation, -1, -2))
    wrench, clipped = (wrench, None) if frames.clip is None else clip_wrenches(wrench, frames.clip)

    def of(name: str, dtype: Any = object) -> NDArray[Any]:
        """[stimulus, whisker]."""
        return np.array([[getattr(trace, name) for trace in row] for row in traces], dtype=dtype)

    def readings(name: str) -> NDArray[Any]:
        """[stimulus, frame, reading, whisker]."""
        return np.stack([frames.split(np.stack([getattr(trace, name) for trace in row], axis=1)) for row in traces])

    touched = [[frames.readings[trace.contact] for trace in row] for row in traces]
    first = np.array([[times[0] if len(times) else math.nan for times in row] for row in touched])
    arcs = readings("contact_arc")
    count = np.isfinite(arcs).sum(axis=2)
    arc = np.where(count > 0, np.nansum(arcs, axis=2) / np.maximum(count, 1), np.nan).astype(np.float32)
    # Scenes may differ in material; the hash beside this covers every number of every scene's array.
    about = {"species": array.species, "side": array.side, "whiskers": list(names), "citation": array.citation}
    meanings = {
        "contact_arc": {"units": "m", "long_name": "arc length of the force-weighted contact point"},
        "first_contact": {"units": "s", "long_name": "time of the first reading with contact"},
        "error": {"units": "1", "long_name": "estimated error of base force or moment, as a share of it"},
        "damping": {"units": "1", "long_name": "damping ratio of the first mode that the time steps leave"},
        "penetration": {"units": "m", "long_name": "deepest overlap of whisker and object"},
    }
    dataset = new_stimulus_set(
        [scene.label for scene in scenes],
        [(name, mount.row, mount.col, mount.side) for name, mount in zip(names, mounts, strict=True)],
        frames,
        {
            "wrench": ((*over_time, "channel"), wrench, {"units": "N (F), N m (M)"}),
            "contact": (over_time, readings("contact").any(axis=2)),
            "contact_arc": (over_time, arc, meanings["contact_arc"]),
            "first_contact": (grid, first, meanings["first_contact"]),
            "penetration": (grid, of("penetration", np.float32), meanings["penetration"]),
            "status": (grid, of("status")),
            "reason": (grid, of("reason")),
            "remark": (grid, of("remark")),
            "error": (grid, of("error", np.float32), meanings["error"]),
            "damping": (grid, of("damping", np.float32), meanings["damping"]),
        },
        {
            "array": text({**about, "hash": content_hash([scene.mounts for scene in scenes])}),
            "scene": text([scene.config() for scene in scenes]),
            "fidelity": text(fidelity),
            "backend": backend,
        },
    )
    if any(trace.displacement is not None for row in traces for trace in row):
        rigid = np.zeros((len(frames.readings), 6))
        gave = [[rigid if trace.displacement is None else trace.displacement for trace in row] for row in traces]
        places = np.stack([np.stack([frames.reduce(each) for each in row], axis=1) for row in gave])
        about = {"units": "m (x, y, z), rad (rx, ry, rz)", "long_name": "slide and turn of the follicle, its own axes"}
        dataset["displacement"] = ((*over_time, "axis"), places.astype(np.float32), about)
        dataset.coords["axis"] = np.array(["x", "y", "z", "rx", "ry", "rz"], dtype=object)
    if orientation is not None:
        dataset[ORIENTATION] = (("stimulus", "time", "whisker", "row_axis", "col_axis"), orientation)
    if clipped is not None:
        counts = {
            scene.label: {"force": int(part[..., :3].sum()), "moment": int(part[..., 3:].sum())}
            for scene, part in zip(scenes, clipped, strict=True)
        }
        dataset.attrs["clipped"] = text({"limit_N": frames.clip, "components": counts})
    dataset.attrs["config_hash"] = config_hash(scenes, fidelity, backend)
    dataset.attrs["content_hash"] = hash_stimulus_set(dataset)
    return check_stimulus_set(dataset)


def _to_world(scene: Scene, traces: Sequence[Trace]) -> NDArray[np.float32]:
    """Make frames of the readings and turn the wrenches [time, whisker, channel] to world axes."""
    frames = scene.frames
    vectors = np.stack([frames.reduce(trace.wrench) for trace in traces], axis=1)
    vectors = vectors.reshape(frames.count, len(traces), 2, 3)
    # Jobs stand in the frame of their array at t = 0, which the head does not carry along: one rotation an animal.
    ends = np.cumsum([len(part.array) for part in scene.split()])[:-1]
    parts = zip(np.split(vectors, ends, axis=1), scene.split(), strict=True)
    turned = np.concatenate([own @ part.head.matrix.T for own, part in parts], axis=1)
    return turned.reshape(frames.count, len(traces), 6).astype(np.float32)


def config_hash(scenes: Sequence[Scene], fidelity: Fidelity, backend: str) -> str:
    """Return a hash of what was asked for and of the physics, equal on every machine whatever its arithmetic.

    Scores and synthetic animals have it for their stimuli, so they are others where the physics are.
    """
    arrays = [scene.mounts for scene in scenes]
    # Forces that keep a promise depend on how their errors are estimated.
    physics = PHYSICS_VERSION if fidelity.error is None else (PHYSICS_VERSION, RULE)
    return content_hash(backend, fidelity, physics, portable([scene.config() for scene in scenes]), portable(arrays))


def cache_path(
    scenes: Sequence[Scene], fidelity: Fidelity, engine: WhiskerEngine, *more: Any, folder: str = "stimuli"
) -> Path:
    """Return where the cache keeps what these scenes give; ``more`` is whatever else determines it.

    The name changes with the scenes, the fidelity, the engine, the version of the engine's library and
    :data:`brainbench.stimuli.engines.PHYSICS_VERSION`; not with the rest of the code.
    """
    from importlib import metadata

    library = metadata.version(engine.package) + engine.revision if engine.package else ""
    key = content_hash(config_hash(scenes, fidelity, engine.name), library, *more, length=24)
    return cache_dir(folder) / f"{key}.h5"


@dataclass(frozen=True, eq=False)
class Recording:
    """Shapes of the whiskers of one scene. Letters: n instant, N link."""

    scene: Scene
    times: NDArray[np.float64]
    """[n] s."""
    joints: tuple[NDArray[np.float64], ...]
    """Per whisker [n, N + 1, 3]: joints and tip (m, world); NaN from where its simulation became unstable."""
    moments: tuple[NDArray[np.float64], ...]
    """Per whisker [n, N + 1]: elastic bending moment at the joints and the tip (N·m, without sign)."""

    @property
    def unstable(self) -> tuple[str, ...]:
        """Names of the whiskers whose shape is not known at every instant."""
        pairs = zip(self.scene.names, self.joints, strict=True)
        return tuple(name for name, points in pairs if not np.isfinite(points).all())

    def unbent(self, whisker: int, instant: int) -> NDArray[np.float64]:
        """Return joints and tip [N + 1, 3] (m, world) of a whisker that nothing bends, at one instant."""
        job, axes = self.scene.jobs()[whisker], self.scene.axes[whisker]
        place, euler = job.follicle.pose(self.times[instant : instant + 1])
        rest = build_chain(job.whisker, self.joints[whisker].shape[1] - 1).points
        return (rest @ base_rotation(euler)[0].T + place[0]) @ axes.T + self.scene.origins[whisker]


def record(
    scene: Scene,
    times: ArrayLike,
    *,
    fidelity: Fidelity | str | None = None,
    backend: WhiskerEngine | str = DEFAULT_ENGINE,
    progress: Progress | None = None,
    cache: bool = True,
) -> Recording:
    """Simulate a scene and return the shapes of its whiskers at ``times`` [n] (s), increasing, not before t = 0.

    Its frames do not matter. Other arguments are those of :func:`brainbench.stimuli.simulate`; shapes have a cache of
    their own.
    """
    times = np.atleast_1d(np.asarray(times, dtype=float))
    engine, fidelity = resolve(backend, fidelity, [scene])
    jobs = [replace(job, times=times) for job in scene.jobs()]
    path = None
    if cache and isinstance(backend, str):
        path = cache_path([scene], fidelity, engine, times, folder="shapes").with_suffix(".npz")
    names = [f"whisker{index}" for index in range(len(jobs))]
    stored = None if path is None else read_sealed(path, "shapes of whiskers")
    if stored is not None:
        local: list[NDArray[np.float64]] = [stored[name].astype(float) for name in names]
    else:
        report = None if progress is None else lambda done, total: progress(done, total, "simulating shapes")
        traces = engine.run(jobs, fidelity, progress=report, record_shape=True)
        local = [trace.link_positions for trace in traces if trace.link_positions is not None]
        if len(local) < len(traces):
            raise UsageError(f"The backend {engine.name!r} reports no shapes of whiskers; use 'rod' or 'mujoco'.")
        if path is not None:
            write_sealed(path, "shapes of whiskers", dict(zip(names, local, strict=True)), compress=True)
    moments = tuple(bending_moments(job, points) for job, points in zip(jobs, local, strict=True))
    # Jobs stand in the frame of their array as it was at t = 0.
    places = zip(local, scene.axes, scene.origins, strict=True)
    return Recording(scene, times, tuple(points @ axes.T + origin for points, axes, origin in places), moments)


def bending_moments(job: Job, joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the elastic moment [n, N + 1] (N·m) at each joint of a chain; zero at the tip.

    The moment is the hinge's stiffness times the angle by which the link after the joint is turned from its rest
    direction (:class:`~.whisker.Chain`); damping and twist carry none of it. NaN of a rest
    shape in space, whose twist joints do not tell. ``joints`` are [n, N + 1, 3] (m) in the frame of the job, at its
    times [n].
    """
    links = joints.shape[1] - 1
    chain = build_chain(job.whisker, links)
    along = np.diff(joints, axis=1)
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    frame = base_rotation(job.follicle.pose(job.times)[1])
    moments = np.full(joints.shape[:2], np.nan if chain.rest_rolls.any() else 0.0)
    for link, at_rest in enumerate(chain.rest_turns):
        frame = frame @ at_rest
        # Turned by a about y and b about z, the x axis is (cos a cos b, sin b, −sin a cos b).
        x, y, z = np.moveaxis(np.einsum("nji,nj->ni", frame, along[:, link]), -1, 0)
        about_y, about_z = np.arctan2(-z, x), np.arctan2(y, np.hypot(x, z))
        moments[:, link] += chain.stiffness[link] * np.hypot(about_y, about_z)
        # The new link's axes: x along it, turned by the hinges about y and z without twist.
        across = np.stack([-np.cos(about_y) * np.sin(about_z), np.cos(about_z), np.sin(about_y) * np.sin(about_z)], -1)
        second = np.einsum("nij,nj->ni", frame, across)
        frame = np.stack([along[:, link], second, np.cross(along[:, link], second)], axis=-1)
    if job.whisker.follicle is not None:  # the turn of the first joint is that of the follicle too
        moments[:, 0] = 2 * moments[:, 1] - moments[:, 2]
    return moments
