"""Simulate scenes into a stimulus set, with a cache."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import BrainbenchError, UsageError
from brainbench.core.files import cache_dir, content_hash, portable, to_json
from brainbench.core.progress import PREPARATION, Progress
from brainbench.core.reading import sealed
from brainbench.core.reading.sealed import keep_entry
from brainbench.stimuli.engines import PHYSICS_VERSION, get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity, steps_to_ring
from brainbench.stimuli.engines.job_schedule import plan
from brainbench.stimuli.engines.protocol import WhiskerEngine
from brainbench.stimuli.explain import ATTRIBUTE, SECONDS, explain
from brainbench.stimuli.kept_sets import find_entry, with_kept_errors
from brainbench.stimuli.motion.jobs import Trace
from brainbench.stimuli.scenes.frames import clip_wrenches
from brainbench.stimuli.scenes.scene import Scene
from brainbench.stimuli.stimulus_set import (
    ORIENTATION,
    hash_stimulus_set,
    new_stimulus_set,
    read_stimulus_set,
    turn,
    write_stimulus_set,
)

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
    _warn_unstable(dataset)
    if path is not None:
        keep_entry(path, "stimuli", lambda file: write_stimulus_set(dataset, file))
    return dataset


def read_entry(path: Path) -> xr.Dataset | None:
    """Return a stimulus set that the package or the cache keeps; None without one, or with a damaged one."""

    def read(file: Path) -> xr.Dataset:
        state = file.stat()
        # A score asks for its stimuli twice, for the demo recordings and for the network.
        return _read_entry(file, state.st_size, state.st_mtime_ns).copy(deep=True)

    # The package's own entry goes first; a damaged one does not hide that of the cache.
    candidates = (
        sealed.read_entry(file, "set of stimuli", read) for file in dict.fromkeys((find_entry(path) or path, path))
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

    def work() -> None:
        # What is wrong here is wrong again in the simulation, which says so; Python refuses a pool when it ends.
        with contextlib.suppress(BrainbenchError, RuntimeError):
            engine.prepare(lengths, fidelity, progress=progress)

    thread = threading.Thread(target=work, name=PREPARATION)
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
    rows = [[traces[index] for index in row] for row in planned.places]
    dataset = _assemble(scenes, rows, fidelity, engine.name)
    clock.append(time.perf_counter())
    seconds = dict(zip(("plan", "simulate", "assemble"), np.diff(clock).tolist(), strict=True))
    dataset.attrs[ATTRIBUTE] = explain(scenes, planned, traces, fidelity).to_attribute()
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
    arc = _mean_of_known(readings("contact_arc")).astype(np.float32)
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
        dataset.attrs["clipped"] = _count_clipped(dataset, clipped, frames.clip)
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


def _count_clipped(dataset: xr.Dataset, clipped: NDArray[np.bool_], limit: float | None) -> str:
    """JSON of how many force and moment components were clipped in each stimulus."""
    counts = {
        str(label): {"force": int(part[..., :3].sum()), "moment": int(part[..., 3:].sum())}
        for label, part in zip(dataset["stimulus"].values, clipped, strict=True)
    }
    return to_json({"limit_N": limit, "components": counts}, indent=None)


def _mean_of_known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over axis 2 of what is not NaN; NaN where nothing is known."""
    finite = np.isfinite(values)
    count = finite.sum(axis=2)
    total = np.where(finite, values, 0.0).sum(axis=2)
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)


def _warn_unstable(dataset: xr.Dataset) -> None:
    for i, j in np.argwhere(dataset["status"].values != "ok"):
        _LOG.warning(
            "whisker %s became unstable in %s: %s",
            dataset["whisker"].values[j],
            dataset["stimulus"].values[i],
            dataset["reason"].values[i, j],
        )


def config_hash(scenes: Sequence[Scene], fidelity: Fidelity, backend: str) -> str:
    """Return a hash of what was asked for, equal on every machine whatever its arithmetic."""
    arrays = [scene.mounts for scene in scenes]
    return content_hash(backend, fidelity, portable([scene.config() for scene in scenes]), portable(arrays))


def cache_path(
    scenes: Sequence[Scene], fidelity: Fidelity, engine: WhiskerEngine, *more: Any, folder: str = "stimuli"
) -> Path:
    """Return where the cache keeps what these scenes give; ``more`` is whatever else determines it.

    The name changes with the scenes, the fidelity, the engine, the version of the engine's library and
    :data:`brainbench.stimuli.engines.PHYSICS_VERSION`; not with the rest of the code.
    """
    from importlib import metadata

    library = metadata.version(engine.package) + engine.revision if engine.package else ""
    # Steps that are shortened to ring as asked came later than entries that exist.
    ratios = [mount.whisker.damping_ratio for scene in scenes for mount in scene.mounts]
    if max(map(steps_to_ring, ratios)) > (fidelity.steps_per_period or math.inf):
        more = (*more, "ringing")
    key = content_hash(config_hash(scenes, fidelity, engine.name), library, PHYSICS_VERSION, *more, length=24)
    return cache_dir(folder) / f"{key}.h5"
