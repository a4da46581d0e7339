"""``brainbench policy``: dexterous tasks, teachers and students."""

from __future__ import annotations

from brainbench.cli.output import group, list_without_command
from brainbench.cli.policy import deploy, play, train

app = group(
    "Dexterous tasks of robot hands: play, train, evaluate, deploy.",
    [play.tasks_, play.play, train.train, play.evaluate, train.distill, train.sweep, deploy.export, deploy.deploy],
)
list_without_command(app, play.tasks_)
