"""The ``brainbench`` command. One thin module per command; heavy imports happen inside them.

Exit status: 0 done; 1 the request was fine but the job failed (unusable data, interrupted);
2 the request itself was wrong (unknown name, option or file).
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
    except KeyboardInterrupt:
        print("brainbench: interrupted; nothing was half-written.", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:
        # The reader (head, less) has gone; Python would otherwise complain again at shutdown.
        sys.stderr.close()
        sys.exit(0)
