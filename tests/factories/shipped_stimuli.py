"""The stimulus sets that the package ships, and how to make them anew.

``python -m tests.factories.shipped_stimuli`` simulates them again, to be done whenever ``PHYSICS_VERSION`` is raised
or the scenes of these recipes change; ``python -m tests.factories.shipped_stimuli errors`` only their errors.
"""

from __future__ import annotations

import sys

import numpy as np
import xarray as xr

from brainbench.core.files import atomic_path, to_json, write_json, write_text
from brainbench.core.reading.sealed import seal_file
from brainbench.stimuli import Fidelity, get_recipe
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.simulation import cache_path, simulate_uncached
from brainbench.stimuli.stimulus_set import SHIPPED, SHIPPED_INDEX, error_file, shipped_facts

RECIPES = ("objects", "rodgers")
"""Stimuli of the demo recordings, and of whatever names none."""
FIDELITY = Fidelity.of("balanced,twist=false")
"""The default, as scenes without twist resolve it."""


def entry_name(recipe: str) -> str:
    """Return the name of the cache's entry for a recipe with default options."""
    return cache_path(get_recipe(recipe).scenes, FIDELITY, get_engine("rod")).name


def simulate_again(recipe: str, *, errors: bool = False) -> xr.Dataset:
    """Return the set of a recipe, simulated now."""
    return simulate_uncached(get_recipe(recipe).scenes, FIDELITY, get_engine("rod", errors=errors))


def write_errors() -> None:
    """Write the errors of the sets beside them."""
    for recipe in RECIPES:
        dataset = simulate_again(recipe, errors=True)
        values = {name: np.char.mod("%.3g", dataset[name].values).astype(float) for name in ("error", "damping")}
        assert np.isfinite(values["error"]).all()
        write_text(error_file(SHIPPED / entry_name(recipe)), to_json(values, indent=None) + "\n")


def write() -> None:
    SHIPPED.mkdir(exist_ok=True)
    for old in SHIPPED.iterdir():
        old.unlink()
    index = {}
    for recipe in RECIPES:
        dataset, path = simulate_again(recipe), SHIPPED / entry_name(recipe)
        small = {name: {"zlib": True, "complevel": 9} for name, held in dataset.items() if held.dtype.kind in "fb"}
        with atomic_path(path) as temporary:
            dataset.to_netcdf(temporary, engine="h5netcdf", encoding=small)
        seal_file(path)
        index[recipe] = {"entry": path.name, **shipped_facts(recipe)}
    write_json(SHIPPED_INDEX, index)
    write_errors()


if __name__ == "__main__":
    write_errors() if sys.argv[1:] == ["errors"] else write()
