"""HTML to PDF: by a Chromium browser where one is found, else by WeasyPrint."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from brainbench.core.errors import missing_dependency
from brainbench.core.files import atomic_path

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
_log = logging.getLogger(__name__)


def html_to_pdf(text: str, path: Path) -> None:
    """Print a page that needs nothing from elsewhere.

    Raises:
        MissingDependencyError: neither a Chromium browser nor ``weasyprint`` is installed.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is not None and _by_browser(browser, text, path):
        return
    try:
        import weasyprint  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError) as error:  # OSError: its system libraries are missing
        raise missing_dependency(
            "weasyprint", extra="board", purpose="Writing PDF without a Chromium browser on the path"
        ) from error
    with atomic_path(path) as temporary:
        weasyprint.HTML(string=text, url_fetcher=_nothing).write_pdf(temporary)


def _by_browser(browser: str, text: str, path: Path) -> bool:
    """Print by a browser in a profile of its own; return False, and leave ``path`` as it is, if it could not."""
    with tempfile.TemporaryDirectory() as folder:
        page, printed = Path(folder) / "page.html", Path(folder) / "page.pdf"
        page.write_text(text, encoding="utf-8")
        command = [
            browser, "--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer",
            f"--user-data-dir={folder}/profile", f"--print-to-pdf={printed}", page.as_uri(),
        ]  # fmt: skip
        if hasattr(os, "geteuid") and os.geteuid() == 0:  # Chromium refuses its sandbox to root
            command.insert(1, "--no-sandbox")
        try:
            done = subprocess.run(command, capture_output=True, timeout=180, check=False)
            trouble = f"status {done.returncode}"
        except (OSError, subprocess.TimeoutExpired) as error:
            trouble = str(error)
        if printed.is_file() and printed.read_bytes().startswith(b"%PDF") and trouble == "status 0":
            with atomic_path(path) as temporary:
                shutil.copyfile(printed, temporary)
            return True
        _log.warning("%s could not print the report (%s); trying WeasyPrint", browser, trouble)
        return False


def _nothing(url: str, *_: object, **__: object) -> dict[str, object]:
    raise ValueError(f"A report loads nothing from elsewhere; asked for {url}.")
