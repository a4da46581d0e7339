"""Outputs of a command, checked when the command line is read: before anything slow."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import typer

from brainbench.core.errors import UsageError, brief, check_name, missing_dependency
from brainbench.core.figures.style import check_format
from brainbench.core.files import check_folder


def out_folder(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Return the folder of an option if files can be written into it; else a :class:`UsageError`."""
    if path is not None:
        check_folder(path, option.opts[0])
    return path


def out_file(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Return the file of an option if it can be written; else a :class:`UsageError`."""
    return None if path is None else _file(path, option.opts[0])


def out_folder_option(help: str) -> Any:
    """Return the option ``--out`` of a command that writes a folder."""
    return typer.Option("--out", "-o", callback=out_folder, help=help)


def out_file_option(help: str) -> Any:
    """Return the option ``--out`` of a command that writes a file."""
    return typer.Option("--out", "-o", callback=out_file, help=help)


def picture_file(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Return the picture of an option if it can be drawn and written; else a :class:`UsageError`."""
    if path is not None:
        check_format(path, (".png", ".svg", ".pdf"))
    return out_file(option, path)


def beside(option: typer.CallbackParam, path: Path) -> Path:
    """Return a file or folder if something of this name can be written; else a :class:`UsageError`."""
    check_folder(path.parent, option.opts[0])
    return path


def report_file(path: Path | None) -> Path | None:
    """Return the file of ``--report`` if it can be written and its ending is that of a format which can be made."""
    if path is None:
        return None
    from leaderboards.report.paper import FORMATS

    kind = path.suffix.removeprefix(".").lower()
    if not kind:
        allowed = ", ".join(f".{name}" for name in FORMATS)
        raise UsageError(
            f"--report names {brief(str(path))}, which has no ending; give a file that ends in one of {allowed}, or "
            "leave --report out for no report."
        )
    check_name("report format", kind, FORMATS, hint="The ending of --report chooses it.")
    if kind == "pdf" and find_spec("weasyprint") is None:
        raise missing_dependency("weasyprint", extra="board", purpose="A report as PDF")
    return _file(path, "--report")


def _file(path: Path, option: str) -> Path:
    if path.is_dir():
        raise UsageError(f"{option} names {brief(str(path))}, which is a folder; name a file in it.")
    check_folder(path.parent, option)
    return path
