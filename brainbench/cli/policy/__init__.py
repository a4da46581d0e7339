"""``brainbench policy``: dexterous tasks, teachers and students."""

from __future__ import annotations

import typer

from brainbench.cli.output import list_without_command
from brainbench.cli.policy import deploy, play, train

app = typer.Typer(help="Dexterous tasks of robot hands: play, train, evaluate, deploy.")
app.command("tasks")(play.list_tasks)
list_without_command(app, play.list_tasks)
for _command in (
    play.play,
    train.train,
    play.evaluate,
    train.distill,
    train.sweep,
    deploy.export,
    deploy.deploy,
):
    app.command(_command.__name__)(_command)
