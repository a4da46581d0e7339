"""A user's own model, from a file or an installed module, without registering it."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import sys
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, unknown_name
from brainbench.models.ops.seeding import seeded

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import ModuleType

    from torch import nn


def load_user_model(target: str, *, seed: int = 0) -> nn.Module:
    """Build a model from ``path/to/file.py:name`` or ``package.module:name``, in evaluation mode.

    ``name`` is a class or function without required arguments, or a ready module. The file's own folder
    can be imported from while it loads. Random weights follow from the seed (CPU generator).

    Raises:
        UsageError: the target is not of this form, has no such name, or does not give a
            :class:`torch.nn.Module`.
        DataError: the file or module cannot be imported, or building the model fails.
    """
    path, colon, name = target.rpartition(":")
    if not colon or not path or not name:
        raise UsageError(
            f"A model of your own is given as path/to/file.py:make_model or package.module:make_model; "
            f"received {target!r}."
        )
    from torch import nn

    with seeded(seed):
        module = _import(path)
        if not hasattr(module, name):
            choices = [key for key, value in vars(module).items() if not key.startswith("_") and callable(value)]
            raise unknown_name(f"model in {path!r}", name, choices)
        made = getattr(module, name)
        if not isinstance(made, nn.Module):
            made = _call(made, target)
    if not isinstance(made, nn.Module):
        raise UsageError(f"{target!r} gave a {type(made).__name__}, not a torch.nn.Module; return the model itself.")
    return made.eval()


def _call(made: Any, target: str) -> Any:
    if not callable(made):
        return made
    try:
        return made()
    except Exception as error:
        raise DataError(
            f"Building the model {target!r} failed with {type(error).__name__}: {error} "
            "(it is called without arguments)."
        ) from error


def _import(path: str) -> ModuleType:
    is_file = path.endswith(".py") or "/" in path or "\\" in path
    if is_file and not Path(path).is_file():
        raise DataFileNotFoundError(f"There is no Python file {path!r}.")
    try:
        return _import_file(Path(path).resolve()) if is_file else importlib.import_module(path)
    except ModuleNotFoundError as error:
        if not is_file and error.name is not None and (path == error.name or path.startswith(f"{error.name}.")):
            raise DataFileNotFoundError(f"There is no Python module {path!r}; a file is given as {path}.py.") from error
        raise DataError(f"Importing {path!r} failed: {error}.") from error
    except Exception as error:
        raise DataError(f"Importing {path!r} failed with {type(error).__name__}: {error}.") from error


def _import_file(path: Path) -> ModuleType:
    # The name is the file's own, so that classes defined there can be found again by their module.
    name = f"brainbench_user_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{str(path)!r} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _importable(path.parent):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
