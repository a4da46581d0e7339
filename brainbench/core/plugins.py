"""Objects of users and of other packages: ``FILE.py:NAME``, ``package.module:NAME`` and entry points.

Optional folders of this project register their commands, metrics, engines and so on as entry points too
(``pyproject.toml``). Such a folder may be deleted: its entries are then left out of every list, and whoever asks for
one of them by name reads which folder held it.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import importlib.util
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES, ExtensionFileLoader, FileFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

from brainbench.core.errors import (
    BrainbenchError,
    DataError,
    DataFileNotFoundError,
    MissingDependencyError,
    UsageError,
    unknown_name,
)
from brainbench.core.reading.regular import reason

_LOG = logging.getLogger(__name__)
_beside: dict[str, Path] = {}
"""Modules that the last file imported from its own folder. The next file may mean others by these names."""
_files: dict[Path, tuple[Path, ...]] = {}  # file of a user → that file, and those of its folder that it imported


class _AsWritten(SourceFileLoader):
    """Compiles a file as it stands: bytecode is kept by time in seconds and length, which an edit may leave alone."""

    def get_code(self, fullname: str) -> CodeType:
        """Return the compiled file, never its bytecode on disk."""
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)


_finder_of = FileFinder.path_hook((ExtensionFileLoader, EXTENSION_SUFFIXES), (_AsWritten, SOURCE_SUFFIXES))


def load_object(target: str, kind: str) -> Any:
    """Return the object NAME of ``path/to/FILE.py:NAME`` or ``package.module:NAME``; the file or module is run.

    Args:
        target: as above. The file's own folder can be imported from while it loads.
        kind: what is loaded, for messages: ``model``, ``metric``, ``layout``.
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
    """Import ``path/to/file.py`` or ``package.module``; errors of ours that the code raises stay as they are."""
    is_file = path.endswith(".py") or "/" in path or "\\" in path
    if is_file and not Path(path).is_file():
        raise DataFileNotFoundError(f"There is no Python file {path!r}.")
    with foreign_code(f"Importing {path!r}"):
        try:
            return _import_file(Path(path).resolve()) if is_file else importlib.import_module(path)
        except ModuleNotFoundError as error:
            if not is_file and error.name is not None and (path == error.name or path.startswith(f"{error.name}.")):
                absent = f"There is no Python module {path!r}; a file is given as {path}.py."
                raise DataFileNotFoundError(absent) from error
            raise DataError(f"Importing {path!r} failed: {error}.") from error


@contextmanager
def foreign_code(what: str, after: str = "") -> Iterator[None]:
    """Turn whatever code of a user raises, and its wish to end the process, into one :class:`DataError`."""
    try:
        yield
    except BrainbenchError:
        raise
    except (Exception, SystemExit) as error:
        raise DataError(f"{what} failed with {reason(error)}{after}.") from error


def files_of(path: Path) -> tuple[Path, ...]:
    """Return the files that made a module of a user: its own, and those of its folder that it imported, if loaded."""
    return _files.get(path.resolve(), (path,))


@dataclass(frozen=True)
class OptionalPart:
    """An entry point: a named object that its module, possibly in a folder that was taken off, adds to a group."""

    group: str
    """Entry-point group, for instance ``brainbench.commands``."""
    name: str
    target: str
    """``package.module:attribute``."""

    @property
    def present(self) -> bool:
        """Whether its module can be found; nothing of it is imported for that."""
        if self._source() is not None:
            return True
        try:
            return importlib.util.find_spec(self.target.partition(":")[0]) is not None
        except ImportError:
            return False

    @property
    def taken_off(self) -> bool:
        """Whether its package is here without the folder that should hold it."""
        return not self.present and _folder_of(self.target.partition(".")[0]) is not None

    @property
    def folder(self) -> str:
        """Folder that holds it, from the root of the checkout: the outermost one that is missing, if one is."""
        package = self.target.partition(":")[0].rpartition(".")[0]
        parts, root = package.split("."), _folder_of(package.partition(".")[0])
        for depth in range(1, len(parts) + 1):
            if root is None or not any(root.parent.joinpath(*parts[:depth]).glob("*.py")):
                return "/".join(parts[:depth])
        return "/".join(parts)

    @property
    def summary(self) -> str:
        """First line of its documentation, read from its source: the help of a command group, else the docstring."""
        source, attribute = self._source(), self.target.partition(":")[2]
        for node in ast.parse(source.read_text(encoding="utf-8")).body if source is not None else []:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == attribute:
                return (ast.get_docstring(node) or "").partition("\n")[0]
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call) and _assigns(node, attribute):
                texts = [keyword.value for keyword in node.value.keywords if keyword.arg == "help"]
                return str(texts[0].value) if texts and isinstance(texts[0], ast.Constant) else ""
        return ""

    def load(self, kind: str) -> Any:
        """Import and return the object; ``kind`` is what it is, for messages: ``command``, ``metric``, ``engine``."""
        module, _, attribute = self.target.partition(":")
        words = self.name.replace(".", " ")
        if self.taken_off:
            raise MissingDependencyError(
                f"The {kind} {words!r} belongs to the optional folder {self.folder}, which is "
                "not in this installation; put the folder back to use it."
            )
        try:
            loaded = importlib.import_module(module)
            return getattr(loaded, attribute) if attribute else loaded
        except BrainbenchError:
            raise
        except Exception as error:
            raise MissingDependencyError(
                f"The {kind} {words!r} ({self.target}) could not be loaded: {type(error).__name__}: {error}."
            ) from error

    def _source(self) -> Path | None:
        module = self.target.partition(":")[0]
        root = _folder_of(module.partition(".")[0])
        if root is None:
            return None
        path = root.parent.joinpath(*module.split("."))
        return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def optional_parts(group: str) -> dict[str, OptionalPart]:
    """Return the entries of an entry-point group by name, whether or not their folders are there."""
    from importlib.metadata import entry_points

    return {entry.name: OptionalPart(group, entry.name, entry.value) for entry in entry_points(group=group)}


def load_optional(group: str, name: str, kind: str) -> Any | None:
    """Return the object of one name of a group, or None where no entry has the name."""
    part = optional_parts(group).get(name)
    return None if part is None else part.load(kind)


def require_optional(group: str, name: str, kind: str) -> Any:
    """Return the object of one name of a group that ships with this package."""
    part = load_optional(group, name, kind)
    if part is None:
        raise MissingDependencyError(
            f"The {kind} {name!r} is not known to this installation; install the project again."
        )
    return part


def load_entry_points(group: str, take: Callable[[str, Any], None]) -> None:
    """Hand every object of an entry-point group to ``take(name, object)``.

    An entry whose folder was taken off is left out; a faulty one is logged and left out.
    """
    for part in optional_parts(group).values():
        if part.taken_off:
            continue
        try:
            take(part.name, part.load("object"))
        except Exception as error:  # noqa: BLE001 - another package's fault must not take ours away
            _LOG.warning("The entry point %r (%s) of %s is left out: %s", part.name, part.target, group, error)


def _folder_of(package: str) -> Path | None:
    """Return the folder of a top-level package, or the place of a top-level module's file as if it were one."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return None
    origin = Path(spec.origin)
    return origin.parent if origin.name == "__init__.py" else origin.with_suffix("")


def _assigns(node: ast.Assign, name: str) -> bool:
    return any(isinstance(target, ast.Name) and target.id == name for target in node.targets)


def _import_file(path: Path) -> ModuleType:
    # The name is the file's own, so that classes defined there can be found again by their module.
    name = f"brainbench_user_{hashlib.sha256(str(path).encode()).hexdigest()[:12]}_{path.stem}"
    loader = _AsWritten(name, str(path))
    spec = importlib.util.spec_from_file_location(name, path, loader=loader)
    if spec is None or path.suffix not in SOURCE_SUFFIXES:
        raise UsageError(f"{str(path)!r} is not a Python file.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        with _importable(path.parent):
            loader.exec_module(module)
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

    def own_finder(path: str) -> Any:
        """Return the finder of modules in the folder; ``ImportError`` leaves other paths to Python."""
        # What is installed in an environment below the folder keeps its bytecode.
        if "site-packages" in path or not Path(path).is_relative_to(folder):
            raise ImportError
        return _finder_of(path)

    sys.path.insert(0, str(folder))
    sys.path_hooks.insert(0, own_finder)
    _forget_finders(folder)
    try:
        yield
    finally:
        sys.path_hooks.remove(own_finder)
        _forget_finders(folder)
        sys.path.remove(str(folder))
        for name in sys.modules.keys() - before:
            file, top = Path(getattr(sys.modules[name], "__file__", None) or ""), name.partition(".")[0]
            # What is installed in an environment below the folder is not its own.
            if file == folder / f"{top}.py" or file.is_relative_to(folder / top):
                _beside[name] = file


def _forget_finders(folder: Path) -> None:
    """Let Python look anew for modules in a folder."""
    importlib.invalidate_caches()
    for path in [path for path in sys.path_importer_cache if Path(path).is_relative_to(folder)]:
        del sys.path_importer_cache[path]
