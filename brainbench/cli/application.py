"""The command line as typer sees it, with no more than the command that was asked for imported."""

from __future__ import annotations

import copy
import logging
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from brainbench.core.errors import MissingDependencyError, visible_lines
from brainbench.core.plugins import OptionalPart, optional_parts
from brainbench.core.version import __version__

COMMANDS = {
    "score": "Score a model against neural recordings and write a result record and an HTML report.",
    "train": "Train a model with its published recipe, or go on with a run that was interrupted.",
    "export": "Export one step, obs and h_in to features and h_out, with its contract, and check the written file.",
    "doctor": "Show versions, devices, folders and optional parts.",
    "models": "List and describe the registered models; add your own.",
    "recordings": "Inspect, check, copy and fetch neural recordings.",
    "stimuli": "Simulate whiskers on objects; look at scenes and forces.",
    "tactile": "Tactile sensors of robot hands: demo, layouts, speed, checks, calibration.",
    "policy": "Dexterous tasks of robot hands: play, train, evaluate, deploy.",
    "leaderboard": "Collect result records, check them, and show them as a leaderboard.",
}
"""Command or group of commands → its line in the help."""
ELSEWHERE = {"export": "models"}  # command → its module, where that is called otherwise
OPTIONAL = "brainbench.commands"  # entry points of optional commands: `power`, or `stimuli.fit` inside a group
OPTIONAL_PANEL = "Optional commands, each in a folder that can be taken off"
_LOG = logging.getLogger(__name__)


def build(words: Sequence[str] | None = None) -> typer.Typer:
    """Return the command line: the command that ``words`` begin with alone; without words all, complete.

    Before any command is named in the words, all stand there with their help alone.
    """
    first = None if words is None else next((word for word in words if not word.startswith("-")), "")
    second = words[1] if words and len(words) > 1 else ""
    # Looking for entry points takes a twentieth of a second: main commands do without.
    optional = {} if first in COMMANDS else _optional_commands()
    single = first in COMMANDS or first in optional
    # To read options of its own costs typer a tenth of a second: they stand there where they are used or shown.
    bare = bool(words) and words[0] == first and single
    app = typer.Typer(
        name="brainbench",
        help="Which artificial networks process touch the way a brain does?",
        no_args_is_help=True,
        add_completion=not bare,
        add_help_option=not bare,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()((lambda: _log(logging.WARNING)) if bare else _root)
    for name, summary in COMMANDS.items():
        if first is None or first == name:
            module = import_module(f"brainbench.cli.{ELSEWHERE.get(name, name)}")
            command = getattr(module, name, None) or _with_optional(module.app, name, second if bare else None)
            _add(app, name, command, summary, second if bare else None)
        elif not single:
            app.command(name, help=summary)(_named_only)
    for name, part in optional.items():
        if first == name:
            _add(app, name, part.load("command"), part.summary, second if bare else None)
        elif first is None and (command := _loaded(part)) is not None:
            _add(app, name, command, part.summary, None, OPTIONAL_PANEL)
        elif first is not None and not single and part.present:
            app.command(name, help=part.summary, rich_help_panel=OPTIONAL_PANEL)(_named_only)
    if first is None or single:
        from brainbench.cli.options import guard

        guard(app)
    return app


def _add(app: typer.Typer, name: str, command: Any, help: str, second: str | None, panel: str | None = None) -> None:
    """Enter a command or a group; a group whose ``second`` word names one of its commands needs no help of its own."""
    if not isinstance(command, typer.Typer):
        app.command(name, rich_help_panel=panel)(command)
        return
    inner = {item.name for item in command.registered_commands}
    app.add_typer(command, name=name, help=help, add_help_option=second not in inner, rich_help_panel=panel)


def _optional_commands(group: str = "") -> dict[str, OptionalPart]:
    """Return the optional commands of a group, or those outside groups, by their own names."""
    parts = {name.rpartition("."): part for name, part in optional_parts(OPTIONAL).items() if name not in COMMANDS}
    return {name: part for (outer, _, name), part in sorted(parts.items()) if outer == group}


def _with_optional(group: typer.Typer, name: str, second: str | None) -> typer.Typer:
    """Return a group with its optional commands; only the ``second`` word's, if the group's own do not have it."""
    if second and second in {item.name for item in group.registered_commands}:
        return group
    complete = copy.copy(group)
    complete.registered_commands = [*group.registered_commands]
    for inner, part in _optional_commands(name).items():
        if second and second == inner:
            complete.command(inner)(part.load("command"))
        elif (command := _loaded(part)) is not None:
            complete.command(inner, rich_help_panel=OPTIONAL_PANEL)(command)
    return complete


def _loaded(part: OptionalPart) -> Any:
    """Return an optional command for the help of all; None, with a line in the log if it is faulty, where it is not."""
    if part.taken_off:
        return None
    try:
        return part.load("command")
    except MissingDependencyError as error:
        _LOG.warning("%s", error)
        return None


def _named_only() -> None:
    """Stand for a command in the help of all."""


def _version(show: bool) -> None:
    if show:
        print(__version__)
        raise typer.Exit


def _root(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what is done, on stderr.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    _log(logging.INFO if verbose else logging.WARNING)


def _log(level: int) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Lines("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=level, handlers=[handler])


class _Lines(logging.Formatter):
    """Lines of the log, in which texts of others are data."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record, with control characters as escapes."""
        return visible_lines(super().format(record))
