"""Measure every preset against the elastica, the slip-off depth, the Euler-Bernoulli frequencies, and a shaken beam.

Run from the repository root: ``python -m benchmarks.whiskers.validation``; it rewrites its sections of RESULTS.md, one
per ``--backend`` and ``--part``. Gates (base moment and force of pegs, slip-off, frequencies, damping, peak moment of a
base that is shaken or pushed) are :data:`GATES`.
"""

from __future__ import annotations

import argparse
import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.report import table, write_section
from benchmarks.whiskers import out_of_plane
from brainbench.core.errors import BrainbenchError
from brainbench.stimuli.engines import list_engines
from brainbench.stimuli.engines.fidelity import Fidelity, list_presets
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.validation import bench_tests, references
from brainbench.stimuli.validation.bench_tests import ringdown
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.stimuli.validation.test_shaken_base import shaken_base

PARTS = ("plane", "out-of-plane", "fast-bases")
ARCS = (0.3, 0.5, 0.7, 0.8)
OFFSETS = (0.02, 0.1, 0.2, 0.3)
SLIPS = (0.3, 0.5, 0.8)
SHAKES = (400.0, 700.0, 1000.0, 2000.0)
PULSES = (1e-4, 6e-4)
"""Frequencies (Hz) and widths (s) of sideways motions of the base by 10 µm."""
GATES = {
    "accurate": {"moment": 0.01, "force": 0.02, "slip": 0.03, "frequency": 0.01, "damping": 0.05, "shake": 0.02},
    "balanced": {**dict.fromkeys(("moment", "force", "slip", "frequency", "damping"), 0.05), "shake": 0.1},
    "fast": {**dict.fromkeys(("moment", "force", "slip", "frequency", "damping"), 0.15), "shake": 0.2},
}
"""Largest relative errors allowed where the contact slope is at most 60° and the depth at most .9 of slip-off."""


def subjects() -> dict[str, Whisker]:
    """Straightened published whiskers and two synthetic rods."""
    mouse, rat = WhiskerArray.mouse(), WhiskerArray.rat()
    whiskers = {f"mouse {name}": replace(mouse[name].whisker, curvature=0.0) for name in ("C2", "A4", "E5")}
    whiskers["rat C1"] = replace(rat["C1"].whisker, curvature=0.0)
    whiskers["uniform"] = Whisker(0.015, 30e-6, 30e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.32)
    whiskers["taper 20:1"] = Whisker(0.020, 60e-6, 3e-6, young_modulus=3e9, density=1300.0, damping_ratio=0.32)
    return whiskers


def measure(name: str, backend: str) -> dict[str, dict[str, object]]:
    """Run all bench tests of one whisker at every preset."""
    whisker = subjects()[name]
    length = whisker.arc_length
    result: dict[str, dict[str, object]] = {
        preset: {"pegs": {}, "slips": {}, "seconds": 0.0, "time": 0.0} for preset in list_presets()
    }
    for at in ARCS:
        limit = references.slip_off_offset(whisker, at * length)
        for offset in OFFSETS:
            if offset * length >= limit:
                continue
            contact = references.elastica(whisker, at * length, offset * length)
            gated = abs(contact.slope) <= math.radians(60) and offset * length <= 0.9 * limit
            for preset, out in result.items():
                try:
                    test = bench_tests.peg(whisker, at * length, offset * length, backend=backend, fidelity=preset)
                    cell = (test.moment_error, test.force_error, gated)
                    out["seconds"] += test.trace.seconds
                    out["time"] += test.trace.steps * step(whisker, preset)
                except BrainbenchError as error:
                    cell = (math.inf, math.inf, gated, str(error))
                out["pegs"][at, offset] = cell
        for preset, out in result.items():
            if at in SLIPS:
                try:
                    out["slips"][at] = bench_tests.slip_off(
                        whisker, at * length, backend=backend, fidelity=preset
                    ).error
                except BrainbenchError:
                    out["slips"][at] = math.inf
    for preset, out in result.items():
        out["ring"] = ringdown(whisker, backend=backend, fidelity=preset)
        out["own"] = ringdown(whisker, own_step=True, backend=backend, fidelity=preset).frequency_errors
    return result


def report_fast_bases(backend: str) -> tuple[str, list[str]]:
    """Return the table of shaken and pushed bases, and the broken gates."""
    rows, broken = [], []
    for preset in list_presets():
        for name, whisker in subjects().items():
            errors = [shaken(whisker, hertz, backend, preset) for hertz in SHAKES]
            errors += [pushed(whisker, width, backend, preset) for width in PULSES]
            rows.append([preset, name, *(f"{100 * error:+.2f}" for error in errors)])
            if np.abs(errors).max() > GATES[preset]["shake"]:
                broken.append(f"{preset} {name}: {rows[-1][2:]}")
            print(rows[-1], flush=True)
    named = [*(f"{hertz:g} Hz" for hertz in SHAKES), *(f"{1e3 * width:g} ms pulse" for width in PULSES)]
    text = "Base shaken for 30 ms or pushed once, by 10 µm: error of the peak base moment in % of the beam's.\n\n"
    text += table(["preset", "whisker", *named], rows)
    return text + "\n\nBroken gates: " + ("none." if not broken else "; ".join(broken)), broken


def shaken(whisker: Whisker, hertz: float, backend: str, preset: str) -> float:
    """Return the error of the peak moment of a base that is shaken for 30 ms."""

    def motion(times: np.ndarray) -> np.ndarray:
        return 1e-5 * smooth_step(times, 4 / hertz) * np.sin(2 * np.pi * hertz * times)

    times = np.arange(1, int(1.2 * hertz) + 1) / (40 * hertz)
    return shaken_base(whisker, motion, times, backend=backend, fidelity=preset).peak_error


def pushed(whisker: Whisker, width: float, backend: str, preset: str) -> float:
    """Return the error of the peak moment of a base that is pushed once."""

    def motion(times: np.ndarray) -> np.ndarray:
        u = np.clip((times - 2e-3) / width, 0, 1)
        return 1e-5 * np.sin(np.pi * u) ** 4

    return shaken_base(whisker, motion, np.arange(1, 1001) * 1e-5, backend=backend, fidelity=preset).peak_error


def step(whisker: Whisker, preset: str) -> float:
    return Fidelity.preset(preset).step(float(references.natural_frequencies(whisker, 1)[0]))


def report(results: dict[str, dict]) -> tuple[str, list[str]]:
    """Return the tables and the broken gates."""
    text, broken = [], []
    text.append(
        "f1 at each preset's own step; f2 and f3 show the chain, at 1/100 of their period, and `own` what the preset's"
        " step makes of them (— below six steps per period: damped away at once; not gated, because a whisker damped"
        " in proportion to its stiffness does not ring in them).\n"
    )
    for preset in list_presets():
        gate = GATES[preset]
        fidelity = Fidelity.preset(preset)
        text.append(
            f"### {preset}\n\n`{fidelity}`\n\nPegs of radius .25 mm: error of base moment / force in %; in brackets"
            " where the contact slope exceeds 60° or the depth .9 of slip-off (not gated); — beyond slip-off.\n"
        )
        rows = []
        for name, result in results.items():
            pegs = result[preset]["pegs"]
            for at in ARCS:
                cells = []
                for offset in OFFSETS:
                    if (at, offset) not in pegs:
                        cells.append("—")
                        continue
                    moment, force, gated, *_ = pegs[at, offset]
                    body = f"{100 * moment:.2f} / {100 * force:.2f}"
                    cells.append(body if gated else f"({body})")
                    if gated and (moment > gate["moment"] or force > gate["force"]):
                        broken.append(f"{preset} {name} peg {at} {offset}: {body}")
                rows.append([name, f"{at:g}", *cells])
        text += [table(["whisker", "a/L", *(f"d/L {offset:g}" for offset in OFFSETS)], rows), ""]
        rows = []
        for name, result in results.items():
            out = result[preset]
            ring, wanted = out["ring"], subjects()[name].damping_ratio
            ratio = ring.damping_ratio / wanted - 1
            rows.append(
                [
                    name,
                    *(f"{100 * out['slips'][at]:+.2f}" for at in SLIPS),
                    *(f"{100 * error:+.2f}" for error in ring.frequency_errors),
                    *("—" if np.isnan(error) else f"{100 * error:+.2f}" for error in out["own"][1:]),
                    f"{ring.damping_ratio:.4f}",
                    f"{1e6 * step(subjects()[name], preset):.1f}",
                    f"{out['seconds'] / out['time']:.3f}",
                ]
            )
            broken += [
                f"{preset} {name} slip {at}: {e}" for at, e in out["slips"].items() if not abs(e) <= gate["slip"]
            ]
            if np.abs(ring.frequency_errors).max() > gate["frequency"]:
                broken.append(f"{preset} {name} frequencies: {ring.frequency_errors}")
            if abs(ratio) > gate["damping"]:
                broken.append(f"{preset} {name} damping: {ring.damping_ratio}")
        columns = ["whisker", "slip-off a/L .3 %", ".5", ".8", "f1 %", "f2 %", "f3 %", "f2 own %", "f3 own %"]
        columns += ["ζ₁ (.32 wanted)"]
        text += [table([*columns, "step µs", "processor s / whisker-s"], rows), ""]
    text.append("Broken gates: " + ("none." if not broken else "\n\n" + "\n".join(f"- {line}" for line in broken)))
    return "\n".join(text), broken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--backend", default="mujoco", choices=list_engines())
    parser.add_argument("--part", choices=(*PARTS, "all"), default="all")
    arguments = parser.parse_args()
    backend, failed = arguments.backend, False
    with ProcessPoolExecutor(arguments.workers) as pool:
        for part in PARTS if arguments.part == "all" else (arguments.part,):
            if part == "plane":
                results = dict(zip(subjects(), pool.map(partial(measure, backend=backend), subjects()), strict=True))
                title, (text, broken) = f"Whisker presets against mechanics ({backend})", report(results)
            elif part == "out-of-plane":
                title, (text, broken) = f"Whiskers out of their plane ({backend})", out_of_plane.report(pool, backend)
            else:
                title, (text, broken) = f"Bases moved fast against a beam ({backend})", report_fast_bases(backend)
            command = f"python -m benchmarks.whiskers.validation --backend {backend} --part {part}"
            write_section(title, command, text, subject="whiskers")
            print(text)
            failed |= bool(broken)
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
