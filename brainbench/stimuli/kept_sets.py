"""Simulated sets of the package, which are found without building their scenes.

They are the sets of some recipes as the package's own engine gave them, so that a first score neither compiles nor
simulates (``python -m tests.factories.shipped_stimuli`` writes them). The errors of their whiskers stand beside them.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.files import file_hash, read_json
from brainbench.stimuli.engines import PHYSICS_VERSION
from brainbench.stimuli.engines.error_estimates import remark_on
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.scenes.recipes import describe_recipe, recipe_file

if TYPE_CHECKING:
    import xarray as xr

SHIPPED = Path(__file__).with_name("data") / "sets"
"""Folder of the package's own sets. A set has the name that its entry in the cache would have."""
SHIPPED_INDEX = SHIPPED / "index.json"
"""Recipe → name of its set, with the version of the physics and the hash of the scene file that it was made from."""


def shipped_facts(recipe: str) -> dict[str, object]:
    """Return what the package's set of a recipe depends on, as its index states it."""
    return {"physics": PHYSICS_VERSION, "scenes": file_hash(Path(str(recipe_file(recipe))))}


def find_kept(recipe: str, whiskers: str, fidelity: Fidelity, backend: str) -> tuple[Path, str] | None:
    """Return the package's set of a recipe with these options, and its description; None where it holds none."""
    held = read_json(SHIPPED_INDEX).get(recipe, {})
    entry = held.pop("entry", "")
    if (whiskers, fidelity, backend) != ("all", Fidelity.of(None), DEFAULT_ENGINE) or held != shipped_facts(recipe):
        return None
    return SHIPPED / entry, describe_recipe(recipe).strip()


def find_entry(path: Path) -> Path | None:
    """Return the file of an entry of the cache: the package's own, which is equal on every machine, goes first."""
    return next((file for file in (SHIPPED / path.name, path) if file.is_file()), None)


def error_file(path: Path) -> Path:
    """Return the file beside a set with the ``error`` and ``damping`` [stimulus, whisker] of its whiskers."""
    return path.with_suffix(".errors.json")


def with_kept_errors(dataset: xr.Dataset, path: Path) -> xr.Dataset:
    """Return a set with the errors that stand beside its file; as it is without any."""
    if not error_file(path).is_file():
        return dataset
    held = {name: np.array(values, dtype=np.float32) for name, values in read_json(error_file(path)).items()}
    remarks = np.vectorize(remark_on, otypes=[object])(held["error"])
    return dataset.assign(
        {name: (("stimulus", "whisker"), values) for name, values in {**held, "remark": remarks}.items()}
    )
