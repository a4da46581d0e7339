"""``brainbench leaderboard``: add, check and compare result records; build the site, reports, and serve it."""

import typer

from brainbench.cli.leaderboard import add, build, diff, report, serve, verify

app = typer.Typer(no_args_is_help=True, help="Collect result records, check them, and show them as a leaderboard.")
app.command("add")(add.add)
app.command("verify")(verify.verify)
app.command("diff")(diff.diff)
app.command("build")(build.build)
app.command("report")(report.report)
app.command("serve")(serve.serve)
