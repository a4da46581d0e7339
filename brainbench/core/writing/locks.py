"""A lock on a folder, which the system releases when its process ends in whatever way."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from pathlib import Path

from brainbench.core.errors import UsageError, shown

_LOG = logging.getLogger(__name__)


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Hold the lock on a folder; another process that holds it is a :class:`UsageError`.

    A folder that is missing is made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(f"Another process is writing {shown(str(folder))}; wait for it, or end it.") from error
        except OSError as error:
            _LOG.warning("%s cannot be locked (%s); start no second run there", folder, error)
        yield
    finally:
        os.close(handle)
