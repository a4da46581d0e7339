"""The stimulus sets that the package ships, and how to make them anew.

``python -m tests.factories.shipped_stimuli`` simulates them again, to be done whenever ``PHYSICS_VERSION`` is raised
or the scenes of these recipes change.
"""

from __future__ import annotations

import xarray as xr

from brainbench.core.files import atomic_path, write_json
from brainbench.core.reading.sealed import seal_file
from brainbench.stimuli import Fidelity, get_recipe
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.kept_sets import SHIPPED, SHIPPED_INDEX, shipped_facts
from brainbench.stimuli.simulation import cache_path, simulate_uncached

RECIPES = ("objects", "rodgers")
"""Stimuli of the demo recordings, and of whatever names none."""
FIDELITY = Fidelity.of("balanced,twist=false")
"""The default, as scenes without twist resolve it."""


def entry_name(recipe: str) -> str:
    """Return the name of the cache's entry for a recipe with default options."""
    return cache_path(get_recipe(recipe).scenes, FIDELITY, get_engine("rod")).name


def simulate_again(recipe: str) -> xr.Dataset:
    """Return the set of a recipe, simulated now."""
    return simulate_uncached(get_recipe(recipe).scenes, FIDELITY, get_engine("rod"))


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


if __name__ == "__main__":
    write()
