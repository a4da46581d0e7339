"""``brainbench policy``: dexterous tasks, teachers and students. One module per command."""

from __future__ import annotations

import typer

from brainbench.cli.policy import deploy, distill, evaluate, export, play, report, sweep, tasks, train

app = typer.Typer(no_args_is_help=True, help="Dexterous tasks of robot hands: play, train, evaluate, deploy.")
app.command("tasks")(tasks.list_tasks)
app.command("play")(play.play)
app.command("train")(train.train)
app.command("evaluate")(evaluate.evaluate)
app.command("distill")(distill.distill)
app.command("sweep")(sweep.sweep)
app.command("report")(report.report)
app.command("export")(export.export)
app.command("deploy")(deploy.deploy)
