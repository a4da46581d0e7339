"""``brainbench leaderboard hold-out``: keep animals or stimuli of recordings back, and score submissions on them."""

from __future__ import annotations

import math
import secrets
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import SCORE, out_folder, out_folder_option, with_options
from brainbench.cli.output import Output, progress_bar
from brainbench.core.errors import UsageError
from brainbench.core.files import content_hash, private_folder, write_json
from brainbench.core.reading.ranges import check_number

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.core.records import ResultRecord, Score
    from leaderboards.held_out import Commitment

PUBLIC = "public.h5"
"""File of the public part."""
FEWEST = {"animals": 2, "stimuli": 3}
"""Fewest on either side: less has no score."""


@with_options(SCORE, ("conditions", "select", "window"), build=False)
def hold_out(
    recordings: Annotated[str, typer.Argument(help="An NWB or HDF5 file, a folder, a glob, or 'demo'.")],
    animals: Annotated[int, typer.Option(help="Number of animals to hold back.")] = 0,
    stimuli: Annotated[int, typer.Option(help="Number of stimuli to hold back.")] = 0,
    out: Annotated[Path, out_folder_option("Folder of what is published.")] = Path("board"),
    secret: Annotated[
        Path, typer.Option(callback=out_folder, help="Folder of what is kept back; never publish it.")
    ] = Path("held-out-secret"),
    options: Any = None,
) -> Output:
    """Split recordings into a public part and a held-out part, drawn at random, and publish a hash of the latter.

    Anybody can score models on the public part; ``leaderboard verify --held-out`` scores a submission on the rest.
    """
    from brainbench.datasets import write_recordings
    from brainbench.datasets.reading import find_recordings
    from brainbench.scoring.demo import DEMOS
    from brainbench.scoring.neural_responses import open_neural_responses
    from leaderboards.held_out import DATA, Commitment, digest, new_salt

    if (animals > 0) == (stimuli > 0):
        raise UsageError(f"Hold back either --animals or --stimuli; received {animals} and {stimuli}.")
    if secret.exists():
        raise UsageError(f"The folder {str(secret)!r} exists; name a new one, so that no earlier secret is lost.")
    sources = [] if recordings in DEMOS else find_recordings(recordings)[1]
    if (out / PUBLIC).resolve() in [path.resolve() for path in sources]:
        raise UsageError(f"The public part would take the place of {recordings!r}, which it is of; give another --out.")
    kind = "animals" if animals else "stimuli"
    with progress_bar() as progress:
        whole = open_neural_responses(recordings, progress=progress, **options).dataset
    names = list(whole.attrs["vocabulary"]) if stimuli else sorted(set(map(str, whole["subject"].values)))
    held_count = animals or stimuli
    check_number(f"{kind} held back", held_count, least=FEWEST[kind], most=len(names) - FEWEST[kind])
    drawn = set(secrets.SystemRandom().sample(names, held_count))
    held, public = (split(whole, kind, [n for n in names if (n in drawn) is kept]) for kept in (True, False))
    data = write_recordings(private_folder(secret) / DATA, held)
    data.chmod(0o600)
    of, hashed = str(whole.attrs["content_hash"]), digest(data, new_salt(secret))
    commitment = Commitment(kind, held_count, len(names) - held_count, of, hashed)
    files = [
        write_recordings(out / PUBLIC, public),
        # Stimuli without recordings are left out only where the pairs are named.
        write_json(out / "match.json", {name: name for name in public.attrs["vocabulary"]}),
        write_json(out / "held-out.json", commitment.plain),
    ]
    text = f"published  {out}: {', '.join(path.name for path in files)}\nkept back  {secret}: {held_count} {kind}"
    return Output({"published": files, "secret": secret, "commitment": commitment.plain}, text)


def split(whole: xr.Dataset, kind: str, names: list[str]) -> xr.Dataset:
    """Return the trials, and of animals also the units, of some animals or stimuli of a recordings data set."""
    from brainbench.datasets.trials.session_trials import fingerprint

    if kind == "animals":
        part = whole.isel(trial=whole["subject"].isin(names).values, unit=whole["unit_subject"].isin(names).values)
    else:
        part = whole.isel(trial=whole["stimulus"].isin(names).values)
    labels = [label for label in whole.attrs["vocabulary"] if kind == "animals" or label in names]
    part_hash = content_hash(whole.attrs["content_hash"], kind, names)
    return part.assign_attrs(vocabulary=labels, content_hash=part_hash, fingerprint=fingerprint(part))


def score_held_out(record: ResultRecord, commitment: Commitment, secret: Path) -> dict[str, Any]:
    """Score the model of a record on held-out recordings, with the options that the record states.

    The answer is rounded to two digits: many submissions shall learn little of the held-out part.
    """
    from brainbench.datasets import open_recordings
    from brainbench.scoring.options import ScoreOptions
    from brainbench.scoring.scores import score_record

    held = open_recordings(commitment.open(secret))
    pairs = record.score.provenance.pairs
    match = {label: pairs.get(label, label) for label in held.attrs["vocabulary"]}
    settings = {**record.score.provenance.settings, "conditions": None, "select": None, "window": None, "bin": None}
    options = ScoreOptions.stated_in(settings, recordings=held, match=match)
    held_score = score_record(str(settings["model"]), options).score
    return {
        "held_out": f"{commitment.held} {commitment.kind}",
        "on_public": _two_digits(record.score),
        "on_held_out": _two_digits(held_score),
    }


def _two_digits(score: Score) -> dict[str, Any]:
    from leaderboards.ranking import standing_of

    span = score.scaled_interval
    values = {"score": score.scaled, "low": span.low if span else math.nan, "high": span.high if span else math.nan}
    return {name: round(value, 2) if math.isfinite(value) else None for name, value in values.items()} | {
        "standing": standing_of(score, above_raw=False)
    }
