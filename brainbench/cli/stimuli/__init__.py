"""``brainbench stimuli``: list, show, simulate, draw and plot stimuli. One module per command."""

from __future__ import annotations

import typer

from brainbench.cli.stimuli import draw, hand, objects, separability, show, simulate, sweep

app = typer.Typer(no_args_is_help=True, help="Simulate whiskers on objects; look at scenes and forces.")
app.command("list")(show.list_)
app.command("show")(show.show)
app.command("simulate")(simulate.simulate)
app.command("sweep")(sweep.sweep)
app.command("separability")(separability.separability)
app.command("render")(draw.render)
app.command("plot")(draw.plot)
app.command("objects")(objects.objects)
app.command("hand")(hand.hand)
