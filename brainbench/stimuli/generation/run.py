"""Run the shards of a data set: in this process, on a local pool, through a GPU, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.errors import DataError, UsageError
from brainbench.files import read_json, to_plain, write_json
from brainbench.stimuli.generation.engine import check_device
from brainbench.stimuli.generation.manifest import MANIFEST, is_whole, make_manifest

if TYPE_CHECKING:
    from brainbench.stimuli.generation.plan import GenerationPlan, ShardTask
    from brainbench.types import Progress

_LOG = logging.getLogger(__name__)

CONFIG = "config.json"
_TEMPORARY = re.compile(r"\.((train|validation|test)-\d{5}-[0-9a-f]+\.h5|(config|manifest)-[0-9a-f]+\.json)")
_SPARE = 64e6
"""Bytes of disk that are left free."""


def generate(
    plan: GenerationPlan,
    out: str | os.PathLike[str],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the shards of a data set that are missing in a folder, then its manifest, and return the manifest.

    A run that was killed goes on when it is started again. Neither ``workers`` nor the scheduler changes a byte.

    Args:
        plan: what to make.
        out: the folder; with a scheduler, one that all workers see under this path.
        workers: processes on this machine; as many as there are usable processors when None.
        scheduler: address of a Dask scheduler (``tcp://host:8786``), whose workers make the shards instead.
        progress: called as ``progress(sweeps done, sweeps in all, what)``, without those that were there already.

    Raises:
        UsageError: the folder holds another data set, another process is writing it, or the backend does not run on
            the device.
        DataError: the disk is too small, or a worker or shard failed; finished shards are kept.
        MissingDependencyError: a scheduler is given and Dask is not installed.
    """
    from brainbench.stimuli.generation import local

    if workers is not None and workers < 1:
        raise UsageError(f"workers must be at least 1; received {workers}.")
    check_device(plan.settings.backend, plan.settings.device)
    folder = Path(out).absolute()
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        _check_config(plan, folder)
        _clean(folder)
        missing = [task for task in plan.shards if not is_whole(folder / task.name, task)]
        _check_space(missing, folder)
        report = _Report(missing, progress)
        if len(missing) < len(plan.shards):
            _LOG.info("%d of %d shards are there already", len(plan.shards) - len(missing), len(plan.shards))
        if scheduler is not None:
            from brainbench.stimuli.generation.cluster import run_on_cluster

            run_on_cluster(missing, folder, scheduler, report)
        elif missing:
            local.run_here(missing, folder, workers, report)
        _clean(folder)
        manifest = make_manifest(plan, folder)
        write_json(folder / MANIFEST, manifest)
    return manifest


class _Report:
    """Tells how far the run is: to a progress bar, and to the log every half minute with the time that remains."""

    def __init__(self, missing: Sequence[ShardTask], progress: Progress | None) -> None:
        self.total = sum(map(len, missing))
        self.done = 0
        self._progress = progress
        self._started = self._told = time.monotonic()

    def __call__(self, sweeps: int) -> None:
        self.done += sweeps
        if self._progress is not None:
            self._progress(self.done, self.total, "simulating sweeps")
        now = time.monotonic()
        if now - self._told >= 30 or self.done == self.total:
            self._told = now
            rate = self.done / max(now - self._started, 1e-9)
            rest = (self.total - self.done) / rate
            _LOG.info("%d of %d sweeps, %.3g sweeps/s, about %s left", self.done, self.total, rate, _duration(rest))


def _duration(seconds: float) -> str:
    hours, minutes = divmod(round(seconds / 60), 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min" if seconds >= 60 else f"{seconds:.0f} s"


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold a lock on the folder, which the system releases when this process ends in whatever way."""
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(f"Another process is writing {str(folder)!r}; wait for it, or end it.") from error
        except OSError as error:
            _LOG.warning("%s cannot be locked (%s); start no second run there", folder, error)
        yield
    finally:
        os.close(handle)


def _check_config(plan: GenerationPlan, folder: Path) -> None:
    """Refuse to go on with what was begun otherwise; note what is begun."""
    path, config = folder / CONFIG, to_plain(plan.config)
    if not path.exists():
        strange = [item.name for item in folder.iterdir() if not _TEMPORARY.fullmatch(item.name)]
        if strange:
            raise UsageError(
                f"{str(folder)!r} is not empty and holds no data set of sweeps (it has {sorted(strange)[0]!r}); choose "
                "a new folder."
            )
        write_json(path, config)
        return
    found = read_json(path)
    if found != config and not any(folder.glob("*.h5")):
        # Begun, but nothing was made: a failed first try must not stand in the way.
        write_json(path, config)
    elif found != config:
        other = sorted(key for key in {*found, *config} if found.get(key) != config.get(key))
        raise UsageError(
            f"{str(folder)!r} holds a data set begun with other {', '.join(other)}; give the same options as then, or "
            "choose another folder."
        )


def _clean(folder: Path) -> None:
    """Remove what processes that were killed left half-written."""
    for item in folder.iterdir():
        if _TEMPORARY.fullmatch(item.name):
            item.unlink(missing_ok=True)


def _check_space(missing: Sequence[ShardTask], folder: Path) -> None:
    needed = sum(task.bytes for task in missing)
    free = shutil.disk_usage(folder).free
    if needed + _SPARE > free:
        raise DataError(
            f"The {sum(map(len, missing)):,} sweeps still to be made take {_size(needed)} and {str(folder)!r} has "
            f"{_size(free)} free; choose another folder, fewer sweeps (--sample, --limit) or fewer whiskers."
        )


def _size(count: float) -> str:
    return f"{count / 1e9:.3g} GB" if count >= 1e9 else f"{count / 1e6:.3g} MB"
