"""Run the same scenes on both engines and measure how far they disagree, and what each costs.

Run from the repository root: ``python -m benchmarks.whiskers.backend_agreement``. Whiskers C0–C3 of the mouse, .2 s
at 1 kHz,
10 links, steps of .1 ms; whiskers that touch nothing are shown for free air only. Per scene and whisker: the peak
moment on ``mujoco``; how much the peaks of force and moment differ on ``bullet``; the root-mean-square difference of
the moment over its peak between the engines, and of each engine from itself at steps of 20 µs; the share of frames in
contact; the largest overlap of whisker and object; processor seconds per simulated second.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from brainbench.stimuli import Fidelity, Frames, PlacedObject, Scene, WhiskerArray, Whisking, get_recipe
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.protocol import Trace
from brainbench.stimuli.motion.trajectories import Still, Translation
from brainbench.stimuli.objects.primitives import box, cylinder, sphere

DURATION = 0.2
FRAMES = Frames(0.001, 0.001, round(DURATION * 1e3) - 1)
WHISKERS = "C0-C3"
USUAL, FINE = Fidelity(links=10, time_step=1e-4), Fidelity(links=10, time_step=2e-5)


def scenes() -> Iterator[Scene]:
    mouse = WhiskerArray.mouse(whiskers=WHISKERS)
    slow = Whisking(frequency=10.0)
    yield Scene("free air", mouse, whisking=Whisking(), frames=FRAMES)
    for friction in (0.0, 0.48):
        pole = PlacedObject(cylinder(1e-3, 0.02), position=(0.0115, 0.0065, 0.0), friction=friction)
        yield Scene(f"pole, friction {friction:g}", mouse, (pole,), slow, frames=FRAMES)
    ball = PlacedObject(sphere(5e-3), (0.016, -0.02, 0.0), motion=Translation((0.0, 0.15, 0.0)), friction=0.3)
    yield Scene("ball passing at 150 mm/s", mouse, (ball,), Still(), frames=FRAMES)
    edge = PlacedObject(
        box((0.01, 0.01, 0.02)),
        (0.0145, -0.02, 0.0),
        (0.0, 0.0, math.pi / 6),
        motion=Translation((0.0, 0.1, 0.0)),
        friction=0.3,
    )
    yield Scene("box edge passing at 100 mm/s", mouse, (edge,), Still(), frames=FRAMES)
    for scene in get_recipe("rodgers", whiskers=WHISKERS).scenes:
        if scene.label in ("convex-close", "concave-close"):
            yield Scene(f"rodgers {scene.label}", scene.array, scene.objects, scene.whisking, scene.head, FRAMES)


def compare(scene: Scene) -> Iterator[str]:
    jobs = scene.jobs()
    runs = [
        get_engine(name).run(jobs, fidelity, workers=1) for fidelity in (USUAL, FINE) for name in ("mujoco", "bullet")
    ]
    for mount, mujoco, bullet, fine_mujoco, fine_bullet in zip(scene.array, *runs, strict=True):
        if any(trace.status != "ok" for trace in (mujoco, bullet, fine_mujoco, fine_bullet)):
            yield f"| {scene.label} | {mount.name} | unstable: {mujoco.reason} / {bullet.reason} | | | | | | |"
            continue
        if scene.objects and not bullet.contact.any():
            continue
        (peak_f, peak_m), (other_f, other_m) = _peaks(mujoco), _peaks(bullet)
        yield (
            f"| {scene.label} | {mount.name} | {peak_m * 1e6:.3g} | {other_f / peak_f - 1:+.1%}, "
            f"{other_m / peak_m - 1:+.1%} | {_gap(bullet, mujoco):.1%} | {_gap(mujoco, fine_mujoco):.1%} / "
            f"{_gap(bullet, fine_bullet):.1%} | {mujoco.contact.mean():.0%} / {bullet.contact.mean():.0%} | "
            f"{mujoco.penetration * 1e6:.2g} / {bullet.penetration * 1e6:.2g} | "
            f"{mujoco.seconds / DURATION:.2g} / {bullet.seconds / DURATION:.2g} |"
        )


def _gap(trace: Trace, other: Trace) -> float:
    """Root-mean-square difference of the moments over the peak of ``other``."""
    difference = np.sum((trace.wrench - other.wrench)[:, 3:] ** 2, axis=1)
    return float(np.sqrt(difference.mean())) / _peaks(other)[1]


def _peaks(trace: Trace) -> tuple[float, float]:
    force, moment = np.linalg.norm(trace.wrench.reshape(-1, 2, 3), axis=2).max(axis=0)
    return float(force), float(moment)


def main() -> None:
    print(
        "| scene | whisker | peak moment, µN·m | peak force, moment: bullet against mujoco | the same, rms | "
        "against 20 µs, rms: mujoco / bullet | in contact | overlap, µm | cost |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for scene in scenes():
        for row in compare(scene):
            print(row, flush=True)


if __name__ == "__main__":
    main()
