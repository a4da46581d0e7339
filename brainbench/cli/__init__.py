"""The ``brainbench`` command. One thin module per command; heavy imports happen inside them.

Exit status: 0 done; 1 the request was fine but the job failed (unusable data);
2 the request itself was wrong (unknown name, option or file); 130 interrupted (Ctrl-C).
"""

from __future__ import annotations

import logging
import os
import sys
from typing import Annotated

import typer

from brainbench import __version__
from brainbench.cli import (
    doctor,
    leaderboard,
    models,
    policy,
    power,
    recordings,
    recovery,
    requirements,
    score,
    stimuli,
    tactile,
    tradeoff,
    train,
)
from brainbench.core.errors import BrainbenchError

app = typer.Typer(
    name="brainbench",
    help="Which artificial networks process touch the way a brain does?",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("score")(score.score)
app.command("power")(power.power)
app.command("recovery")(recovery.recovery)
app.command("train")(train.train)
app.command("export")(models.export)
app.command("doctor")(doctor.doctor)
app.add_typer(models.app, name="models")
app.add_typer(recordings.app, name="recordings")
app.add_typer(stimuli.app, name="stimuli")
app.add_typer(tactile.app, name="tactile")
app.add_typer(policy.app, name="policy")
app.add_typer(tradeoff.app, name="tradeoff")
app.add_typer(leaderboard.app, name="leaderboard")
requirements.guard(app)

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells count it: 128 and the number of the signal."""
GO_ON = (
    "interrupted; no file was left half-written. Give the same command again: what it had finished (simulations, "
    "checkpoints, shards of a data set) is kept and not made again."
)


def _version(show: bool) -> None:
    if show:
        print(__version__)
        raise typer.Exit


@app.callback()
def _root(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what is done, on stderr.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    logging.basicConfig(
        stream=sys.stderr,
        level=logging.INFO if verbose else logging.WARNING,
        format="%(levelname)s %(name)s: %(message)s",
    )


def main() -> None:
    """Entry point: run a command and turn our own errors into one line and an exit status."""
    # Idle OpenMP threads would otherwise spin and slow each other down on a busy machine.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        app()
    except BrainbenchError as error:
        print(f"brainbench: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except SystemExit as stop:
        # typer turns Ctrl-C into this status, without a word.
        if stop.code == INTERRUPTED:
            print(f"\nbrainbench: {GO_ON}", file=sys.stderr)
        raise
    except BrokenPipeError:
        # The reader (head, less) has gone; Python would otherwise complain again at shutdown.
        sys.stderr.close()
        sys.exit(0)
