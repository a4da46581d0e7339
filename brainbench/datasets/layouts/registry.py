"""The registry of recipes: named ways to read a data set.

Other packages add theirs through the entry point group ``brainbench.recordings``: an entry point names a
:class:`~brainbench.datasets.RecordingLayout`, or a module whose import runs :func:`register_recipe`.
"""

from __future__ import annotations

import logging
from pathlib import Path

from brainbench.core.errors import UsageError, unknown_name
from brainbench.datasets.layouts import area2_bump, hires, rodgers, yu
from brainbench.datasets.layouts.layout import RecordingLayout
from brainbench.datasets.sessions import Session
from brainbench.datasets.trials.selection import DEFAULT, EVERYTHING, Selection

_log = logging.getLogger(__name__)

ENTRY_POINTS = "brainbench.recordings"

_RECIPES: dict[str, RecordingLayout] = {
    recipe.name: recipe
    for recipe in (
        rodgers.RECIPE,
        rodgers.DISCRIMINATION,
        rodgers.DETECTION,
        yu.RECIPE,
        hires.RECIPE,
        area2_bump.RECIPE,
    )
}
_SELECTIONS = {"none": EVERYTHING, "default": DEFAULT}
_loaded: list[str] = []
"""Groups of entry points that were loaded: once, on first use."""


def register_recipe(recipe: RecordingLayout) -> RecordingLayout:
    """Make a recipe known by its name and its layout for the rest of this process; returns it.

    On the command line ``FILE.py:PATH`` registers the ``RECIPE`` that a file defines.

    Raises:
        UsageError: another recipe has this name, or it could not be told from a path.
    """
    if not _is_name(recipe.name):
        raise UsageError(
            f"A recipe's name is a word of at least two letters, digits, '-' or '_', beginning with a letter; "
            f"received {recipe.name!r}."
        )
    known = _RECIPES.get(recipe.name)
    if known is not None and known != recipe:
        raise UsageError(f"There is already a recordings recipe {recipe.name!r} ({known.title}); choose another name.")
    _RECIPES[recipe.name] = recipe
    return recipe


def get_recipe(name: str) -> RecordingLayout:
    """Return a recipe by name.

    Raises:
        UsageError: there is no such recipe (the nearest is named).
    """
    if name not in _known():
        raise unknown_name("recordings recipe", name, _RECIPES)
    return _RECIPES[name]


def list_recipes() -> list[str]:
    """Names of the recipes."""
    return sorted(_known())


def detect_recipe(session: Session) -> RecordingLayout | None:
    """Return the recipe whose layout a session has, if any; of several the most specific one."""
    found = [recipe for recipe in _known().values() if recipe.matches(session)]
    return max(found, key=lambda recipe: len(recipe.layout), default=None)


def resolve_selection(select: Selection | str) -> Selection:
    """Return a selection from itself, a name ("none", "default" or a recipe's) or rules in text.

    Raises:
        UsageError: the text is neither a name nor a rule.
    """
    if isinstance(select, Selection):
        return select
    if select in _SELECTIONS:
        return _SELECTIONS[select]
    if select in _known():
        return _RECIPES[select].selection
    if "=" not in select:
        names = [*_SELECTIONS, *list_recipes()]
        raise unknown_name("selection", select, names, hint="Or write rules: 'outcome=correct; units.layer=4'.")
    return Selection.parse(select)


def split_source(source: str) -> tuple[str | None, str]:
    """Split ``RECIPE:PATH`` or ``FILE.py:PATH``; a source without a recipe gives (None, source).

    A prefix counts as a recipe when it is a bare word of at least two letters (so drive letters stay
    paths) and no file of the whole name exists. A Python file is run and its ``RECIPE`` registered.

    Raises:
        UsageError: the prefix is not a recipe, or the file defines none.
    """
    prefix, colon, rest = source.partition(":")
    if colon and prefix.endswith(".py") and not Path(source).exists():
        recipe = load_recipe(prefix)
    elif not colon or not _is_name(prefix) or Path(source).exists():
        return None, source
    else:
        recipe = None
    if not rest:
        raise UsageError(f"The source {source!r} names a recipe but no file; write {prefix}:PATH.")
    return (recipe or get_recipe(prefix)).name, rest


def load_recipe(path: str) -> RecordingLayout:
    """Run a Python file and register the recipe that it calls ``RECIPE``.

    Raises:
        UsageError: there is no such file, it fails, or it defines no recipe.
    """
    import runpy

    if not Path(path).is_file():
        raise UsageError(f"There is no recipe file {path!r}.")
    try:
        found = runpy.run_path(path).get("RECIPE")
    except Exception as error:
        raise UsageError(f"The recipe file {path!r} fails: {type(error).__name__}: {error}.") from error
    if not isinstance(found, RecordingLayout):
        raise UsageError(
            f"The recipe file {path!r} defines no RECIPE = brainbench.datasets.Recipe(…); docs/recordings.md shows one."
        )
    return register_recipe(found)


def _known() -> dict[str, RecordingLayout]:
    """Return the registry with the recipes of other packages."""
    if ENTRY_POINTS not in _loaded:
        _loaded.append(ENTRY_POINTS)
        _load_entry_points()
    return _RECIPES


def _load_entry_points() -> None:
    from importlib.metadata import entry_points

    for entry in entry_points(group=ENTRY_POINTS):
        try:
            found = entry.load()
            if isinstance(found, RecordingLayout):
                register_recipe(found)
        except Exception as error:  # noqa: BLE001 - another package's fault must not take our recipes away
            _log.warning("The recipe of entry point %r (%s) could not be loaded: %s", entry.name, entry.value, error)


def _is_name(word: str) -> bool:
    return len(word) >= 2 and word.replace("-", "_").isidentifier()
