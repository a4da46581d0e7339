"""``brainbench leaderboard serve``: read a leaderboard in the browser."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit


def serve(
    source: Annotated[Path, typer.Argument(help="A built site, or a folder of records to build one from.")] = Path(
        "brainbench-results"
    ),
    host: Annotated[str, typer.Option(help="Address to listen on; the default is seen by this machine alone.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.")] = 8000,
    as_json: JsonOption = False,
) -> None:
    """Serve a leaderboard for local reading, without writing anything; stop it with Ctrl-C."""
    from brainbench.core.errors import DataFileNotFoundError
    from leaderboards.site.serve import LOOPBACK, make_server
    from leaderboards.site.site import build_leaderboard
    from leaderboards.store import read_records

    if not source.exists():
        raise DataFileNotFoundError(
            f"There is no site or folder of records {str(source)!r}; "
            "make records first, for example with: brainbench score zhuang-intersection-ln"
        )
    with tempfile.TemporaryDirectory() as folder:
        built = (source / "index.html").is_file() and (source / "data").is_dir()
        site = source if built else build_leaderboard(read_records(source), Path(folder) / "site").parent
        server = make_server(site, host=host, port=port)
        shown = f"[{host}]" if ":" in host else host
        address = f"http://{shown}:{server.server_address[1]}/"
        everyone = "" if host in LOOPBACK else "\nOther machines can read this."
        emit({"address": address, "site": site}, f"{address}  (Ctrl-C ends){everyone}", as_json=as_json)
        sys.stdout.flush()
        with server, contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()
