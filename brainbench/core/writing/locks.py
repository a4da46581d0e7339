"""A lock on a folder, which the system releases when its process ends in whatever way."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from brainbench.core.errors import UsageError, brief

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None

_LOG = logging.getLogger(__name__)


@contextlib.contextmanager
def lock_folder(folder: Path, *, wait: bool = True) -> Iterator[bool]:
    """Hold a lock on a folder, which the system releases when this process ends in whatever way.

    Args:
        folder: made if it is missing.
        wait: for another process that holds it, rather than refuse.

    Yields:
        False where there are no such locks (Windows; some network file systems, which are warned of).
    """
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
    finally:
        os.close(handle)
