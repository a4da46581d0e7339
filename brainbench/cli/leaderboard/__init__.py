"""``brainbench leaderboard``: add, check and compare result records; build the site, reports, and serve it."""

import typer

from brainbench.cli.leaderboard import records, site

app = typer.Typer(no_args_is_help=True, help="Collect result records, check them, and show them as a leaderboard.")
for _command in (records.add, records.verify, site.diff, site.build, site.report, site.serve):
    app.command(_command.__name__)(_command)
