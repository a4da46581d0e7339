"""Stimuli from anywhere: a recipe, a scene file, a stimulus-set file or an array file."""

from __future__ import annotations

import contextlib
import functools
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import check_stimulus_set
from brainbench.core.errors import BrainbenchError, DataError, UsageError, listing, unknown_name
from brainbench.core.files import content_hash
from brainbench.core.progress import Progress
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import readable
from brainbench.core.reading.texts import read_toml
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.scenes.recipes import get_recipe, is_packaged, is_recipe, list_recipes, recipe_file
from brainbench.stimuli.stimulus_set import find_kept, hash_stimulus_set, read_stimulus_set, to_grid
from brainbench.stimuli.whiskers.array import match_whiskers

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.stimuli.engines.protocol import WhiskerEngine
    from brainbench.stimuli.scenes.scene_files import Recipe

_HDF5 = (".h5", ".hdf5", ".nc")


@dataclass(frozen=True, eq=False)
class Stimuli:
    """Labelled stimuli, ready for a model."""

    labels: tuple[str, ...]
    """One per stimulus, all different."""
    input: NDArray[np.float32]
    """[K, T, …] what the model receives; [K, T, S·C, H, W] in SI units for simulated stimuli."""
    dataset: xr.Dataset | None
    """The stimulus set behind ``input``; None for arrays from a file."""
    content_hash: str
    """Equal for equal stimuli."""
    description: str
    config_hash: str
    """Names what was asked for; equal on every machine, while the last digits of a simulation, and with
    them ``content_hash``, depend on the processor. Equal to ``content_hash`` for arrays from a file."""

    @property
    def error(self) -> float | None:
        """Estimated error of all forces or moments (the larger), as a share of them; None where none was estimated.

        Root mean square over stimuli and whiskers, so that those count most that feel most.
        """
        if self.dataset is None or "error" not in self.dataset:
            return None
        errors = self.dataset["error"].values.astype(float)
        wrench = np.nan_to_num(self.dataset["wrench"].values.astype(float))
        shares = [0.0]
        for part in (wrench[..., :3], wrench[..., 3:]):
            power = np.mean(np.sum(part**2, axis=3), axis=1)
            if power.any():
                felt = np.where((power > 0) & ~np.isnan(errors), errors, 0.0)
                shares.append(np.sqrt(np.average(felt**2, weights=power)))
        return float(max(shares))

    @property
    def promise(self) -> float | None:
        """Error that the fidelity promised each whisker; None where it promised none, or is not known."""
        text = "" if self.dataset is None else str(self.dataset.attrs.get("fidelity"))
        return next(map(float, re.findall(r'"error": (\d+\.?\d*(?:e-\d+)?)', text)), None)

    def __repr__(self) -> str:
        shape = " × ".join(map(str, self.input.shape))
        return f"Stimuli({listing(self.labels, limit=6)}; input {shape}; hash {self.content_hash})"


def load_stimuli(
    source: str | os.PathLike[str] | Stimuli | xr.Dataset,
    *,
    whiskers: str = "all",
    fidelity: Fidelity | str | None = None,
    backend: WhiskerEngine | str = DEFAULT_ENGINE,
    progress: Progress | None = None,
    cache: bool = True,
) -> Stimuli:
    """Return stimuli from whatever names them.

    Args:
        source: a recipe (``rodgers``); a scene file (``.toml``); a stimulus-set file written by
            :func:`write_stimulus_set`, or the data set itself; or an HDF5 array file with the
            datasets ``stimuli`` [K, T, …] (numbers, as the model shall receive them) and ``labels``
            [K] (texts). Recipes and scenes are simulated, or taken from the cache.
        whiskers: only these; see :meth:`WhiskerArray.select`. Not for array files.
        fidelity, backend, progress, cache: as in :func:`simulate`; unused for files of finished stimuli.
    """
    if isinstance(source, Stimuli):
        if whiskers != "all" and source.dataset is None:
            raise UsageError("These stimuli are arrays, in which whiskers have no names; leave the selection at 'all'.")
        return source if whiskers == "all" else load_stimuli(source.dataset, whiskers=whiskers)  # type: ignore[arg-type]
    if _is_array_file(source):
        with open_hdf5(Path(source), "stimulus file") as file:
            return _read_arrays(file, os.fspath(source), whiskers)
    dataset, description = load_stimulus_set(
        source, whiskers=whiskers, fidelity=fidelity, backend=backend, progress=progress, cache=cache
    )
    labels = tuple(str(label) for label in dataset["stimulus"].values)
    numbers = dataset.attrs["content_hash"]
    with readable(source, "stimulus set") if _is_file(source) else contextlib.nullcontext():
        return Stimuli(
            labels, to_grid(dataset), dataset, numbers, description, dataset.attrs.get("config_hash", numbers)
        )


def load_stimulus_set(
    source: str | os.PathLike[str] | xr.Dataset,
    *,
    whiskers: str = "all",
    fidelity: Fidelity | str | None = None,
    backend: WhiskerEngine | str = DEFAULT_ENGINE,
    progress: Progress | None = None,
    cache: bool = True,
) -> tuple[xr.Dataset, str]:
    """Return the stimulus set that a source names, and its description; arguments are those of :func:`load_stimuli`.

    Whiskers that became unstable are NaN in it, with ``status`` and ``reason``; :func:`load_stimuli` refuses them.
    """
    if _is_array_file(source):
        raise UsageError(f"{os.fspath(source)!r} holds arrays, not forces of whiskers with names.")
    if not isinstance(source, (str, os.PathLike)):
        dataset = check_stimulus_set(source)
        if (numbers := hash_stimulus_set(dataset)) != dataset.attrs["content_hash"]:
            # It was edited since it was hashed, so it is no longer what its configuration gives either.
            dataset = dataset.assign_attrs(content_hash=numbers, config_hash=numbers)
        return _select(dataset, whiskers), "stimulus set"
    from brainbench.stimuli.simulation import read_entry, simulate

    if cache and isinstance(backend, str) and is_packaged(source):
        packaged = find_kept(source, whiskers, Fidelity.of(fidelity), backend)
        if packaged is not None and (shipped := read_entry(packaged[0])) is not None:
            return shipped, packaged[1]
    if (recipe := _recipe(source, whiskers)) is not None:
        dataset = simulate(recipe.scenes, fidelity=fidelity, backend=backend, progress=progress, cache=cache)
        return dataset, recipe.description.strip() or recipe.name
    path = Path(source)
    if _is_file(source):
        dataset = read_stimulus_set(path)
        with readable(path, "stimulus set"):
            return _select(dataset, whiskers), f"stimulus set {path.name}"
    hint = f"Or a path: a scene file (.toml), or a stimulus-set or array file ({', '.join(_HDF5)})."
    raise unknown_name("stimuli", os.fspath(source), list_recipes(), hint=hint)


def _is_file(source: object) -> TypeGuard[str | os.PathLike[str]]:
    """Return whether a source is the path of a file of finished stimuli, there or not."""
    if not isinstance(source, (str, os.PathLike)) or is_packaged(source):
        return False
    path = Path(source)
    return path.suffix in _HDF5 or (path.suffix != ".toml" and path.is_file())


def _is_array_file(source: object) -> TypeGuard[str | os.PathLike[str]]:
    """Return whether a source is an HDF5 file without forces of whiskers."""
    if not _is_file(source):
        return False
    with open_hdf5(Path(source), "stimulus file") as file:
        return "wrench" not in file


def is_finished(source: object) -> bool:
    """Return whether a source is finished stimuli, in memory or in an HDF5 file, which no fidelity changes."""
    return not isinstance(source, (str, os.PathLike)) or Path(source).suffix in _HDF5


def known_labels(source: object) -> tuple[str, ...] | None:
    """Return the labels of a packaged recipe or a scene file, before its scenes are built; None for anything else."""
    labels = stated_labels(source)
    return None if any("{trial}" in label for label in labels or ()) else labels


def stated_labels(source: object) -> tuple[str, ...] | None:
    """Return the same as the file writes them, with ``{trial}`` in place of the names of trials."""
    with contextlib.suppress(BrainbenchError, OSError, KeyError, TypeError):
        path = Path(str(recipe_file(source))) if is_packaged(source) else source
        if isinstance(path, (str, os.PathLike)) and Path(path).suffix == ".toml":
            return tuple(item["label"] for item in read_toml(path, "scene file")["scene"])
    return None


def prepare_stimuli(
    source: object, *, whiskers: str = "all", fidelity: Fidelity | str | None = None, progress: Progress | None = None
) -> None:
    """Begin, in a thread, what :func:`load_stimuli` will wait for (:func:`brainbench.stimuli.simulation.prepare`).

    Whatever does not have to be simulated is left alone, and so is what cannot be: ``load_stimuli`` says why.
    """
    from brainbench.stimuli.simulation import prepare

    with contextlib.suppress(BrainbenchError, OSError):
        if is_packaged(source) and find_kept(source, whiskers, Fidelity.of(fidelity), DEFAULT_ENGINE) is not None:
            return
        if isinstance(source, (str, os.PathLike)) and (recipe := _recipe(source, whiskers)) is not None:
            prepare(recipe.scenes, fidelity=fidelity, progress=progress)


def _recipe(source: str | os.PathLike[str], whiskers: str) -> Recipe | None:
    """Return the scenes that a recipe name or the path of a scene file names; None for anything else."""
    if is_packaged(source):
        return _packaged(source, whiskers=whiskers)
    if isinstance(source, str) and is_recipe(source):
        return get_recipe(source, whiskers=whiskers)
    if Path(source).suffix != ".toml":
        return None
    from brainbench.stimuli.scenes.scene_files import load_scene

    return load_scene(source, whiskers=whiskers)


# A recipe of the package, whose meshes take longest of all; a score asks for it several times.
_packaged = functools.lru_cache(maxsize=1)(get_recipe)


def _select(dataset: xr.Dataset, whiskers: str) -> xr.Dataset:
    """Return a stimulus set with some whiskers only, hashed anew."""
    if whiskers == "all":
        return dataset
    names = [str(name) for name in dataset["whisker"].values]
    rows, cols = dataset["row"].values.tolist(), dataset["col"].values.tolist()
    chosen = dataset.isel(whisker=match_whiskers(whiskers, names, rows, cols))
    config = content_hash(dataset.attrs.get("config_hash", ""), chosen["whisker"].values.astype(str).tolist())
    return chosen.assign_attrs(content_hash=hash_stimulus_set(chosen), config_hash=config)


def _read_arrays(file: Any, name: str, whiskers: str) -> Stimuli:
    """Read ``stimuli`` [K, T, …] and ``labels`` [K]."""
    import h5py

    if whiskers != "all":
        raise UsageError(f"{name!r} holds arrays, in which whiskers have no names; leave the selection at 'all'.")
    arrays = {key: item for key, item in file.items() if isinstance(item, h5py.Dataset)}
    missing = [key for key in ("stimuli", "labels") if key not in arrays]
    if missing:
        held = listing(f"{key} {list(item.shape)}" for key, item in arrays.items())
        raise DataError(
            f"{name!r} is neither a stimulus set (no 'wrench') nor an array file: it lacks {' and '.join(missing)};"
            f" an array file has 'stimuli' [K, T, …] and 'labels' [K]. It holds: {held}."
        )
    stimuli, labels = arrays["stimuli"], arrays["labels"]
    if stimuli.ndim < 2 or stimuli.dtype.kind not in "fiu":
        raise DataError(
            f"'stimuli' in {name!r} must be numbers of shape [K, T, …]; it is {list(stimuli.shape)} of {stimuli.dtype}."
        )
    if h5py.check_string_dtype(labels.dtype) is None or labels.shape != stimuli.shape[:1]:
        raise DataError(
            f"'labels' in {name!r} must be {stimuli.shape[0]} texts, one per stimulus;"
            f" it is {list(labels.shape)} of {labels.dtype}."
        )
    texts = tuple(str(label) for label in labels.asstr()[:])
    if len(set(texts)) < len(texts):
        raise DataError(f"'labels' in {name!r} names a stimulus twice: {listing(texts)}.")
    values = stimuli[()].astype(np.float32)
    if not np.isfinite(values).all():
        bad = sorted({texts[index[0]] for index in np.argwhere(~np.isfinite(values))})
        raise DataError(f"'stimuli' in {name!r} has values that are not finite, in {listing(bad)}.")
    numbers = content_hash(list(texts), values)
    return Stimuli(texts, values, None, numbers, f"arrays {list(values.shape)} from {name}", numbers)
