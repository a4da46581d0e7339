"""Named ways to read a data set: its conditions, vocabulary, selection and window, in one record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

from brainbench.datasets import rodgers
from brainbench.datasets.conditions import Conditions
from brainbench.datasets.selection import DEFAULT, EVERYTHING, Selection
from brainbench.datasets.sessions import Session
from brainbench.datasets.window import Window
from brainbench.errors import UsageError, unknown_name


@dataclass(frozen=True)
class Recipe:
    """How one published data set is read. Every part can be overridden by an argument."""

    name: str
    title: str
    citation: str
    conditions: Conditions
    orders: Mapping[str, tuple[str, ...]]
    """Column → its values in fixed order; other values are not part of the experiment."""
    selection: Selection
    window: Window
    layout: tuple[str, ...]
    """Columns of the condition table by which a file of this data set is recognised."""
    remarks: tuple[str, ...] = ()

    def matches(self, session: Session) -> bool:
        """Tell whether a session has the layout of this data set."""
        table = session.tables.get(self.conditions.table)
        return table is not None and all(column in table for column in self.layout)

    def vocabulary(self, conditions: Conditions) -> tuple[str, ...] | None:
        """Return the fixed labels, or None if a column's values are not declared here."""
        if conditions.table != self.conditions.table or any(name not in self.orders for name in conditions.columns):
            return None
        return tuple("-".join(values) for values in product(*(self.orders[name] for name in conditions.columns)))

    def describe(self) -> str:
        """Print every rule of the recipe, one per line."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        yield f"{self.name}: {self.title}"
        yield f"citation: {self.citation}"
        yield f"conditions: {self.conditions}"
        yield f"vocabulary: {', '.join(self.vocabulary(self.conditions) or ())}"
        yield f"window: {self.window}"
        if self.window.fallback is not None:
            yield f"window of sessions without contact tables: {self.window.fallback}"
        yield from self.selection.lines()
        yield from self.remarks


_RECIPES = {
    recipe.name: recipe
    for recipe in (
        Recipe(
            name="rodgers",
            title=rodgers.TITLE,
            citation=rodgers.CITATION,
            conditions=rodgers.CONDITIONS,
            orders=rodgers.ORDERS,
            selection=rodgers.SELECTION,
            window=rodgers.WINDOW,
            layout=rodgers.LAYOUT,
            remarks=rodgers.REMARKS,
        ),
    )
}
_SELECTIONS = {"none": EVERYTHING, "default": DEFAULT, "rodgers": rodgers.SELECTION}


def get_recipe(name: str) -> Recipe:
    """Return a recipe by name.

    Raises:
        UsageError: there is no such recipe (the nearest is named).
    """
    if name not in _RECIPES:
        raise unknown_name("recordings recipe", name, _RECIPES)
    return _RECIPES[name]


def list_recipes() -> list[str]:
    """Names of the recipes."""
    return sorted(_RECIPES)


def detect_recipe(session: Session) -> Recipe | None:
    """Return the recipe whose layout a session has, if any."""
    return next((recipe for recipe in _RECIPES.values() if recipe.matches(session)), None)


def resolve_selection(select: Selection | str) -> Selection:
    """Return a selection from itself, a name ("none", "default", "rodgers") or rules in text.

    Raises:
        UsageError: the text is neither a name nor a rule.
    """
    if isinstance(select, Selection):
        return select
    if select in _SELECTIONS:
        return _SELECTIONS[select]
    if "=" not in select:
        raise unknown_name("selection", select, _SELECTIONS, hint="Or write rules: 'outcome=correct; units.layer=4'.")
    return Selection.parse(select)


def split_source(source: str) -> tuple[str | None, str]:
    """Split ``RECIPE:PATH``; a source without a recipe gives (None, source).

    A prefix counts as a recipe when it is a bare word of at least two letters (so drive letters stay
    paths) and no file of the whole name exists.

    Raises:
        UsageError: the prefix is not a recipe.
    """
    from pathlib import Path

    prefix, colon, rest = source.partition(":")
    if not colon or len(prefix) < 2 or not prefix.isidentifier() or Path(source).exists():
        return None, source
    if not rest:
        raise UsageError(f"The source {source!r} names a recipe but no file; write {prefix}:PATH.")
    return get_recipe(prefix).name, rest
