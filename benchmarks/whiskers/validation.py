"""Measure every preset against the elastica, the slip-off depth and the Euler-Bernoulli frequencies.

Run from the repository root: ``python -m benchmarks.whiskers.validation``; it rewrites its sections of RESULTS.md, one
per ``--backend`` and ``--part``. Gates (base moment and force of pegs, slip-off, frequencies, damping): :data:`GATES`.
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
from brainbench.stimuli.validation import bench_tests, references
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import Whisker

ARCS = (0.3, 0.5, 0.7, 0.8)
OFFSETS = (0.02, 0.1, 0.2, 0.3)
SLIPS = (0.3, 0.5, 0.8)
GATES = {
    "accurate": {"moment": 0.01, "force": 0.02, "slip": 0.03, "frequency": 0.01, "damping": 0.05},
    "balanced": dict.fromkeys(("moment", "force", "slip", "frequency", "damping"), 0.05),
    "fast": dict.fromkeys(("moment", "force", "slip", "frequency", "damping"), 0.15),
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
        out["ring"] = bench_tests.ringdown(whisker, backend=backend, fidelity=preset)
        out["own"] = bench_tests.ringdown(whisker, own_step=True, backend=backend, fidelity=preset).frequency_errors
    return result


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
    parser.add_argument("--part", choices=("plane", "out-of-plane", "all"), default="all")
    arguments = parser.parse_args()
    backend, failed = arguments.backend, False
    with ProcessPoolExecutor(arguments.workers) as pool:
        for part in ("plane", "out-of-plane") if arguments.part == "all" else (arguments.part,):
            if part == "plane":
                results = dict(zip(subjects(), pool.map(partial(measure, backend=backend), subjects()), strict=True))
                title, (text, broken) = f"Whisker presets against mechanics ({backend})", report(results)
            else:
                title, (text, broken) = f"Whiskers out of their plane ({backend})", out_of_plane.report(pool, backend)
            command = f"python -m benchmarks.whiskers.validation --backend {backend} --part {part}"
            write_section(title, command, text, subject="whiskers")
            print(text)
            failed |= bool(broken)
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
