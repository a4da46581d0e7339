"""``brainbench stimuli``: list, show, simulate, draw and plot stimuli.

:mod:`~brainbench.cli.stimuli.scenes` shows and draws what a SOURCE names, ``simulate`` computes forces.
"""

from __future__ import annotations

import typer

from brainbench.cli.output import list_without_command
from brainbench.cli.stimuli import scenes, simulate

app = typer.Typer(help="Simulate whiskers on objects; look at scenes and forces.")
app.command("list")(scenes.list_)
list_without_command(app, scenes.list_)
for _command in (
    scenes.show,
    simulate.simulate,
    simulate.sweep,
    simulate.separability,
    scenes.render,
    scenes.plot,
    scenes.objects,
):
    app.command(_command.__name__)(_command)
