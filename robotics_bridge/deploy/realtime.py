"""Time for the control loop when the computer has other work: ahead of all ordinary threads, and no collection."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Iterator

from brainbench.core.errors import UsageError

PRIORITY = 20
"""Of SCHED_FIFO (1–99); above ordinary threads, below the kernel's own (50)."""


@contextlib.contextmanager
def realtime(priority: int = PRIORITY) -> Iterator[None]:
    """Run the calling thread ahead of all ordinary ones (SCHED_FIFO) and without garbage collection, until it leaves.

    Processes that it starts meanwhile are ordinary. A loop that never sleeps would keep a processor to itself.

    Raises:
        UsageError: the system has no such scheduling (it is Linux's), or this user may not ask for it.
    """
    if not hasattr(os, "SCHED_FIFO"):
        raise UsageError("Real-time scheduling is Linux's; leave realtime out on this system.")
    before, parameters, collecting = os.sched_getscheduler(0), os.sched_getparam(0), gc.isenabled()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError as error:
        raise UsageError(
            f"This user may not run threads at real-time priority {priority}; allow it with the line "
            f"'{os.environ.get('USER', 'USER')} - rtprio {priority}' in /etc/security/limits.conf, or leave realtime "
            "out."
        ) from error
    gc.disable()
    try:
        yield
    finally:
        os.sched_setscheduler(0, before, parameters)
        if collecting:
            gc.enable()
