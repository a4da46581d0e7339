"""``brainbench leaderboard``: add, check and compare result records, hold recordings back, build sites and reports."""

from brainbench.cli.leaderboard import add, site, verify
from brainbench.cli.output import group

app = group(
    "Collect result records, check them, and show them as a leaderboard.",
    [add.add, verify.verify, verify.check_submission, verify.hold_out, site.diff, site.build, site.report],
    no_args_is_help=True,
)
