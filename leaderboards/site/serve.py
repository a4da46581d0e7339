"""Serve a built site for local reading: this machine only by default, read-only, and locked by headers.

The pages lock themselves (:mod:`leaderboards.site.page`); the server repeats that in headers for whatever lies in the
folder, sends files of that folder alone, and answers only to the names it is reached by, so that a foreign page
cannot read it by pointing its own name at this machine (DNS rebinding).
"""

from __future__ import annotations

import logging
import os
import socket
from functools import partial
from http import HTTPStatus
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import unquote, urlsplit

from brainbench.core.errors import DataFileNotFoundError, UsageError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
_POLICY = (
    "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""For the pages, which narrow it to the hashes of their own style and script: both policies must allow."""
_LOCKED = "default-src 'none'; sandbox; frame-ancestors 'none'"
"""For every other file: nothing in it can act, whatever it holds."""
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
_TYPES = {".html": "text/html; charset=utf-8", ".json": "application/json", ".csv": "text/csv; charset=utf-8"}
_log = logging.getLogger(__name__)


def make_server(folder: str | os.PathLike[str], *, host: str = "127.0.0.1", port: int = 8000) -> ThreadingHTTPServer:
    """Return a server of a built site, bound but not yet running: call its ``serve_forever``.

    Args:
        folder: The site.
        host: Address to listen on; other machines see the site only if it is not a loopback address.
        port: Port; 0 takes a free one.

    Raises:
        DataFileNotFoundError: there is no site in the folder.
        UsageError: the address cannot be had.
    """
    root = Path(folder).resolve()
    if not (root / "index.html").is_file():
        raise DataFileNotFoundError(
            f"There is no leaderboard in {os.fspath(folder)!r}; build one with: brainbench leaderboard build RECORDS"
        )
    try:
        kind = _Server6 if ":" in host else ThreadingHTTPServer
        return kind((host, port), partial(_Handler, directory=os.fspath(root), host=host))
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"The address {host}:{port} cannot be had ({reason}); choose another with --port.") from error


class _Server6(ThreadingHTTPServer):
    address_family = socket.AF_INET6


class _Handler(SimpleHTTPRequestHandler):
    """Answers GET and HEAD with files of one folder."""

    server_version = "brainbench"
    sys_version = ""
    timeout = 30
    extensions_map: ClassVar = {**SimpleHTTPRequestHandler.extensions_map, **_TYPES}

    def __init__(self, *arguments: Any, host: str, **options: Any) -> None:
        self._host = host
        super().__init__(*arguments, **options)

    def send_head(self) -> Any:
        """Refuse foreign names, hidden files and links that lead out; the rest is the standard library's."""
        if not self._is_ours():
            self.send_error(HTTPStatus.FORBIDDEN, "This server answers to its own address only")
            return None
        if not self._is_inside():
            self.send_error(HTTPStatus.NOT_FOUND)
            return None
        return super().send_head()

    def list_directory(self, path: Any) -> None:
        """List nothing: a folder without a first page is not there."""
        del path
        self.send_error(HTTPStatus.NOT_FOUND)

    def _is_ours(self) -> bool:
        """Tell whether the request names this server by the address it listens on, or a loopback name."""
        named = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        everywhere = self._host in ("0.0.0.0", "::", "")
        return everywhere or named == self._host or (self._host in LOOPBACK and named in LOOPBACK)

    def _is_inside(self) -> bool:
        """Tell whether the address names something inside the folder that is not hidden."""
        parts = unquote(urlsplit(self.path).path).split("/")
        if any(part.startswith(".") or "\\" in part or "\0" in part for part in parts):
            return False
        try:  # a link could lead out
            return Path(self.translate_path(self.path)).resolve().is_relative_to(self.directory)
        except OSError:
            return False

    def end_headers(self) -> None:
        page = Path(self.translate_path(self.path)).suffix in (".html", "") and self._is_inside()
        self.send_header("Content-Security-Policy", _POLICY if page else _LOCKED)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *values: object) -> None:
        # %r: an address may hold control characters, which a terminal would obey.
        _log.info("%s %r", self.address_string(), format % values)
