"""Work in a process of its own, whose words go to files."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path


def fork(work: Callable[[], None], out: Path, err: Path | None = None) -> int:
    """Start work in a fork that ends with the status of a script, and return its process number.

    ``out`` takes both streams where no ``err`` is given.
    """
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        for number, path in ((1, out), (2, err or out)):
            os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_TRUNC | os.O_APPEND), number)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        work()
        status = 0
    except SystemExit as end:
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001 - whatever ends the work is printed
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
