"""Output of every command: printing, the ``--json`` option, tables, and progress that vanishes off a terminal."""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time as clock
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

import typer

from brainbench.core.errors import visible, visible_lines
from brainbench.core.files import to_json, write_json
from brainbench.core.progress import Item, Progress, track


class Output(NamedTuple):
    """What a command returns."""

    data: Any
    """Printed as JSON with ``--json``."""
    text: str
    """Printed for people without it."""
    out: Path | None = None
    """File that the JSON is written into too."""
    failure: Exception | None = None
    """Raised after all is printed: the exit status, or an error."""


def show(output: Output, *, as_json: bool = False) -> None:
    """Print what a command returns, as text or as JSON, and raise its failure."""
    data, text, out, failure = output
    if out is not None:
        write_json(out, data)
    print(_encodable_json(data) if as_json else visible_lines(text, styled=sys.stdout.isatty()))
    if failure is not None:
        raise failure


def _encodable_json(data: Any) -> str:
    """Return data as JSON that the stream can hold: characters that it lacks are written as escapes."""
    text = to_json(data)
    try:
        text.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        return json.dumps(json.loads(text), indent=2, sort_keys=True)
    return text


def group(help: str, commands: Sequence[Callable[..., Output]], **options: Any) -> typer.Typer:
    """Return a group of commands, called as their functions are; further options are typer's."""
    app = typer.Typer(help=help, **options)
    for command in commands:
        app.command(command.__name__.rstrip("_").replace("_", "-"))(command)
    return app


def list_without_command(app: typer.Typer, command: Callable[[], Output]) -> None:
    """Let a group of commands run its listing when no command is named."""

    @app.callback(invoke_without_command=True)
    def run(context: typer.Context) -> None:
        """Print the listing where no command is named."""
        if context.invoked_subcommand is None:
            show(command())


def table_of(title: str, items: Iterable[Any], columns: Mapping[str, str | Callable[[Any], object]]) -> str:
    """Lay out one row per item below a title, if there is one.

    ``columns`` maps a heading, set flush right if it begins with ``>``, to a format of an item (``"{0.error:.2%}"``,
    ``"{0[cost]:.3g}"``) or a function of it.
    """
    cells = columns.values()
    rows = [[cell.format(item) if isinstance(cell, str) else str(cell(item)) for cell in cells] for item in items]
    right = tuple(index for index, heading in enumerate(columns) if heading.startswith(">"))
    return table(title, [heading.removeprefix(">") for heading in columns], rows, right=right)


def facts(values: Mapping[str, object], title: str = "") -> str:
    """Lay out names and values; a list is joined by commas."""
    rows = [[name, ", ".join(map(str, one)) if isinstance(one, list) else str(one)] for name, one in values.items()]
    return table(title, ["", ""], rows)


def table(title: str, columns: list[str], rows: list[list[str]], *, right: tuple[int, ...] = ()) -> str:
    """Lay out a table as text; ``right`` names the columns set flush right.

    The first column is never folded; where no terminal sets the width, those flush right are not either.
    """
    from rich.console import Console
    from rich.table import Table

    rows = [[visible(cell) for cell in row] for row in rows]
    grid = Table(show_header=any(columns), box=None, pad_edge=False, header_style="bold")
    terminal = sys.stdout.isatty()
    lengths = [max(map(len, column)) for column in zip(columns, *rows, strict=True)]
    whole = {0, *(() if terminal else right)}
    for index, column in enumerate(columns):
        justify = "right" if index in right else "left"
        grid.add_column(column, justify=justify, overflow="fold", no_wrap=index in whole)
    for row in rows:
        grid.add_row(*row)
    needed = lengths[0] + 80 if lengths[0] > 40 else 0
    if not terminal:
        shares = (length if index in whole else min(length, 24) for index, length in enumerate(lengths))
        needed = max(needed, sum(shares) + 2 * len(lengths))
    buffer = StringIO()
    Console(
        file=buffer,
        force_terminal=terminal,
        # The first column is not folded, and the others keep their room beside a long name.
        width=max(Console().width, needed) if terminal else max(120, needed),
        highlight=False,
        markup=False,
        emoji=False,
    ).print(grid)
    # Rich would fold a title at the width of the table.
    return "\n".join([*([title] if title else []), *(line.rstrip() for line in buffer.getvalue().splitlines())])


FIRST_LINE, NEXT_LINE = 2.0, 10.0
"""Seconds until progress is told in a line where no bar can be drawn, and between such lines."""


@contextlib.contextmanager
def progress_bar(what: str = "") -> Iterator[Progress]:
    """Yield a progress callback that draws a bar on stderr when that is a terminal, and else writes a line at times.

    ``what`` says what is done by a job that does not count its steps.
    """
    if not sys.stderr.isatty():
        lines, done = ProgressLines(what), threading.Event()
        threading.Thread(target=lines.tell_until, args=(done,), daemon=True).start()
        try:
            yield lines.update
        finally:
            done.set()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as ProgressBar

    counts = () if what else (MofNCompleteColumn(), TimeRemainingColumn())
    parts = (TextColumn("{task.description}"), BarColumn(), *counts)
    with ProgressBar(*parts, console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {what: bar.add_task(what, total=None)} if what else {}

        def update(done: int, total: int, what: str) -> None:
            """Set a bar to the steps done, of all; one that is new is added."""
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
            bar.update(tasks[what], completed=done, total=total)

        yield update


def tracked(items: Sequence[Item], what: str) -> Iterator[Item]:
    """Yield items while progress shows how many of them are done."""
    with progress_bar() as progress:
        yield from track(items, what, progress)


class ProgressLines:
    """Lines on stderr that say what is being done, the first after two seconds."""

    def __init__(self, what: str = "") -> None:
        self._start = clock.monotonic()
        self._due = self._start + FIRST_LINE
        self._state = what

    def update(self, done: int, total: int, what: str) -> None:
        """Take the number of steps done, of all, and what is done."""
        self._state = f"{what}, {done:,} of {total:,}"
        self.tell()

    def tell(self) -> None:
        """Print a line, if it is time for one."""
        if (now := clock.monotonic()) < self._due or not self._state:
            return
        self._due = now + NEXT_LINE
        print(f"brainbench: {self._state} ({now - self._start:.0f} s)", file=sys.stderr, flush=True)

    def tell_until(self, done: threading.Event) -> None:
        """Print lines also while one step lasts long."""
        while not done.wait(FIRST_LINE):
            self.tell()
