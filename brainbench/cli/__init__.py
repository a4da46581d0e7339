"""The ``brainbench`` command. One thin module per command; heavy imports happen inside them.

Exit status: 0 done; 1 the request was fine but the job failed (unusable data);
2 the request itself was wrong (unknown name, option or file); 130 interrupted (Ctrl-C).
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
import threading
from typing import Any

INTERRUPTED = 130  # exit status after Ctrl-C, as shells count it: 128 and the number of the signal
GO_ON = (
    "interrupted; no file was left half-written. Give the same command again: what it had finished (simulations, "
    "checkpoints, shards of a data set) is kept and not made again."
)


def __getattr__(name: str) -> Any:
    """Return the complete command line, ``app``, built when it is first asked for."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from brainbench.cli.application import build

    globals()["app"] = app = build()
    return app


def main() -> None:
    """Entry point: run a command and turn our own errors into one line and an exit status."""
    # The products of a score are small: threads of numpy's BLAS mostly wait for one another, and spin while they do
    # (six times the processor time for --metric cka, where other work keeps the processors busy). Torch has its own.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if (stream := getattr(sys, name)) is None:
            # Closed by whoever started the command (>&-): no file of ours may take its number.
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
            setattr(sys, name, os.fdopen(number, "w" if number else "r"))
        elif number and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # characters that a terminal lacks
    try:
        _run()
    except KeyboardInterrupt:
        _leave()
        sys.exit(INTERRUPTED)
    except SystemExit as stop:
        # typer turns Ctrl-C into this status, without a word.
        if stop.code == INTERRUPTED:
            _leave()
        raise
    except BrokenPipeError:
        # The reader (head, less) has gone; Python would otherwise complain again at shutdown.
        sys.stderr.close()
        sys.exit(0)


def _run() -> None:
    from brainbench.cli.application import build
    from brainbench.core.errors import BrainbenchError, brief, visible_lines

    try:
        os.getcwd()  # noqa: PTH109
    except FileNotFoundError:
        sys.exit("brainbench: The current folder was deleted; change into one that exists.")
    try:
        try:
            # A shell that completes words asks for all of them.
            build(None if "_BRAINBENCH_COMPLETE" in os.environ else sys.argv[1:])()
        finally:
            sys.stdout.flush()  # what cannot be written fails here, where it can be said
    except BrainbenchError as error:
        print(f"brainbench: {visible_lines(str(error))}", file=sys.stderr)
        sys.exit(error.exit_code)
    except OSError as error:
        if error.errno in (errno.ENAMETOOLONG, errno.EACCES, errno.EPERM, errno.EROFS, errno.ELOOP) and error.filename:
            print(f"brainbench: {brief(str(error.filename))} cannot be opened ({error.strerror}).", file=sys.stderr)
            sys.exit(2)
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EIO):
            raise
        # It would be tried again, and fail again, when Python ends.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        print(f"brainbench: The output cannot be written ({error.strerror}).", file=sys.stderr)
        sys.exit(1)


def _leave() -> None:
    """Say so, and end at once if a compiler runs in a thread: it cannot be stopped, and Python would wait for it."""
    from brainbench.core.progress import PREPARATION

    print(f"\nbrainbench: {GO_ON}", file=sys.stderr)
    if any(thread.name == PREPARATION for thread in threading.enumerate()):
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(INTERRUPTED)
