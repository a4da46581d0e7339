"""Whose error is the difference with friction? ``mujoco`` as its friction hardens and its steps shrink, beside ``rod``.

python -m benchmarks.whiskers.rod_friction [--scenes 8] [--whiskers 4] [--settings …] [--write]

MuJoCo has soft friction: a sticking contact creeps, and a sliding one is lifted by its convex cone by about the slip of
one step. ``impratio`` hardens the sticking against the normal contact, smaller steps let either vanish; noslip
iterations of the solver take creep out after the fact. Random sweeps as in ``rod_agreement.py``, friction .48.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.report import publish, script_parser, table
from benchmarks.whiskers.rod_agreement import ACCURATE, FINER, HOW, SHAPES, compare, draw, wrenches
from brainbench.stimuli.engines.mujoco import engine as backend
from brainbench.stimuli.engines.mujoco.model import FRICTION_STIFFNESS, engine
from brainbench.stimuli.objects.collections import resolve_objects

FRICTIONS = "elliptic:0.02:0", "elliptic:1:0", "elliptic:100:0", "elliptic:0.02:10"
SETTINGS = ",".join(f"{step}:{words}" for words in FRICTIONS for step in ("accurate", "10"))


@contextmanager
def friction(cone: str, impratio: float, noslip: int) -> Iterator[None]:
    """Let the models of the backend have another friction."""
    plain = backend.build_model

    def changed(*args: Any, **options: Any) -> Any:
        built = plain(*args, **options)
        built.model.opt.impratio = impratio
        built.model.opt.noslip_iterations = noslip
        built.model.opt.cone = getattr(engine().mjtCone, f"mjCONE_{cone.upper()}")
        return built

    backend.build_model = changed
    try:
        yield
    finally:
        backend.build_model = plain


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--whiskers", type=int, default=4)
    parser.add_argument("--settings", default=SETTINGS, help="step (µs):cone:impratio:noslip iterations, by commas")
    args = parser.parse_args()
    objects = resolve_objects(SHAPES.split(","), collision="hull")
    scenes = draw(objects, args.scenes, args.whiskers, None, 0.48)
    rows = []

    def row(what: str, found: np.ndarray, truth: np.ndarray, seconds: float) -> None:
        rows.append([what, *compare(found, truth), f"{seconds:.0f}"])
        print(rows[-1], flush=True)

    def clocked(fidelity: Any, name: str) -> tuple[np.ndarray, float]:
        begun = time.process_time()
        found = wrenches(scenes, fidelity, name, cache=False)
        return found, time.process_time() - begun

    rod, seconds = clocked(ACCURATE, "rod")
    fine, _ = clocked(FINER, "rod")
    row("rod at `accurate`, itself at 10 µs", fine, rod, seconds)
    before: dict[str, tuple[str, np.ndarray]] = {}
    for text in args.settings.split(","):
        step, cone, impratio, noslip = text.split(":")
        words = text.split(":", 1)[1]
        fidelity = ACCURATE if step == "accurate" else replace(FINER, time_step=1e-6 * float(step))
        with friction(cone, float(impratio), int(noslip)):
            found, seconds = clocked(fidelity, "mujoco")
        named = "`accurate`" if step == "accurate" else f"{step} µs"
        what = f"{named}, {cone}, impratio {float(impratio):g}"
        what += f", {noslip} noslip iterations" if int(noslip) else ""
        what += " (the backend's)" if float(impratio) == FRICTION_STIFFNESS and not int(noslip) else ""
        row(what, found, rod if step == "accurate" else fine, seconds)
        if words in before:
            coarser, values = before[words]
            row(f"– the same, {coarser} against it", values, found, seconds)
        before[words] = named, found
    head = ["mujoco at", "whiskers bent", "left out"]
    head += [*(f"{what} {how}" for what in ("force", "moment") for how in HOW), "processor s"]
    text = (
        f"{args.scenes} random sweeps of thesis-high over hulls, {args.whiskers} whiskers each, friction .48, against "
        '`rod` at `accurate` (finer steps against its 10 µs). Columns as in "Agreement of rod and mujoco".\n\n'
    )
    text += table(head, rows)
    publish(args, "Friction of mujoco beside rod", text)


if __name__ == "__main__":
    main()
