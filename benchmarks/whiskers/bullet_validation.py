"""The bullet backend against mechanics that needs no simulation, per preset.

Run from the repository root: ``python -m benchmarks.whiskers.bullet_validation``. Straightened whiskers; pegs of .25
mm at
(a/L, d/L) = (.3, .05), (.5, .1), (.5, .2), (.7, .2) against the elastica (worst of the four), a weak point load at .7 L
against the closed form, the ring-down of the first mode; processor time per step while a peg presses.
"""

from __future__ import annotations

from dataclasses import replace

from brainbench.stimuli import Fidelity, Whisker, WhiskerArray
from brainbench.stimuli.engines.fidelity import list_presets
from brainbench.stimuli.validation import bench_tests
from brainbench.stimuli.validation.ringing import ringdown

PEGS = ((0.3, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.2))


def subjects() -> dict[str, Whisker]:
    mouse, rat = WhiskerArray.mouse(whiskers="C2,A4"), WhiskerArray.rat(whiskers="C1")
    chosen = {"mouse C2": mouse["C2"], "mouse A4": mouse["A4"], "rat C1": rat["C1"]}
    return {name: replace(mount.whisker, curvature=0.0) for name, mount in chosen.items()}


def row(name: str, whisker: Whisker, preset: str) -> str:
    length = whisker.arc_length
    pegs = [bench_tests.peg(whisker, a * length, d * length, backend="bullet", fidelity=preset) for a, d in PEGS]
    at = 0.7 * length
    weak = 1e-3 * at / bench_tests.references.point_load_deflection(whisker, 1.0, at)
    load = bench_tests.point_load(whisker, weak, at, backend="bullet", fidelity=preset)
    ringing = ringdown(whisker, backend="bullet", fidelity=preset)
    seconds = sum(peg.trace.seconds for peg in pegs) / sum(peg.trace.steps for peg in pegs)
    return (
        f"| {name} | {preset}, {Fidelity.preset(preset).link_count(length)} links | "
        f"{max(peg.moment_error for peg in pegs):.2%} | {max(peg.force_error for peg in pegs):.2%} | "
        f"{load.deflection / load.reference_deflection - 1:+.2%} | {ringing.frequency_error:+.2%} | "
        f"{ringing.damping_ratio / whisker.damping_ratio - 1:+.1%} | {seconds * 1e6:.0f} µs |"
    )


def main() -> None:
    print("| whisker | preset | base moment | base force | deflection | first frequency | damping ratio | per step |")
    print("|---|---|---|---|---|---|---|---|")
    for name, whisker in subjects().items():
        for preset in list_presets():
            print(row(name, whisker, preset), flush=True)


if __name__ == "__main__":
    main()
