"""``brainbench tactile calibrate``: the noise of a real device, from a recording of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import out_file_option
from brainbench.cli.output import Output, table_of
from brainbench.core.reading.ranges import check_number


def calibrate(
    log: Annotated[Path, typer.Argument(help="CSV with 'time' (s), probes, and optionally 'reference' and 'episode'.")],
    out: Annotated[Path | None, out_file_option("Write the preset here (.json).")] = None,
    max_delay: Annotated[float, typer.Option(help="Longest read delay that is tried (s).")] = 0.5,
) -> Output:
    """Fit the noise model to a recording of a real device, with 95 % intervals, and write a preset.

    'reference' holds the true signal in the sensor's unit (a load cell, a stage); without it the device was at rest.
    Load the preset with robotics_bridge.sensors.Noise.load(path).
    """
    from robotics_bridge.sensors.calibration.calibrate import calibrate as fit
    from robotics_bridge.sensors.calibration.calibrate import read_log

    check_number("--max-delay (s)", max_delay, least=0)
    result = fit(read_log(log), max_delay=max_delay)
    if out is not None:
        result.save(out, log=log.name)
    columns = {
        "knob": "{0[0]}",
        ">value": "{0[1].value:.4g}",
        "95 % interval": lambda row: _interval(row[1]),
        "from": "{0[1].how}",
    }
    about = result.about
    title = f"{log.name}: {len(about['probes'])} probes, {about['episodes']} episodes, {about['readings']} readings"
    text = table_of(title, list(result.estimates.items()), columns)
    text += "\n\n" + "\n".join(result.notes) + (f"\nWrote {out}." if out is not None else "")
    data = {"noise": result.noise, "estimates": result.estimates, "notes": result.notes, "about": about}
    return Output({**data, "preset": out}, text)


def _interval(estimate: Any) -> str:
    return f"{estimate.low:.4g} … {estimate.high:.4g}" if math.isfinite(estimate.low + estimate.high) else ""
