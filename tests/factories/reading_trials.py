"""One attempt to read a damaged file, within bounds of time and memory, and what became of it."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import resource
import shutil
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from brainbench.core.errors import BrainbenchError
from brainbench.core.files import write_json
from tests.factories.damage import damage

SECONDS = 10.0
"""Seconds of work after which a reader hangs; by the clock, what waits has three times as many on a busy machine."""
MEMORY = 2 << 30
"""Address space [bytes] that a reader may take beyond what the process has."""
LONGEST = 400
"""Characters of one sentence to a user."""


class HangError(BaseException):
    """Raised into a reader that takes too long; no handler of errors catches it."""


def numbers(value: Any, *, depth: int = 12) -> Iterator[float]:
    """Yield the numbers in nested data, the least and the greatest of each array."""
    if depth == 0 or isinstance(value, (str, bytes, bool, type(None))):
        return
    if isinstance(value, (int, float, np.number)):
        yield float(min(max(value, -1e308), 1e308)) if isinstance(value, int) else float(value)
    elif isinstance(value, xr.Dataset):
        for name in (*value.data_vars, *value.coords):
            yield from numbers(value[name].values)
    elif hasattr(value, "detach"):
        yield from numbers(value.detach().float().numpy())
    elif isinstance(value, np.ndarray):
        if value.dtype.kind in "fiu" and value.size:
            yield from (float(value.min()), float(value.max()))
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from numbers(item, depth=depth - 1)
    elif isinstance(value, (list, tuple, set, frozenset)):
        for item in value:
            yield from numbers(item, depth=depth - 1)
    elif dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            yield from numbers(getattr(value, item.name, None), depth=depth - 1)


def not_finite(value: Any) -> bool:
    """Return whether nested data holds a number that is not finite."""
    return any(not math.isfinite(number) for number in numbers(value))


@dataclass(frozen=True)
class Surface:
    """One reader of users' files."""

    name: str
    make: Callable[[Path], Path]
    """Writes a good input into a folder and returns the file to be damaged."""
    read: Callable[[Path], Any]
    """Reads it, given the path of that file."""
    faults: Callable[[Any], bool] = not_finite
    """True for a result that holds a number which is not finite or out of range."""
    inside: int = 0
    """Folders of the input around that file."""

    def copy(self, good: Path, folder: Path) -> Path:
        """Copy a good input to a folder; return the file there."""
        root = good.parents[self.inside]
        return shutil.copytree(root, folder) / good.relative_to(root)


@dataclass(frozen=True)
class Outcome:
    """What became of one case.

    ``refused`` in one sentence; ``accepted``; or one of the failures ``wordy`` (more than :data:`LONGEST` characters),
    ``half-written`` (refused, and something was left behind), ``traceback``, ``memory``, ``hang`` and ``silent``.
    """

    kind: str
    what: str
    """The damage."""
    detail: str = ""


def attempt(surface: Surface, good: Path, seed: int, change: Callable[[Path, int], str] = damage) -> Outcome:
    """Change a copy of the folder of ``good``, by default by damage, and read it."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "case"
        path = surface.copy(good, copy)
        what = change(path, seed)
        before = _entries(copy)
        try:
            with warnings.catch_warnings(), time_limit(), _memory_limit():
                warnings.simplefilter("ignore")
                value = surface.read(path)
                faulty = surface.faults(value)
        except BrainbenchError as error:
            text = str(error)
            kind = "wordy" if len(text) > LONGEST else "half-written" if _entries(copy) > before else "refused"
            return Outcome(kind, what, text[:LONGEST])
        except HangError:
            return Outcome("hang", what)
        except MemoryError as error:
            return Outcome("memory", what, str(error))
        except (Exception, SystemExit) as error:  # noqa: BLE001 - to find them is the purpose
            return Outcome("traceback", what, f"{type(error).__name__}: {str(error)[:200]}")
        return Outcome("silent" if faulty else "accepted", what)


@contextlib.contextmanager
def time_limit(work: float = SECONDS, clock: float = 3 * SECONDS) -> Iterator[None]:
    """Raise :class:`HangError` after so many seconds of work, since a machine may be busy, or by the clock."""

    def stop(*_: object) -> None:
        raise HangError

    timers = ((signal.SIGPROF, signal.ITIMER_PROF, work), (signal.SIGALRM, signal.ITIMER_REAL, clock))
    handlers = [signal.signal(kind, stop) for kind, _, _ in timers]
    for _, timer, seconds in timers:
        signal.setitimer(timer, seconds)
    try:
        yield
    finally:
        for (kind, timer, _), handler in zip(timers, handlers, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(kind, handler)


@contextlib.contextmanager
def _memory_limit() -> Iterator[None]:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    limit = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY + (1 << 28), limit[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limit)


def _entries(folder: Path) -> int:
    """Count what stands in a folder; a reader of the tests may rename a file, and none may add one."""
    return sum(1 for _ in folder.rglob("*"))


def bad_counts(dataset: Any) -> bool:
    """Return whether counts are negative or infinite (missing ones are NaN), or bins and times impossible."""
    counts, duration = dataset["counts"].values, dataset["duration"].values
    real = counts[~np.isnan(counts)]
    return bool(
        np.isinf(real).any()
        or (real < 0).any()
        or not (np.isfinite(duration) & (duration >= 0)).all()
        or not np.isfinite(dataset["time"].values).all()
    )


def written(name: str, text: str) -> Callable[[Path], Path]:
    """Return what writes a text into a folder."""

    def make(folder: Path) -> Path:
        path = folder / name
        path.write_text(text, encoding="utf-8")
        return path

    return make


def written_json(name: str, value: Any) -> Callable[[Path], Path]:
    """Return what writes a value as JSON into a folder."""
    return lambda folder: write_json(folder / name, value)
