"""``brainbench leaderboard``: add, check and compare result records, hold recordings back, build sites and reports."""

import typer

from brainbench.cli.leaderboard import add, site, verify

app = typer.Typer(no_args_is_help=True, help="Collect result records, check them, and show them as a leaderboard.")
for _command in (
    add.add,
    verify.verify,
    verify.check_submission,
    verify.hold_out,
    site.diff,
    site.build,
    site.report,
):
    app.command(_command.__name__.replace("_", "-"))(_command)
