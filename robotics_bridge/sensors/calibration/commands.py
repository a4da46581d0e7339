"""``brainbench tactile calibrate``: the noise of a real device, from a recording of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brainbench.cli.options import out_file_option, with_options
from brainbench.cli.output import Output, table_of
from brainbench.core.errors import UsageError, listing
from brainbench.core.limits import Limit, NotNegative

if TYPE_CHECKING:
    from robotics_bridge.sensors.calibration.calibrate import Log


@dataclass(frozen=True)
class CalibrationOptions:
    """What is tried, and how a device was pressed."""

    max_delay: NotNegative = 0.5
    """Longest read delay that is tried (s)."""
    probes: Path | None = None
    """Probe file of the device that a ball pressed."""
    ball: Annotated[float, Limit(above=0, most=0.1, unit="m")] = 5e-3
    """Radius of that ball (m)."""
    draws: Annotated[int, Limit(least=0, most=1000)] = 0
    """Devices drawn from the posterior, written beside --out."""


@with_options("robotics_bridge.sensors.calibration.commands:CalibrationOptions")
def calibrate(
    options: CalibrationOptions,
    log: Annotated[Path, typer.Argument(help="CSV with 'time' (s), probes, and optionally 'reference' and 'episode'.")],
    out: Annotated[Path | None, out_file_option("Write the preset here (.json).")] = None,
) -> Output:
    """Fit the noise model to a recording of a real device, with 95 % intervals, and write a preset.

    'reference' holds the true signal in the sensor's unit (a load cell, a stage); without it the device was at rest.
    A log of presses has the centre of a ball ('x', 'y', 'z', m, frame of the link) and one or three columns for each
    taxel of --probes: its law, places, normals and faults are fitted too.
    Load the preset with robotics_bridge.sensors.Noise.load(path).
    """
    from robotics_bridge.sensors.calibration.calibrate import calibrate as fit
    from robotics_bridge.sensors.calibration.calibrate import read_log

    record = read_log(log)
    if record.ball is not None:
        return _device(log, record, options, out)
    result = fit(record, max_delay=options.max_delay)
    if out is not None:
        result.save(out, log=log.name)
    about = result.about
    title = f"{log.name}: {len(about['probes'])} probes, {about['episodes']} episodes, {about['readings']} readings"
    text = table_of(title, list(result.estimates.items()), _COLUMNS)
    text += "\n\n" + "\n".join(result.notes) + (f"\nWrote {out}." if out is not None else "")
    data = {"noise": result.noise, "estimates": result.estimates, "notes": result.notes, "about": about}
    return Output({**data, "preset": out}, text)


def _device(path: Path, log: Log, options: CalibrationOptions, out: Path | None) -> Output:
    """Fit a device to presses of a ball."""
    from robotics_bridge.hands.layouts import read_probes
    from robotics_bridge.sensors.calibration.devices import fit_device
    from robotics_bridge.sensors.calibration.presses import Presses

    if options.probes is None:
        raise UsageError("A log of presses needs --probes, the probe file of the device (tactile layouts --out).")
    layout = read_probes(options.probes)
    if len(layout) != 1:
        raise UsageError(f"A device is the taxels of one link; {options.probes.name} has {listing(layout)}.")
    ((link, nominal),) = layout.items()
    names = tuple(dict.fromkeys(name.rsplit(":", 1)[0] if name[-2:] in (":x", ":y", ":z") else name
                                for name in log.probes))  # fmt: skip
    fit = fit_device(Presses(log, nominal, options.ball), max_delay=options.max_delay, names=names)
    if out is not None:
        fit.save(out, link, log=path.name)
        for number, draw in enumerate(fit.draws(options.draws)):
            draw.save(out.with_name(f"{out.stem}-{number:03d}.json"), link, log=path.name)
    text = table_of(f"{path.name}: {len(names)} taxels of {link}", list(fit.estimates.items()), _COLUMNS)
    columns = {
        "taxel": "{0[taxel]}",
        ">beside its place (mm)": lambda row: f"{1e3 * row['shift']:.2f} ± {1e3 * max(row['place_error']):.2f}",
        ">normal off (°)": "{0[tilt]:.1f} ± {0[normal_error]:.1f}",
        ">gain": "{0[gain]:.3f} ± {0[gain_error]:.3f}",
    }
    text += "\n\n" + table_of("", fit.taxels, columns) + f"\n\nOn held-out presses the law errs by {fit.held_out:.1%}."
    text += f"\nStatus: {fit.status}." + "".join(f"\n{doubt}" for doubt in fit.doubts)
    text += "".join(f"\nFault: {fault.text}." for fault in fit.faults) + "".join(f"\n{note}" for note in fit.notes)
    data = {"law": fit.law(), "noise": fit.noise, "estimates": fit.estimates, "taxels": fit.taxels,
            "status": fit.status, "doubts": fit.doubts, "faults": fit.faults, "notes": fit.notes,
            "held_out": fit.held_out, "preset": out}  # fmt: skip
    return Output(data, text + (f"\nWrote {out}." if out is not None else ""))


_COLUMNS = {
    "knob": "{0[0]}",
    ">value": "{0[1].value:.4g}",
    "95 % interval": lambda row: "{0.low:.4g} … {0.high:.4g}".format(row[1]) * math.isfinite(row[1].low + row[1].high),
    "from": "{0[1].how}",
}
