"""Public names of a package that are imported on first use, so that importing the package stays quick."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_exports(package: str, exports: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's ``__getattr__`` and ``__dir__`` for names that stand in other modules.

    Args:
        package: ``__name__`` of the package.
        exports: public name → the module that holds it, relative to the package where it begins with a dot. A module
            itself is exported by a path that ends in its name and a dot: ``{"references": ".validation.references."}``.
    """

    def load(name: str) -> Any:
        if name not in exports:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        path = exports[name]
        module = import_module(path.removesuffix("."), package)
        value = module if path.endswith(".") else getattr(module, name)
        setattr(sys.modules[package], name, value)
        return value

    return load, lambda: sorted(exports)
