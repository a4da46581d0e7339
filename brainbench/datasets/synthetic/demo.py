"""Demo recordings: real NWB files with synthetic spikes, made once per machine from simulated stimuli.

They exist to try the toolkit and to test it: the true geometry is known (``truth.json`` beside the
files). Everything is labelled synthetic; **ranks of models on them say nothing about brains**.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import DataError, UsageError, listing
from brainbench.core.files import cache_dir, content_hash, file_hash, read_json, write_json
from brainbench.core.progress import Progress
from brainbench.datasets.layouts import rodgers
from brainbench.datasets.synthetic.demo_neurons import (
    Afferents,
    draw_population,
    make_afferents,
    window_rates,
)
from brainbench.datasets.synthetic.demo_session import (
    CHOICE,
    SessionPlan,
    draw_behaviour,
    draw_contacts,
    draw_spikes,
    tracked_runs,
    write_session,
)
from brainbench.datasets.synthetic.truth import TRUTH, correlation_rdm, read_truth

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["TRUTH", "VERSION", "demo_folder", "ensure_demo", "make_demo", "read_truth"]

VERSION = 2
"""Raised when the same stimuli give other spikes, so that old caches are not reused."""

_ANIMALS = (
    (SessionPlan("demo01", "01", 34, 170, detection=True), SessionPlan("demo01", "02", 30, 140)),
    (SessionPlan("demo02", "01", 56, 270, lost_whisker="C0"),),
    (SessionPlan("demo03", "01", 30, 140, spans=True), SessionPlan("demo03", "02", 28, 150)),
    (SessionPlan("demo04", "01", 40, 220, depth=0.36),),
)
"""The animals; the last is hard to read on purpose."""
_INDIVIDUAL = 0.4
"""How far animals differ in what they weigh (standard deviation of the logarithm)."""
_MANY = 4000
"""Units that stand for the shared geometry in the truth."""
_ABANDONED = 24 * 3600.0

_log = logging.getLogger(__name__)


def make_demo(
    folder: str | os.PathLike[str],
    stimuli: xr.Dataset,
    *,
    seed: int = 0,
    animals: int = 4,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the demo recordings and their truth into ``folder``.

    Args:
        folder: created if needed; files of the same names are replaced.
        stimuli: stimulus set (:func:`brainbench.core.contracts.check_stimulus_set`) with the six labels of the
            Rodgers experiment and ``contact`` [stimulus, time, whisker] (bool).
        seed: other seeds give other animals.
        animals: number of animals; from the fifth on their sessions repeat the first ones' design.
        progress: called as ``progress(done, total, what)`` after each session.

    Returns:
        The NWB files. ``truth.json`` beside them holds, as upper triangles over ``labels``, the
        noiseless correlation-distance RDM of the shared tuning (``shared``) and of each animal's units.

    Raises:
        DataError: the stimuli lack a label or ``contact``, or one never touches a tracked whisker.
        UsageError: fewer than one animal is asked for.
    """
    if animals < 1:
        raise UsageError(f"The demo needs at least one animal; received {animals}.")
    stimuli = _in_vocabulary_order(check_stimulus_set(stimuli))
    labels = tuple(str(label) for label in stimuli["stimulus"].values)
    afferents = make_afferents(stimuli)
    contact = stimuli["contact"].transpose("stimulus", "time", "whisker").values.astype(bool)
    runs = tracked_runs(afferents.whiskers, contact, afferents.frame)
    plans = [_animal(index) for index in range(animals)]
    total = sum(map(len, plans))
    first = {plan: _first_contacts(labels, runs, plan.lost_whisker) for sessions in plans for plan in sessions}
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    rdms: dict[str, NDArray[np.float64]] = {}
    paths: list[Path] = []
    for index, sessions in enumerate(plans):
        own = np.random.default_rng([seed, VERSION, index])
        emphasis = np.exp(_INDIVIDUAL * own.standard_normal(afferents.values.shape[2:]))
        expected = []
        for number, plan in enumerate(sessions):
            random = np.random.default_rng([seed, VERSION, index, number])
            population = draw_population(random, afferents, plan.units, emphasis, plan.depth)
            rates = population.rates(afferents)
            expected.append(_expected(rates, afferents, first[plan]))
            behaviour = draw_behaviour(random, plan, labels)
            spikes = draw_spikes(random, behaviour, rates, population.baseline, afferents.frame)
            contacts = draw_contacts(random, behaviour, runs)
            path = folder / f"sub-{plan.subject}_ses-{plan.session}_behavior+ecephys.nwb"
            write_session(path, random, plan, behaviour, spikes, contacts)
            paths.append(path)
            if progress is not None:
                progress(len(paths), total, f"demo recordings {plan.subject}")
        rdms[sessions[0].subject] = correlation_rdm(np.concatenate(expected, axis=1))
    write_json(
        folder / TRUTH,
        {
            "note": "SYNTHETIC recordings: ranks of models on them say nothing about brains.",
            "synthetic": True,
            "version": VERSION,
            "seed": seed,
            "stimuli": str(stimuli.attrs["content_hash"]),
            "labels": labels,
            "shared": _shared(afferents, _first_contacts(labels, runs), seed),
            "subjects": rdms,
            "files": {path.name: {"bytes": path.stat().st_size, "hash": file_hash(path)} for path in paths},
        },
    )
    return paths


def demo_folder(stimuli: str, *, seed: int = 0, animals: int = 4) -> Path:
    """Return where the cache keeps the demo made from the stimuli of that content hash."""
    return cache_dir("recordings") / f"demo-{content_hash(stimuli, seed, animals, VERSION)}"


def ensure_demo(
    stimuli: xr.Dataset | Callable[[], xr.Dataset],
    *,
    key: str | None = None,
    seed: int = 0,
    animals: int = 4,
    progress: Progress | None = None,
) -> Path:
    """Return the folder of the demo recordings, making them if this machine has none.

    Two processes may ask at once and either may be killed: a folder appears under its name only when
    it is complete, and one whose files are missing or of the wrong size is made again.

    Args:
        stimuli: the stimulus set, or a function that makes it and is called only if needed.
        key: name of the stimuli (such as a hash of the recipe), needed with a function.
        seed, animals, progress: as in :func:`make_demo`.

    Raises:
        UsageError: a function without a ``key``.
        DataError: as in :func:`make_demo`.
    """
    if key is None:
        if callable(stimuli):
            raise UsageError("ensure_demo needs a key beside a function that makes the stimuli; pass key='…'.")
        key = str(check_stimulus_set(stimuli).attrs["content_hash"])
    target = demo_folder(key, seed=seed, animals=animals)
    if _complete(target):
        return target
    dataset = stimuli() if callable(stimuli) else stimuli
    _remove_abandoned(target.parent)
    # The dot hides a half-made folder from searches for recordings.
    scratch = Path(tempfile.mkdtemp(prefix=".demo-", dir=target.parent))
    try:
        make_demo(scratch, dataset, seed=seed, animals=animals, progress=progress)
        scratch.chmod(0o755)
        _install(scratch, target)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return target


def _animal(index: int) -> list[SessionPlan]:
    plans = _ANIMALS[index % len(_ANIMALS)]
    return [replace(plan, subject=f"demo{index + 1:02d}") for plan in plans]


def _in_vocabulary_order(stimuli: xr.Dataset) -> xr.Dataset:
    wanted = [f"{shape}-{place}" for shape in rodgers.ORDERS["stimulus"] for place in rodgers.ORDERS["servo_position"]]
    have = [str(label) for label in stimuli["stimulus"].values]
    if sorted(have) != sorted(wanted):
        raise DataError(f"The demo recordings need the stimuli {listing(wanted)}; these are {listing(have)}.")
    if "contact" not in stimuli:
        raise DataError("The demo recordings need the stimuli's contact [stimulus, time, whisker]; these have none.")
    return stimuli.isel(stimulus=[have.index(label) for label in wanted])


def _first_contacts(
    labels: tuple[str, ...], runs: dict[str, list[NDArray[np.float64]]], lost: str | None = None
) -> NDArray[np.float64]:
    """First contact [K] (s after onset) of each stimulus with the whiskers whose contacts are known."""
    known = {name: items for name, items in runs.items() if name != lost}
    first = np.array(
        [
            min((items[stimulus][0, 0] for items in known.values() if len(items[stimulus])), default=np.inf)
            for stimulus in range(len(labels))
        ]
    )
    for label, onset in zip(labels, first, strict=True):
        if onset >= CHOICE[0]:
            raise DataError(f"The stimulus {label!r} touches none of {listing(known)} in time for the demo's choices.")
    return first


def _expected(rates: NDArray[np.float64], afferents: Afferents, first: NDArray[np.float64]) -> NDArray[np.float64]:
    """Expected response [K, U] in the layout's window, first contact to choice."""
    return window_rates(rates, afferents.frame, first, np.linspace(*CHOICE, 18))


def _shared(afferents: Afferents, first: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    plain = np.ones(afferents.values.shape[2:])
    random = np.random.default_rng([seed, VERSION, 10_000])
    # In portions: the rates of all units at once would take a gigabyte.
    portions = [draw_population(random, afferents, _MANY // 8, plain) for _ in range(8)]
    return correlation_rdm(np.concatenate([_expected(item.rates(afferents), afferents, first) for item in portions], 1))


def _complete(folder: Path) -> bool:
    try:
        files = read_json(folder / TRUTH)["files"]
        return all((folder / name).stat().st_size == item["bytes"] for name, item in files.items())
    except (DataError, OSError, KeyError, TypeError, AttributeError):
        return False


def _install(scratch: Path, target: Path) -> None:
    """Give a finished folder its name; another process may have been first."""
    try:
        scratch.rename(target)
    except OSError:
        if _complete(target):
            return
        _log.warning("The demo recordings in %s are damaged and are replaced.", target)
        with contextlib.suppress(FileNotFoundError):
            target.rename(Path(tempfile.mkdtemp(prefix=".demo-", dir=target.parent)) / "damaged")
        scratch.rename(target)


def _remove_abandoned(folder: Path) -> None:
    """Remove what a killed process left; a younger folder may belong to one that still runs."""
    for item in folder.glob(".demo-*"):
        with contextlib.suppress(OSError):
            if time.time() - item.stat().st_mtime > _ABANDONED:
                shutil.rmtree(item, ignore_errors=True)
