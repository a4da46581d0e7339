"""``brainbench tactile replay``: a real hand's log beside the simulated hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.options import option, out_file_option
from brainbench.cli.output import Output, table_of
from brainbench.cli.policy.train import ENV, HandOption


def replay(
    log: Annotated[Path, typer.Argument(help="LeRobot data set (a folder), or CSV of time, joints and taxels.")],
    hand: HandOption = "xhand1",
    episode: Annotated[int, typer.Option(help="Episode of a data set.")] = 0,
    placement: Annotated[str, option(ENV, "placement")] = "tips",
    resolution: Annotated[str, option(ENV, "resolution")] = "low",
    out: Annotated[Path | None, out_file_option("Write both readings of every taxel here (.csv).")] = None,
) -> Output:
    """Let the simulated hand follow a real hand's log, and show real beside simulated readings of every taxel.

    The simulated hand holds a ball, whatever lay in the real one. Forces are normal ones (N). Placement and resolution
    are for a log that does not place its taxels.
    """
    import numpy as np

    from brainbench.core.files import atomic_path
    from robotics_bridge import hands
    from robotics_bridge.deploy.links import replay as replays

    model = hands.load(hand)
    record = replays.read_touch_log(log, model, model.layout(resolution, placement), episode)
    result = replays.replay(record, hand)
    rows = result.rows()
    if out is not None:
        header = ",".join(["time", *(f"{name} {side}" for name in record.taxels for side in ("real", "simulated"))])
        pairs = np.stack([record.force, result.simulated], axis=-1).reshape(len(record.time), -1)
        with atomic_path(out) as path:
            np.savetxt(path, np.c_[record.time, pairs], delimiter=",", fmt="%.6g", header=header, comments="")
    touched = [row for row in rows if row["real_peak"] > 0 or row["simulated_peak"] > 0]
    columns = {
        "taxel": "{0[taxel]}",
        f">real peak ({record.unit})": "{0[real_peak]:.3g}",
        ">simulated (N)": "{0[simulated_peak]:.3g}",
        ">rms error": "{0[error]:.3g}",
        ">bias": "{0[bias]:.3g}",
        ">correlation": lambda row: "" if row["correlation"] is None else f"{row['correlation']:.2f}",
    }
    title = f"{record.name}: {len(record.time)} frames, {len(record.joints)} joints, {len(rows)} taxels on {model.name}"
    text = table_of(title, touched, columns)
    text += f"\n\n{len(rows) - len(touched)} taxels felt nothing, real or simulated. Joints follow within "
    text += f"{result.tracking:.2g} rad (rms)."
    if record.unit != "N":
        text += f" Forces of the log are in {record.unit!r}: only the correlations compare."
    text += "".join(f"\n{doubt}" for doubt in result.doubts) + (f"\nWrote {out}." if out is not None else "")
    data = {"hand": model.name, "frames": len(record.time), "joints": record.joints, "taxels": rows}
    return Output({**data, "tracking": result.tracking, "unit": record.unit, "doubts": result.doubts, "out": out}, text)
