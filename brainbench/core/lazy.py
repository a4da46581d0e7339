"""Public names of a package, and modules, that are imported on first use, so that importing a package stays quick."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any


class _Stand(ModuleType):
    def __getattr__(self, name: str) -> Any:
        value = getattr(import_module(self.__name__), name)
        setattr(self, name, value)
        return value


def lazy_module(name: str) -> Any:
    """Return a stand-in for a module that is slow to import: it is imported when something of it is first asked for."""
    return _Stand(name)


def lazy_exports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package (``__name__``) for its ``__all__`` and for its modules.

    Where a name stands is read from the imports under ``if TYPE_CHECKING:``, which type checkers read too.
    """

    @cache
    def exports() -> dict[str, str]:
        """Return the module of each public name, from the source of the package."""
        import ast  # as slow as all of the package, and not needed to import it
        from pathlib import Path

        module = sys.modules[package]
        blocks = [
            node.body
            for node in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        ]
        imports = [node for body in blocks for node in body if isinstance(node, ast.ImportFrom)]
        modules = {alias.name: str(node.module) for node in imports for alias in node.names}
        return {name: where for name, where in modules.items() if name in module.__all__}

    def load(name: str) -> Any:
        """Import a name of the package, or one of its modules, and keep it there."""
        if where := exports().get(name):
            value = getattr(import_module(where), name)
        elif not name.startswith("_") and find_spec(f"{package}.{name}"):
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        setattr(sys.modules[package], name, value)
        return value

    return load, lambda: sorted(exports())
