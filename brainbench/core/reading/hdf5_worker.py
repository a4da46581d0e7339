"""Walks HDF5 files in a process of its own: damage makes the HDF5 library loop for ever or crash, and links lead away.

A file is plain when all its bytes are its own. What links to others or is made up of their parts is followed here, hop
by hop and never by the library: each hop is a regular file in a folder that may be read from, and has the part that is
asked for. All of it is written, as plain arrays, into a copy that is read in its place.

It runs in another process (:mod:`brainbench.core.reading.apart`).
"""

from __future__ import annotations

import math
import os
import shutil
import signal
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.lazy import lazy_module

if TYPE_CHECKING:
    import h5py
    import numpy as np
else:
    h5py, np = lazy_module("h5py"), lazy_module("numpy")

MOST_MEMORY = 2 << 30  # bytes that an array may take beyond MOST_EXPANSION times what is stored of it
MOST_EXPANSION = 200  # bytes of an array for each stored one; recordings reach about 20, a decompression bomb 1000
SMALL = 1 << 20
"""Bytes of an array that is read as a whole, since its numbers may lead elsewhere (texts of any length)."""
MOST_HOPS = 32  # links that follow one another


class Refused(Exception):
    """What is wrong with a file, in words that follow its name."""


class Missing(Refused):
    """A hop leads to what is not there."""


def fault_of(path: str, folders: list[str] | tuple[str, ...] = (), copy: str = "") -> tuple[str, bool]:
    """Return what is wrong with a file, in words that follow its name, and whether it was copied.

    Args:
        path: the file.
        folders: other folders than its own that its links may lead into.
        copy: where to write the copy of a file that links to others.
    """
    try:
        before = os.stat(path)  # noqa: PTH116 - its fields are compared
        with h5py.File(path, "r") as file:
            linked = _check(file)
            if linked:
                _Copy(path, folders).write(file, copy)
        after = os.stat(path)  # noqa: PTH116
        if (before.st_ino, before.st_size, before.st_mtime_ns) != (after.st_ino, after.st_size, after.st_mtime_ns):
            return "changed while it was read; wait until it is complete", False
        return "", linked
    except Refused as error:
        return str(error), False
    except OSError as error:
        return _why(path, (str(error).strip().splitlines() or [""])[0]), False
    except MemoryError:
        return "is damaged (it declares more data than there is memory)", False
    except Exception as error:  # noqa: BLE001 - h5py raises anything on damage, and this process must go on
        return f"is damaged ({type(error).__name__}: {str(error)[:120]})", False


def _check(file: Any) -> bool:
    """Refuse what is damaged in a file itself; return whether anything of it lies in other files."""
    from h5py import h5l  # pyright: ignore[reportAttributeAccessIssue] - compiled

    linked: list[str] = []

    def visit_link(name: bytes, link: Any) -> None:
        """Note a link that leads to another file."""
        if link.type not in (h5l.TYPE_HARD, h5l.TYPE_SOFT):
            linked.append(os.fsdecode(name))

    def visit(name: str, node: Any) -> None:
        """Check a group or an array, and note one whose values lie in other files."""
        _attributes(node, name)
        if getattr(node, "shape", None) is not None:
            _array(node, name)
            if node.is_virtual or node.external:
                linked.append(name)

    _attributes(file, "/")
    file.id.links.visit(visit_link, info=True)
    file.visititems(visit)
    return bool(linked)


def _attributes(node: Any, name: str) -> None:
    for key in node.attrs:
        try:
            node.attrs[key]
            axes = _names_axes(node, key)
        except Exception as error:
            raise Refused(f"is damaged (attribute {key[:80]!r} of {name[:80]!r}: {str(error)[:120]})") from error
        if not axes:
            raise Refused(f"is damaged (attribute {key!r} of {name[:80]!r} does not hold references)")


def _names_axes(attribute: Any, key: str) -> bool:
    """Return False for a list of axes of another type: the library writes past its memory when it follows one."""
    kind = attribute.attrs.get_id(key).dtype
    if key == "DIMENSION_LIST":
        held = h5py.check_vlen_dtype(kind)
        refers = held is not None and h5py.check_ref_dtype(held) is h5py.Reference
        return refers and attribute.attrs[key].shape == (attribute.ndim,)
    return key != "REFERENCE_LIST" or (kind.names is not None and h5py.check_ref_dtype(kind[0]) is h5py.Reference)


def _array(node: Any, name: str) -> None:
    """Refuse an array that is unreadable, or far more declared than stored, which would take all memory."""
    away = node.is_virtual or bool(node.external)
    declared, stored = math.prod(node.shape) * node.dtype.itemsize, 0 if away else node.id.get_storage_size()
    if declared > MOST_MEMORY + MOST_EXPANSION * stored:
        raise Refused(
            f"is damaged ({name[:80]!r} declares {list(node.shape)}, {declared:,} bytes, and stores {stored:,})"
        )
    if away or lacking_filters(node):
        return  # No damage: whoever reads it is told.
    if declared <= SMALL:
        try:
            node[()]
        except Exception as error:
            raise Refused(f"is damaged ({name[:80]!r}: {str(error)[:120]})") from error
    elif node.chunks:
        node.id.get_num_chunks()


def lacking_filters(node: Any) -> list[int]:
    """Return the numbers of the filters that an array needs and this installation lacks."""
    from h5py import h5z  # pyright: ignore[reportAttributeAccessIssue] - compiled

    create = node.id.get_create_plist()
    codes = [create.get_filter(place)[0] for place in range(create.get_nfilters())]
    return [code for code in codes if not h5z.filter_avail(code)]


class _Copy:
    """The copy of a file in which plain arrays stand in the place of what lies in others."""

    def __init__(self, path: str, folders: list[str] | tuple[str, ...]) -> None:
        self.allowed = [Path(folder).resolve() for folder in folders]
        self.folders = [Path(path).parent.resolve(), *self.allowed]
        self.files: dict[Path, Any] = {}
        self.seen: set[tuple[int, int]] = set()

    def write(self, file: Any, copy: str) -> None:
        """Write the copy of an open file."""
        shutil.copyfile(file.filename, copy)
        Path(copy).chmod(0o600)
        with h5py.File(copy, "r+") as target:
            self._group(file, target)

    def _group(self, source: Any, target: Any) -> None:
        self.seen.add(_key(source))
        for name in source:
            link, node = source.get(name, getlink=True), None
            if isinstance(link, h5py.HardLink):
                node = source[name]
            elif isinstance(link, h5py.ExternalLink):
                del target[name]
                try:
                    node = self._follow(source, name)
                except Missing:
                    # An open end that nobody may need; whoever reads it is told what is missing.
                    target[name] = h5py.SoftLink(f"{link.path} of {link.filename}")
                else:
                    node.file.copy(node, target, name)
            if isinstance(node, h5py.Group) and _key(node) not in self.seen:
                self._group(node, target[name])
            elif isinstance(node, h5py.Dataset) and (node.is_virtual or node.external):
                values = self._values(node)
                attributes = [(key, node.attrs[key], node.attrs.get_id(key).dtype) for key in node.attrs]
                del target[name]
                array = target.create_dataset(name, data=values, dtype=node.dtype)
                for key, value, kind in attributes:
                    array.attrs.create(key, value, dtype=kind)
        if source.id.get_create_plist().get_link_creation_order():
            for name in source:  # anew, in the order in which they were made
                target.move(name, f"{name}~")
                target.move(f"{name}~", name)

    def _follow(self, group: Any, path: str, hops: int = 0) -> Any:
        """Return what a path leads to, through links of all kinds."""
        if hops > MOST_HOPS:
            raise Refused(f"has links that lead to themselves or over more than {MOST_HOPS} others ({path[:80]!r})")
        node: Any = group.file["/"] if path.startswith("/") else group
        for step in path.split("/"):
            if step in ("", "."):
                continue
            there = isinstance(node, h5py.Group) and node.id.links.exists(step.encode())
            link = node.get(step, getlink=True) if there else None
            if isinstance(link, h5py.SoftLink):
                node = self._follow(node, link.path, hops + 1)
            elif isinstance(link, h5py.ExternalLink):
                node = self._follow(self._open(node.file, link.filename), link.path, hops + 1)
            elif link is None:
                raise Missing(f"lacks {path[:80]!r}, which is linked to, in {Path(node.file.filename).name[:80]!r}")
            else:
                node = node[step]
        return node

    def _open(self, file: Any, name: str) -> Any:
        """Open a file that another names."""
        place = self._place(file, name, self.folders)
        if place not in self.files:
            self.files[place] = h5py.File(place, "r")
            _check(self.files[place])
        return self.files[place]

    def _place(self, file: Any, name: str, folders: list[Path]) -> Path:
        """Return where a file is that another names: a regular one in one of the folders."""
        place = (Path(file.filename).parent / name).resolve() if name != "." else Path(file.filename)
        if name != "." and not any(place.is_relative_to(folder) for folder in folders):
            away = "outside its folder" if len(folders) > len(self.allowed) else "which may be any file of yours"
            raise Refused(f"takes a part from {name[-80:]!r}, {away}; if you trust it, allow it: --allow-linked FOLDER")
        try:
            status = place.stat()
        except OSError:
            raise Missing(f"takes a part from {name[-80:]!r}, which is missing") from None
        if not stat.S_ISREG(status.st_mode):
            raise Refused(f"takes a part from {name[-80:]!r}, which is no regular file")
        if hasattr(signal, "setitimer"):  # a second for each part of a large one, as for the file itself
            left = signal.getitimer(signal.ITIMER_PROF)[0]
            signal.setitimer(signal.ITIMER_PROF, left and left + status.st_size / (10 << 20))
        return place

    def _values(self, node: Any, route: tuple[Any, ...] = ()) -> Any:
        """Read an array; one of parts of others is put together here."""
        if node.shape is None or not (node.is_virtual or node.external):
            return node[()]
        if node.external:
            return self._raw(node)
        if (key := _key(node)) in route or len(route) > MOST_HOPS:
            raise Refused(f"has an array, {node.name[-80:]!r}, that is made of itself")
        values, filled = np.full(node.shape, node.fillvalue, node.dtype), np.zeros(node.shape, bool)
        for part in node.virtual_sources():
            if "%" in part.file_name or "%" in part.dset_name:
                raise Refused(f"names parts of {node.name[-80:]!r} by a pattern, {part.file_name[-80:]!r}; name each")
            where = f"{node.name[-80:]!r} from {part.dset_name[-80:]!r} of {part.file_name[-80:]!r}"
            file = node.file if part.file_name == "." else self._open(node.file, part.file_name)
            source = self._follow(file, "/" + part.dset_name)
            if not isinstance(source, h5py.Dataset):
                raise Refused(f"takes a part of {where}, which is no array")
            to, of = _selected(part.vspace, node.shape), _selected(part.src_space, source.shape)
            if to is None or of is None or to.sum() != of.sum():
                raise Refused(f"takes a part of {where}, which is smaller")
            values[to] = self._values(source, (*route, key))[of]
            filled |= to
        if not filled.all() and not (values.dtype.kind in "fc" and np.isnan(values[~filled]).all()):
            raise Refused(f"has {int((~filled).sum()):,} values of {node.name[-80:]!r} that come from nowhere")
        return values

    def _raw(self, node: Any) -> Any:
        """Read an array that lies in the bytes of other files: only in folders that were allowed by name."""
        data = b""
        for name, offset, size in node.external:
            place = self._place(node.file, os.fsdecode(name), self.allowed)
            missing = math.prod(node.shape) * node.dtype.itemsize - len(data)
            with place.open("rb") as stream:
                stream.seek(offset)
                data += stream.read(min(size, missing))
        if len(data) < math.prod(node.shape) * node.dtype.itemsize:
            raise Refused(f"lacks bytes of {node.name[-80:]!r} in {os.fsdecode(node.external[0][0])[-80:]!r}")
        return np.frombuffer(data, node.dtype).reshape(node.shape)


def _key(node: Any) -> tuple[int, int]:
    from h5py import h5o  # pyright: ignore[reportAttributeAccessIssue] - compiled

    status = h5o.get_info(node.id)
    return status.fileno, status.addr


def _selected(space: Any, shape: tuple[int, ...]) -> Any:
    """Return the values [shape] that a selection holds, true for each; None where it reaches beyond the array."""
    from h5py import h5s  # pyright: ignore[reportAttributeAccessIssue] - compiled

    kind, mask = space.get_select_type(), np.zeros(shape, bool)
    if kind == h5s.SEL_ALL and tuple(space.shape) in ((), shape):  # the library writes no extent of all
        return ~mask
    if kind != h5s.SEL_HYPERSLABS or len(space.shape) != len(shape):
        return None
    if not space.is_regular_hyperslab():
        for low, last in space.get_select_hyper_blocklist():
            if (last >= shape).any():
                return None
            mask[tuple(map(slice, low, last + 1))] = True
        return mask
    sides = []
    for start, stride, count, block, size in zip(*space.get_regular_hyperslab(), shape, strict=True):
        # What has no end takes all that there is.
        count = -(-(size - start) // stride) if count == h5s.UNLIMITED else count
        block = size - start if block == h5s.UNLIMITED else block
        if start + stride * (count - 1) + block > size:
            return None
        sides.append(np.add.outer(start + stride * np.arange(count), np.arange(block)).ravel())
    mask[np.ix_(*sides)] = True
    return mask


def _why(path: str, text: str) -> str:
    if "unable to lock" in text:
        return f"is open for writing in another program ({text}); close it there"
    if "truncated" in text:
        return "is truncated: the file is shorter than its HDF5 header says; copy it again"
    with Path(path).open("rb") as stream:
        head = stream.read(64)
    if not head:
        return "is not an HDF5 file (it is empty)"
    if head.startswith((b"version https://git-lfs", b"/annex/", b"../../.git/annex")):
        return "is not an HDF5 file but a pointer that git-lfs or git-annex left in its place; fetch the content first"
    if "signature not found" in text:
        return "is not an HDF5 file"
    return f"cannot be read, it seems damaged ({text}); copy it again"
