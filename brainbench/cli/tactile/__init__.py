"""``brainbench tactile``: look at tactile sensors, layouts and their speed; calibrate noise. One module per command."""

from __future__ import annotations

import typer

from brainbench.cli.tactile import bench, calibrate, check, demo, layouts

app = typer.Typer(
    no_args_is_help=True, help="Tactile sensors of robot hands: demo, layouts, speed, checks, calibration."
)
app.command("demo")(demo.demo)
app.command("layouts")(layouts.layouts)
app.command("bench")(bench.bench)
app.command("check")(check.check)
app.command("calibrate")(calibrate.calibrate)
