"""``brainbench tactile``: look at tactile sensors and layouts."""

from __future__ import annotations

from brainbench.cli.output import group
from brainbench.cli.tactile import commands

app = group(
    "Tactile sensors of robot hands: demo, layouts, checks, noise.",
    [commands.demo, commands.layouts, commands.check],
    no_args_is_help=True,
)
