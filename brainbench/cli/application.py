"""The command line as typer sees it, with no more than the command that was asked for imported."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated

import typer

from brainbench.core.version import __version__

COMMANDS = {
    "score": "Score a model against neural recordings and write a result record and an HTML report.",
    "power": "Say how often a true effect would be found, and how many stimuli or animals are needed.",
    "recovery": "Say whether an experiment could tell networks apart: each network in turn makes the animals.",
    "train": "Train a model with its published recipe, or go on with a run that was interrupted.",
    "export": "Export one step, obs and h_in to features and h_out, with its contract, and check the written file.",
    "doctor": "Show versions, devices, folders and optional parts.",
    "models": "List and describe the registered models; add your own.",
    "recordings": "Inspect, check, copy and fetch neural recordings.",
    "stimuli": "Simulate whiskers on objects; look at scenes and forces.",
    "tactile": "Tactile sensors of robot hands: demo, layouts, speed, checks, calibration.",
    "policy": "Dexterous tasks of robot hands: play, train, evaluate, deploy.",
    "tradeoff": "Measure accuracy against cost.",
    "leaderboard": "Collect result records, check them, and show them as a leaderboard.",
}
"""Command or group of commands → its line in the help."""
ELSEWHERE = {"export": "models"}
"""Command → its module, where that is called otherwise."""


def build(words: Sequence[str] | None = None) -> typer.Typer:
    """Return the command line: the command that ``words`` begin with alone; without words all, complete.

    Before any command is named in the words, all stand there with their help alone.
    """
    asked = None if words is None else next((word for word in words if not word.startswith("-")), "")
    # To read options of its own costs typer a tenth of a second: they stand there where they are used or shown.
    bare = bool(words) and words[0] == asked and asked in COMMANDS
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
    second = words[1] if words and len(words) > 1 else ""
    app.callback()(_set_up if bare else _root)
    for name, summary in COMMANDS.items():
        if asked is None or asked == name:
            module = import_module(f"brainbench.cli.{ELSEWHERE.get(name, name)}")
            if hasattr(module, name):
                app.command(name)(getattr(module, name))
                continue
            inner = {command.name for command in module.app.registered_commands}
            app.add_typer(module.app, name=name, help=summary, add_help_option=not (bare and second in inner))
        elif asked not in COMMANDS:
            app.command(name, help=summary)(_named_only)
    if asked is None or asked in COMMANDS:
        from brainbench.cli.requirements import guard

        guard(app)
    return app


def _named_only() -> None:
    """Stand for a command in the help of all."""


def _version(show: bool) -> None:
    if show:
        print(__version__)
        raise typer.Exit


def _set_up() -> None:
    _log(logging.WARNING)


def _root(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what is done, on stderr.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    _log(logging.INFO if verbose else logging.WARNING)


def _log(level: int) -> None:
    logging.basicConfig(stream=sys.stderr, level=level, format="%(levelname)s %(name)s: %(message)s")
