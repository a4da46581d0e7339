"""``brainbench tactile``: look at tactile sensors and layouts."""

from __future__ import annotations

import typer

from brainbench.cli.tactile import commands

app = typer.Typer(no_args_is_help=True, help="Tactile sensors of robot hands: demo, layouts, checks, noise.")
for _command in (commands.demo, commands.layouts, commands.check):
    app.command(_command.__name__)(_command)
