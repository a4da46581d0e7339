"""``brainbench tactile calibrate``: the noise of a real device, from a recording of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import out_file_option
from brainbench.cli.output import Output, table_of
from brainbench.core.errors import UsageError, check_number, listing

if TYPE_CHECKING:
    from robotics_bridge.sensors.calibration.calibrate import Log


def calibrate(
    log: Annotated[Path, typer.Argument(help="CSV with 'time' (s), probes, and optionally 'reference' and 'episode'.")],
    out: Annotated[Path | None, out_file_option("Write the preset here (.json).")] = None,
    max_delay: Annotated[float, typer.Option(help="Longest read delay that is tried (s).")] = 0.5,
    probes: Annotated[Path | None, typer.Option(help="Probe file of the device that a ball pressed.")] = None,
    ball: Annotated[float, typer.Option(help="Radius of that ball (m).")] = 5e-3,
    draws: Annotated[int, typer.Option(help="Devices drawn from the posterior, written beside --out.")] = 0,
) -> Output:
    """Fit the noise model to a recording of a real device, with 95 % intervals, and write a preset.

    'reference' holds the true signal in the sensor's unit (a load cell, a stage); without it the device was at rest.
    A log of presses has the centre of a ball ('x', 'y', 'z', m, frame of the link) and one or three columns for each
    taxel of --probes: its law, places, normals and faults are fitted too.
    Load the preset with robotics_bridge.sensors.Noise.load(path).
    """
    from robotics_bridge.sensors.calibration.calibrate import calibrate as fit
    from robotics_bridge.sensors.calibration.calibrate import read_log

    check_number("--max-delay (s)", max_delay, least=0)
    record = read_log(log)
    if record.ball is not None:
        return _device(log, record, probes, ball, max_delay, out, draws)
    result = fit(record, max_delay=max_delay)
    if out is not None:
        result.save(out, log=log.name)
    about = result.about
    title = f"{log.name}: {len(about['probes'])} probes, {about['episodes']} episodes, {about['readings']} readings"
    text = table_of(title, list(result.estimates.items()), _COLUMNS)
    text += "\n\n" + "\n".join(result.notes) + (f"\nWrote {out}." if out is not None else "")
    data = {"noise": result.noise, "estimates": result.estimates, "notes": result.notes, "about": about}
    return Output({**data, "preset": out}, text)


def _device(
    path: Path, log: Log, probes: Path | None, ball: float, max_delay: float, out: Path | None, draws: int
) -> Output:
    """Fit a device to presses of a ball."""
    from robotics_bridge.hands.layouts import read_probes
    from robotics_bridge.sensors.calibration.devices import fit_device
    from robotics_bridge.sensors.calibration.presses import Presses

    check_number("--ball (m)", ball, above=0, most=0.1)
    check_number("--draws", draws, least=0, most=1000, whole=True)
    if probes is None:
        raise UsageError("A log of presses needs --probes, the probe file of the device (tactile layouts --out).")
    layout = read_probes(probes)
    if len(layout) != 1:
        raise UsageError(f"A device is the taxels of one link; {probes.name} has {listing(layout)}.")
    ((link, nominal),) = layout.items()
    names = tuple(dict.fromkeys(name.rsplit(":", 1)[0] if name[-2:] in (":x", ":y", ":z") else name
                                for name in log.probes))  # fmt: skip
    fit = fit_device(Presses(log, nominal, ball), max_delay=max_delay, names=names)
    if out is not None:
        fit.save(out, link, log=path.name)
        for number, draw in enumerate(fit.draws(draws)):
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


def _interval(estimate: Any) -> str:
    return f"{estimate.low:.4g} … {estimate.high:.4g}" if math.isfinite(estimate.low + estimate.high) else ""


_COLUMNS = {
    "knob": "{0[0]}",
    ">value": "{0[1].value:.4g}",
    "95 % interval": lambda row: _interval(row[1]),
    "from": "{0[1].how}",
}
