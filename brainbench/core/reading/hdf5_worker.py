"""Looks through HDF5 files in a process of its own: damage makes the HDF5 library loop for ever or crash.

Run by path, without this package: a line with a path comes in, a line of JSON goes out, the fault or ``""``.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
from pathlib import Path
from typing import Any

MOST_MEMORY = 2 << 30
"""Bytes that an array may take beyond :data:`MOST_EXPANSION` times what is stored of it."""
MOST_EXPANSION = 200
"""Bytes of an array for each stored one; recordings reach about 20, a decompression bomb 1000."""
SMALL = 1 << 20
"""Bytes of an array that is read as a whole, since its numbers may lead elsewhere (texts of any length)."""


def fault_of(path: str) -> str:
    """Return what is wrong with a file, in words that follow its name; empty for nothing."""
    import h5py

    try:
        with h5py.File(path, "r") as file:
            faults = [_links(file, path), *(_attributes(file, "/"),)]
            file.visititems(lambda name, node: faults.append(_attributes(node, name) or _array(node, name)))
            return next(filter(None, faults), "")
    except OSError as error:
        return _why(path, str(error).strip().splitlines()[0])
    except MemoryError:
        return "is damaged (it declares more data than there is memory)"
    except Exception as error:  # noqa: BLE001 - h5py raises anything on damage, and this process must go on
        return f"is damaged ({type(error).__name__}: {str(error)[:120]})"


def _attributes(node: Any, name: str) -> str:
    for key in node.attrs:
        try:
            node.attrs[key]
            if not _names_axes(node, key):
                return f"is damaged (attribute {key!r} of {name[:80]!r} does not hold references)"
        except Exception as error:  # noqa: BLE001 - see above
            return f"is damaged (attribute {key[:80]!r} of {name[:80]!r}: {str(error)[:120]})"
    return ""


def _names_axes(attribute: Any, key: str) -> bool:
    """Return False for a list of axes of another type: the library writes past its memory when it follows one."""
    import h5py

    kind = attribute.attrs.get_id(key).dtype
    if key == "DIMENSION_LIST":
        held = h5py.check_vlen_dtype(kind)
        refers = held is not None and h5py.check_ref_dtype(held) is h5py.Reference
        return refers and attribute.attrs[key].shape == (attribute.ndim,)
    return key != "REFERENCE_LIST" or (kind.names is not None and h5py.check_ref_dtype(kind[0]) is h5py.Reference)


def _array(node: Any, name: str) -> str:
    """Return the fault of an array: unreadable, or far more declared than stored, which would take all memory."""
    shape = getattr(node, "shape", None)
    if shape is None or node.is_virtual or node.external:
        return ""
    if _lacks_filter(node):
        return ""  # No damage: whoever reads it is told.
    declared, stored = math.prod(shape) * node.dtype.itemsize, node.id.get_storage_size()
    if declared > MOST_MEMORY + MOST_EXPANSION * stored:
        return f"is damaged ({name[:80]!r} declares {list(shape)}, {declared:,} bytes, and stores {stored:,})"
    if declared <= SMALL:
        try:
            node[()]
        except Exception as error:  # noqa: BLE001 - see above
            return f"is damaged ({name[:80]!r}: {str(error)[:120]})"
    elif node.chunks:
        node.id.get_num_chunks()
    return ""


def _lacks_filter(node: Any) -> bool:
    from h5py import h5z

    create = node.id.get_create_plist()
    return not all(h5z.filter_avail(create.get_filter(place)[0]) for place in range(create.get_nfilters()))


def _links(file: Any, path: str) -> str:
    """Return the fault of a link into what is no regular file: to follow it could wait for ever."""
    from h5py import h5l  # pyright: ignore[reportAttributeAccessIssue] - compiled

    faults: list[str] = []

    def visit(name: bytes, link: Any) -> None:
        if link.type == h5l.TYPE_EXTERNAL:
            target = os.fsdecode(file.id.links.get_val(name)[0])
            place = Path(path).parent / target
            if place.exists() and not place.is_file():
                faults.append(f"has a link {os.fsdecode(name)[:80]!r} into {target[:80]!r}, which is no regular file")

    file.id.links.visit(visit, info=True)
    return faults[0] if faults else ""


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


def answer(path: str) -> None:
    """Write the fault of a file as a line of JSON."""
    sys.stdout.write(json.dumps(fault_of(path)) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    import contextlib

    import h5py  # noqa: F401 - once, for all processes that are forked below

    with contextlib.suppress(ImportError):
        import hdf5plugin  # noqa: F401 # pyright: ignore[reportMissingImports] - brings filters along

    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for line in sys.stdin:
        if not hasattr(os, "fork"):
            answer(json.loads(line))
        elif (child := os.fork()) == 0:
            # Damage can spoil the library's memory: a file has a process to itself, which tells of it when it ends.
            path = json.loads(line)
            # The signal ends a process even within a loop of the library.
            signal.alarm(5 + Path(path).stat().st_size // (10 << 20))
            answer(path)
            sys.exit()
        elif os.waitpid(child, 0)[1]:
            sys.stdout.write(json.dumps("is damaged: the HDF5 library crashed or did not come back") + "\n")
            sys.stdout.flush()
