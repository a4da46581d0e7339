"""``brainbench tactile calibrate``: noise knobs from a device's recording."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit, table


def calibrate(
    log: Annotated[Path, typer.Argument(help="CSV with 'time' (s), probes, and optionally 'reference' and 'episode'.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write the preset here (.json).")] = None,
    max_delay: Annotated[float, typer.Option(help="Longest read delay that is tried (s).")] = 0.5,
    as_json: JsonOption = False,
) -> None:
    """Fit the noise model to a recording of a real device, with 95 % intervals, and write a preset.

    'reference' holds the true signal in the sensor's unit (a load cell, a stage); without it the device was at rest.
    Load the preset with robotics_bridge.sensors.Noise.load(path).
    """
    from brainbench.core.errors import UsageError
    from robotics_bridge.sensors.calibration.calibrate import calibrate as fit
    from robotics_bridge.sensors.calibration.calibrate import describe
    from robotics_bridge.sensors.calibration.log import read_log

    if not max_delay >= 0:
        raise UsageError(f"--max-delay is zero or positive (s); received {max_delay:g}.")
    found = fit(read_log(log), max_delay=max_delay)
    if out is not None:
        found.save(out, log=log.name)
    rows = []
    for name, item in describe(found):
        span = f"{item.low:.4g} … {item.high:.4g}" if math.isfinite(item.low) and math.isfinite(item.high) else ""
        rows.append([name, f"{item.value:.4g}", span, item.how])
    about = found.about
    title = f"{log.name}: {len(about['probes'])} probes, {about['episodes']} episodes, {about['readings']} readings"
    text = table(title, ["knob", "value", "95 % interval", "from"], rows, right=(1,))
    text += "\n\n" + "\n".join(found.notes) + (f"\nWrote {out}." if out is not None else "")
    data = {"noise": found.noise, "estimates": found.estimates, "notes": found.notes, "about": about}
    emit({**data, "preset": out}, text, as_json=as_json)
