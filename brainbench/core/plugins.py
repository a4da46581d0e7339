"""Objects of users and of other packages: ``FILE.py:NAME``, ``package.module:NAME`` and entry points."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from brainbench.core.errors import BrainbenchError, DataError, DataFileNotFoundError, UsageError, unknown_name

_LOG = logging.getLogger(__name__)
_beside: dict[str, Path] = {}
"""Modules that the last file imported from its own folder. The next file may mean others by these names."""
_files: dict[Path, tuple[Path, ...]] = {}
"""File of a user → that file, and those of its folder that it imported."""


def load_object(target: str, kind: str) -> Any:
    """Return the object NAME of ``path/to/FILE.py:NAME`` or ``package.module:NAME``; the file or module is run.

    Args:
        target: as above. The file's own folder can be imported from while it loads.
        kind: what is loaded, for messages: ``model``, ``metric``, ``layout``.

    Raises:
        DataFileNotFoundError: there is no such file or module.
    """
    path, _, name = target.rpartition(":")
    if not path or not name:
        raise UsageError(f"A {kind} of your own is FILE.py:NAME or package.module:NAME; received {target!r}.")
    module = load_module(path)
    if not hasattr(module, name):
        choices = [key for key, value in vars(module).items() if not key.startswith("_") and callable(value)]
        raise unknown_name(f"{kind} in {path!r}", name, choices)
    return getattr(module, name)


def load_module(path: str) -> ModuleType:
    """Import ``path/to/file.py`` or ``package.module``.

    Raises:
        DataFileNotFoundError: there is no such file or module.
        BrainbenchError: what the code itself raises of this kind stays as it is.
    """
    is_file = path.endswith(".py") or "/" in path or "\\" in path
    if is_file and not Path(path).is_file():
        raise DataFileNotFoundError(f"There is no Python file {path!r}.")
    try:
        return _import_file(Path(path).resolve()) if is_file else importlib.import_module(path)
    except ModuleNotFoundError as error:
        if not is_file and error.name is not None and (path == error.name or path.startswith(f"{error.name}.")):
            raise DataFileNotFoundError(f"There is no Python module {path!r}; a file is given as {path}.py.") from error
        raise DataError(f"Importing {path!r} failed: {error}.") from error
    except BrainbenchError:
        raise
    except Exception as error:
        raise DataError(f"Importing {path!r} failed with {type(error).__name__}: {error}.") from error


def files_of(path: Path) -> tuple[Path, ...]:
    """Return the files that made a module of a user: its own, and those of its folder that it imported, if loaded."""
    return _files.get(path.resolve(), (path,))


def load_entry_points(group: str, take: Callable[[str, Any], None]) -> None:
    """Hand every object of an entry-point group to ``take(name, object)``; a faulty one is logged and left out."""
    from importlib.metadata import entry_points

    for entry in entry_points(group=group):
        try:
            take(entry.name, entry.load())
        except Exception as error:  # noqa: BLE001 - another package's fault must not take ours away
            _LOG.warning("The entry point %r (%s) of %s could not be loaded: %s", entry.name, entry.value, group, error)


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
    _files[path] = (path, *sorted({*_beside.values()} - {path}))
    return module


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """Let modules be imported from a folder; those of an earlier folder or state of the files are forgotten first."""
    for name in _beside:
        sys.modules.pop(name, None)
    _beside.clear()
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for name in sys.modules.keys() - before:
            file, top = Path(getattr(sys.modules[name], "__file__", None) or ""), name.partition(".")[0]
            # What is installed in an environment below the folder is not its own.
            if file == folder / f"{top}.py" or file.is_relative_to(folder / top):
                _beside[name] = file
