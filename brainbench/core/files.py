"""Files on disk: whole or not at all, locked folders, the cache, private files, content hashes and provenance.

A temporary file is ``.STEM-TOKEN.SUFFIX``; the token's 16 hexadecimal digits say who writes it, so that what killed
processes left is swept: 4 of the machine, 6 of the process and 6 at random.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import functools
import hashlib
import io
import json
import logging
import math
import os
import platform
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import Field, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, FileWriteError, UsageError, brief
from brainbench.core.reading.regular import user_path
from brainbench.core.reading.texts import read_json, read_mapping  # noqa: F401 - also imported from here
from brainbench.core.version import __version__

if TYPE_CHECKING:
    import h5py
    import torch
    from numpy.typing import ArrayLike, NDArray

_TEMPORARY = re.compile(r"\..+-(?P<machine>[0-9a-f]{4})(?P<process>[0-9a-f]{6})[0-9a-f]{6}(\.[^.]*)?")


def temporary_path(target: Path) -> Path:
    """Return a new name beside ``target``, with its suffix; what dead processes left in the folder is removed."""
    _sweep_once(target.parent, os.getpid())
    token = f"{_machine()}{os.getpid() % 0x1000000:06x}{secrets.token_hex(3)}"
    return target.with_name(f".{target.stem[:200]}-{token}{target.suffix}")


def is_temporary(name: str) -> bool:
    """Return whether a file of this name is one that is being written, or was when its process was killed."""
    return _TEMPORARY.fullmatch(name) is not None


@lru_cache(maxsize=1024)
def _sweep_once(folder: Path, process: int) -> None:
    # To list a folder of thousands of records for each of them would take minutes.
    del process
    sweep(folder)


def sweep(folder: Path) -> None:
    """Remove from a folder what processes of this machine left that run no more."""
    if os.name != "posix":
        return
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            match = _TEMPORARY.fullmatch(entry.name)
            if match is None or match["machine"] != _machine() or _runs(int(match["process"], 16)):
                continue
            if entry.is_dir(follow_symlinks=False):
                shutil.rmtree(entry.path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    Path(entry.path).unlink()


@lru_cache(maxsize=1)
def _machine() -> str:
    """Return four digits of this machine; a container has process numbers of its own and counts as another one."""
    space = ""
    with contextlib.suppress(OSError):
        space = str(Path("/proc/self/ns/pid").readlink())
    return hashlib.sha256(f"{platform.node()} {space}".encode()).hexdigest()[:4]


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None

_LOG = logging.getLogger(__name__)


@contextlib.contextmanager
def lock_folder(folder: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold a lock on a folder, which the system releases when this process ends in whatever way.

    Args:
        folder: made if it is missing; one that was made for nothing, since no file came into it, goes again.
        wait: for another process that holds it, rather than refuse.

    Yields:
        False where there are no such locks (Windows; some network file systems, which are warned of).
    """
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    if fcntl is None:
        yield False
        return
    handle, held = os.open(folder, os.O_RDONLY), False
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            held = True
        except BlockingIOError as error:
            raise UsageError(f"Another process is writing {brief(str(folder))}; wait for it, or end it.") from error
        except OSError as error:
            _LOG.warning("%s cannot be locked (%s); start no second run there", folder, error)
        yield held
    except BaseException:
        with contextlib.suppress(OSError):  # others may write there by now
            for path in missing if held else ():
                path.rmdir()
        raise
    finally:
        os.close(handle)


CACHE_VARIABLE = "BRAINBENCH_CACHE"  # environment variable that overrides the platform's cache folder
KEY_VARIABLE = "BRAINBENCH_CACHE_KEY"
"""Environment variable that holds the key of the cache itself, for processes that share one and have no settings."""
KEY, KEY_BYTES = Path("keys", "cache.key"), 32  # the file of that key among the settings, and its size
CONFIG_VARIABLE = "BRAINBENCH_CONFIG"  # environment variable that overrides the platform's folder of settings
LIBRARIES = ("numpy", "scipy", "xarray", "h5py", "torch", "warp-lang", "mujoco-core")
"""Distributions on whose version the last digits of a result depend."""
_UNWRITABLE = (
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.ENOTDIR, errno.EEXIST,
    errno.EISDIR, errno.ENAMETOOLONG,
)  # fmt: skip


def cache_dir(*parts: str) -> Path:
    """Return (and create) the cache folder, ``$BRAINBENCH_CACHE`` or the platform's own.

    In place of one that this user may not write, such as a shared one or that of a read-only home, it is a temporary
    folder with all that stands there, until this process ends.
    """
    root = user_folder(CACHE_VARIABLE, "user_cache_dir")
    path, fault = root.joinpath(*parts), errno.EACCES
    try:
        path.mkdir(parents=True, exist_ok=True)
        if os.access(path, os.W_OK | os.X_OK):
            return path
    except OSError as error:
        fault = error.errno or fault
        if fault not in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise FileWriteError(
                f"The cache folder {brief(str(path))} cannot be made ({error.strerror}); name a folder that can be "
                f"written with the environment variable {CACHE_VARIABLE}."
            ) from error
    # Processes that this one starts share it.
    os.environ[CACHE_VARIABLE] = str(_linked_cache(root))
    _LOG.warning(
        "The cache folder %s cannot be written (%s): what is made is kept until this process ends. "
        "Name another folder with %s.", root, os.strerror(fault), CACHE_VARIABLE,
    )  # fmt: skip
    return cache_dir(*parts)


def _linked_cache(root: Path) -> Path:
    """Return a temporary folder, removed when this process ends, with links to the entries of a cache."""
    copy = Path(tempfile.mkdtemp(prefix="brainbench-cache-"))
    atexit.register(shutil.rmtree, copy, ignore_errors=True)
    for folder, _, names in os.walk(root.absolute()):
        place = copy / Path(folder).relative_to(root.absolute())
        place.mkdir(exist_ok=True)
        for name in names:
            with contextlib.suppress(OSError):  # seals are added to, and those of others may not be read
                (shutil.copyfile if name.endswith(".seal") else os.symlink)(Path(folder, name), place / name)
    if not (settings_dir() / KEY).is_file():  # what is not kept needs no key that is kept
        os.environ.setdefault(KEY_VARIABLE, secrets.token_hex(KEY_BYTES))
    return copy


def settings_dir() -> Path:
    """Return the folder of the user's settings, ``$BRAINBENCH_CONFIG`` or the platform's own; it may be missing."""
    return user_folder(CONFIG_VARIABLE, "user_config_dir")


def user_folder(variable: str, kind: str, name: str = "brainbench") -> Path:
    """Return the folder that an environment variable names, or the platform's for an application of this name."""
    if folder := os.environ.get(variable):
        return user_path(folder)
    import platformdirs

    try:
        return Path(getattr(platformdirs, kind)(name, appauthor=False)).expanduser()
    except RuntimeError as error:  # as in containers
        raise UsageError(f"This user has no home folder: set HOME, or name a folder with {variable}.") from error


def check_folder(path: str | os.PathLike[str], option: str) -> None:
    """Check before slow work that files can be written into a folder, which is made later.

    Args:
        path: the folder.
        option: what names it, for the message.
    """
    place = user_path(path).absolute()
    while not os.path.lexists(place):
        place = place.parent
    fault = "is no folder" if not place.is_dir() else "may not be written by this user"
    if not (place.is_dir() and os.access(place, os.W_OK | os.X_OK)):
        raise UsageError(f"{option} names {brief(os.fspath(path))}, and {brief(str(place))} {fault}; choose another.")


@contextlib.contextmanager
def writable(target: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what forbids to write a file or folder (permission, space, something in the way) into FileWriteError."""
    try:
        yield
    except OSError as error:
        if error.errno not in _UNWRITABLE:
            raise
        raise FileWriteError(f"{brief(os.fspath(target))} cannot be written ({os.strerror(error.errno)}).") from error


def sync_file(path: Path) -> None:
    """Wait until a file's content is on disk."""
    with path.open("rb") as stream:
        os.fsync(stream.fileno())


@contextlib.contextmanager
def atomic_path(target: str | os.PathLike[str], *, sync: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``target`` that replaces it on success and vanishes on error.

    The temporary name keeps the target's suffix, so libraries that choose a format by suffix work. Without ``sync`` the
    caller sees to it that the content is on disk: of many files at once.
    """
    target = Path(target)
    temporary = target
    try:
        with writable(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary = temporary_path(target)
            # Made by hand: tempfile's files are private, and to read the umask is not safe among threads.
            os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield temporary
            if sync:
                sync_file(temporary)
            temporary.replace(target)
    finally:
        if temporary != target:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def _is_unused(value: Any, field: Field[Any]) -> bool:
    unused = field.metadata.get("before", field.default)
    return value is unused or value == unused  # NaN equals nothing


_PLAIN = {str, int, bool, type(None)}


def to_plain(value: Any) -> Any:
    """Turn dataclasses, mappings, arrays and paths into JSON types; a float without value is null.

    A field that came later than files and hashes which exist (its metadata say ``later=True``) appears only where it
    is used, so that those stay what they are: where it differs from its default, or from ``before`` in the metadata.
    """
    # Most of a record are the numbers of its RDMs.
    if type(value) is float:
        return value if math.isfinite(value) else None
    if type(value) in _PLAIN:
        return value
    if isinstance(value, Mapping):
        return {str(key): item if type(item) in _PLAIN else to_plain(item) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: to_plain(getattr(value, field.name))
            for field in fields(value)
            if not (field.metadata.get("later") and _is_unused(getattr(value, field.name), field))
        }
    if isinstance(value, (list, tuple)):
        if value and type(value[0]) is float and {*map(type, value)} == {float}:
            return [number if math.isfinite(number) else None for number in value]
        return [to_plain(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted(to_plain(item) for item in value)
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    as_list = getattr(value, "tolist", None)  # numpy scalars and arrays, torch tensors
    if callable(as_list):
        plain: Any = as_list()
        # A long double has no type of its own in Python and gives itself.
        return to_plain(float(plain) if type(plain) is type(value) else plain)
    return value


def to_json(value: Any, *, indent: int | None = 2) -> str:
    """Serialise deterministically: sorted keys, full float precision, null for NaN."""
    return json.dumps(to_plain(value), indent=indent, sort_keys=True, ensure_ascii=False, allow_nan=False)


def write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write ``text`` (UTF-8) so that readers see the old file or the new one, never a part."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def write_together(files: Mapping[Path, str | bytes]) -> list[Path]:
    """Write files so that all are whole before the first of them appears, and return their paths."""
    with contextlib.ExitStack() as stack:
        for path, content in files.items():
            data = content.encode() if isinstance(content, str) else content
            stack.enter_context(atomic_path(path)).write_bytes(data)
    return list(files)


def write_json(path: str | os.PathLike[str], value: Any) -> Path:
    """Write ``value`` as deterministic JSON, atomically."""
    return write_text(path, to_json(value) + "\n")


BITS = 34  # bits of a number that count in a portable hash, about ten digits: the last ones differ between processors
SMALLEST = 1e-12  # numbers below it (SI) are zero: what a rotation by 90° leaves of it is 6e-17 here and 0 there


def without_last_digits(values: ArrayLike) -> NDArray[Any]:
    """Return numbers rounded to :data:`BITS` bits, 0 below :data:`SMALLEST`.

    >>> float(without_last_digits(0.1 + 0.2)) == float(without_last_digits(0.3))
    True
    """
    import numpy as np

    numbers = np.asarray(values, dtype=np.float64)
    # Only exact operations: a power or a logarithm would itself differ in its last digit.
    mantissa, exponent = np.frexp(np.where(np.abs(numbers) < SMALLEST, 0.0, numbers))
    return np.ldexp(np.rint(np.ldexp(mantissa, BITS)), exponent - BITS) + 0.0


def portable(value: Any) -> Any:
    """Return plain values as :func:`brainbench.core.files.to_plain` does, floats without their last digits."""
    return _rounded(to_plain(value))


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        if value and all(type(item) is float for item in value):
            return without_last_digits(value).tolist()
        return [_rounded(item) for item in value]
    return float(without_last_digits(value)) if type(value) is float else value


def content_hash(*values: Any, length: int = 16) -> str:
    """Hash configuration and arrays to a hexadecimal name that is equal on every machine.

    Arrays count by dtype, shape and bytes; paths by the bytes of the file; all else by its JSON. So do arrays within a
    list, a hundred times as slowly as those that are values themselves.
    """
    digest = hashlib.sha256()
    for value in values:
        _update(digest, value)
    return digest.hexdigest()[:length]


def file_hash(path: str | os.PathLike[str], *, length: int = 16) -> str:
    """Hash a file's bytes in bounded memory."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()[:length]


def state_hash(path: Path) -> str:
    """Return the whole hash of a file, taken once for each state of it (size, times, place on the disk)."""
    state = path.stat()
    return _hash_once(path, state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino)


@functools.lru_cache(maxsize=4096)
def _hash_once(path: Path, *_state: int) -> str:
    return file_hash(path, length=64)


def hash_arrays(arrays: Mapping[str, Any]) -> str:
    """Hash arrays by name, type, shape and bytes, in alphabetical order of their names (SHA-256, 32 digits).

    Unlike :func:`content_hash` it copies nothing: for hundreds of megabytes.
    """
    import numpy as np

    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}:{array.dtype.str}:{array.shape}:".encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()[:32]


def _update(digest: Any, value: Any) -> None:
    if isinstance(value, (bytes, bytearray, memoryview)):
        digest.update(b"bytes:")
        digest.update(value)
    elif isinstance(value, os.PathLike):
        digest.update(b"file:" + file_hash(value, length=64).encode())
    elif hasattr(value, "dtype") and hasattr(value, "shape"):
        import numpy as np

        array = np.ascontiguousarray(value)
        digest.update(f"array:{array.dtype.str}:{array.shape}:".encode())
        digest.update(array.tobytes() if array.dtype != object else repr(array.tolist()).encode())
    else:
        digest.update(b"json:" + to_json(value, indent=None).encode())
    digest.update(b"\x00")


@functools.cache
def library_versions() -> dict[str, str]:
    """Return the versions of the :data:`LIBRARIES` that are installed; the result is shared: do not change it."""
    from importlib import metadata

    versions: dict[str, str] = {}
    for library in LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[library] = metadata.version(library)
    return versions


def provenance(**extra: Any) -> dict[str, Any]:
    """Return what a result needs to be made again: versions, machine, time, and what the caller adds."""
    import datetime

    return {
        "version": __version__,
        "python": platform.python_version(),
        "packages": dict(library_versions()),
        "machine": f"{platform.system()} {platform.machine()}",
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        **extra,
    }


def private_folder(path: Path) -> Path:
    """Return a folder that only its user can enter, made if it is missing."""
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    path.chmod(0o700)
    return path


def write_private(path: Path, content: bytes, *, replace: bool = True) -> None:
    """Write a file that only its user can read, as a whole, into a folder that only its user can enter.

    Without ``replace`` a file that is there stays, also one that another process writes at the same time.
    """
    private_folder(path.parent)
    temporary = temporary_path(path)
    try:
        with os.fdopen(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        if replace:
            temporary.replace(path)
        elif not os.path.lexists(path):
            _link(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _link(temporary: Path, path: Path) -> None:
    try:
        os.link(temporary, path)
    except FileExistsError:
        return
    except OSError:  # a file system without hard links
        temporary.replace(path)


_TABLE = 1 << 20  # bytes of the largest write that is held: tables are small, and data are not read again


class _Disk(io.FileIO):
    """A file that notes why it cannot be written and says nothing: the library prints and crashes over a full disk.

    What could not be written is held for the library, which crashes too where it reads its tables again as noise.
    """

    fault: OSError | None = None
    held: tuple[tuple[int, bytes], ...] = ()

    def write(self, data: Any) -> int:
        """Write bytes [n] and return n, also where the disk takes no more."""
        rest, place = memoryview(data).cast("B"), self.tell()
        size = len(rest)
        try:
            while len(rest) and self.fault is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.fault = error
        if self.fault is not None and size <= _TABLE:
            self.held += ((place, bytes(data)),)
        self.seek(place + size)
        return size

    def readinto(self, buffer: Any) -> int:
        """Read bytes into a buffer and return how many; what is held goes before what is on disk."""
        view, place = memoryview(buffer).cast("B"), self.tell()
        count = super().readinto(view)
        for start, content in self.held:
            first, last = max(start, place), min(start + len(content), place + len(view))
            if first < last:
                view[first - place : last - place] = content[first - start : last - start]
        return count

    def truncate(self, size: int | None = None) -> int:
        """Set the file's length [bytes] and return it, also where the disk takes no more."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.fault = self.fault or error
            return size or 0


@contextlib.contextmanager
def create_hdf5(path: str | os.PathLike[str], **options: Any) -> Iterator[h5py.File]:
    """Yield a new HDF5 file that replaces ``path`` when the block ends; ``options`` are those of ``h5py.File``."""
    import h5py

    with atomic_path(path) as temporary, _Disk(temporary, "r+") as disk:
        try:
            with h5py.File(disk, "w", **options) as file:
                yield file
        except ValueError as error:
            if "embedded NULL" not in str(error):
                raise
            name = brief(os.fspath(path))
            raise DataError(f"{name} cannot hold a text with the character NUL; take it out of the names.") from error
        finally:
            if disk.fault is not None:
                raise disk.fault


def write_tensors(path: str | os.PathLike[str], tensors: Mapping[str, torch.Tensor], **metadata: str) -> None:
    """Write tensors of any device to one safetensors file, replaced as a whole."""
    from safetensors.torch import save

    stored = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    # Not by save_file: it writes to a temporary file of its own, which stays where it is killed, and no one else may
    # read what it makes.
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(stored, metadata=metadata or None))
