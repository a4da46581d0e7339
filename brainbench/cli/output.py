"""What the commands share: the ``--json`` option, printing, and progress that vanishes off a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from brainbench.core.files import to_json
from brainbench.core.progress import Progress

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, nothing else.")]

SelectOption = Annotated[
    str | None, typer.Option(help="Trials and units to use, e.g. 'outcome=correct; units.layer=4', or a name.")
]
WindowOption = Annotated[
    str | None, typer.Option(help="Part of a trial to read, e.g. 'first-contact..choice' or 'start+0.2..+0.5'.")
]


def emit(data: Any, text: str, *, as_json: bool) -> None:
    """Print ``data`` as JSON, or ``text`` for people, on stdout."""
    print(to_json(data) if as_json else text)


def table(title: str, columns: list[str], rows: list[list[str]], *, right: tuple[int, ...] = ()) -> str:
    """Lay out a table as text; ``right`` names the columns set flush right."""
    from io import StringIO

    from rich.console import Console
    from rich.table import Table

    grid = Table(title=title or None, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for index, column in enumerate(columns):
        grid.add_column(column, justify="right" if index in right else "left", overflow="fold")
    for row in rows:
        grid.add_row(*row)
    terminal = sys.stdout.isatty()
    buffer = StringIO()
    Console(
        file=buffer,
        force_terminal=terminal,
        width=None if terminal else 120,
        highlight=False,
        markup=False,
        emoji=False,
    ).print(grid)
    return "\n".join(line.rstrip() for line in buffer.getvalue().splitlines())


@contextlib.contextmanager
def progress_bar() -> Iterator[Progress]:
    """Yield a progress callback that draws a bar on stderr when that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda done, total, what: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBar

    bar = ProgressBar(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    with bar:
        tasks: dict[str, Any] = {}

        def update(done: int, total: int, what: str) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done, total=total)

        yield update
