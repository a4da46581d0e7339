"""Simulated sets that are found without building their scenes: those in the package, and recipes in the cache.

The package holds the sets of some recipes as its own engine gave them, so that a first score neither compiles nor
simulates (``python -m tests.factories.shipped_stimuli`` writes them). Building the meshes of a recipe only to name its
entry takes longer than reading the entry, so a small file leads from what was asked for to the entry and its
description.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from brainbench.core.errors import DataError
from brainbench.core.files import cache_dir, content_hash, file_hash, read_json, write_json
from brainbench.core.reading.sealed import code_stamp
from brainbench.stimuli.engines import DEFAULT_ENGINE, PHYSICS_VERSION
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.scenes.recipes import describe_recipe, recipe_file

SHIPPED = Path(__file__).with_name("data") / "sets"
"""Folder of the package's own sets. A set has the name that its entry in the cache would have."""
SHIPPED_INDEX = SHIPPED / "index.json"
"""Recipe → name of its set, with the version of the physics and the hash of the scene file that it was made from."""


def shipped_facts(recipe: str) -> dict[str, object]:
    """Return what the package's set of a recipe depends on, as its index states it."""
    return {"physics": PHYSICS_VERSION, "scenes": file_hash(Path(str(recipe_file(recipe))))}


def find_kept(recipe: str, whiskers: str, fidelity: Fidelity, backend: str) -> tuple[Path, str] | None:
    """Return the entry of a recipe with these options, and its description; None where nothing is kept of it."""
    held = read_json(SHIPPED_INDEX).get(recipe, {})
    entry = held.pop("entry", "")
    if (whiskers, fidelity, backend) == ("all", Fidelity.of(None), DEFAULT_ENGINE) and held == shipped_facts(recipe):
        return SHIPPED / entry, describe_recipe(recipe).strip()
    try:
        held = read_json(index_path(recipe, whiskers, fidelity, backend))
        entry = find_entry(cache_dir("stimuli") / held["entry"])
        return None if entry is None else (entry, held["description"])
    except (DataError, KeyError, TypeError):
        return None


def find_entry(path: Path) -> Path | None:
    """Return the file of an entry of the cache: the package's own, which is equal on every machine, goes first."""
    return next((file for file in (SHIPPED / path.name, path) if file.is_file()), None)


def index_path(*asked: object) -> Path:
    """Return the file that leads to the entry for a recipe with these options."""
    return cache_dir("stimuli", "recipes") / f"{content_hash(asked, code_stamp())}.json"


def write_index(path: Path, entry: Path, description: str) -> None:
    """Lead from ``path`` to an entry of the cache; nothing is lost where that cannot be written."""
    with contextlib.suppress(OSError):
        write_json(path, {"entry": entry.name, "description": description})
