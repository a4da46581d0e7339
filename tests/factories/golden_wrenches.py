"""Wrenches that the engines gave when the physics last changed, and how to make them anew.

``python -m tests.factories.golden_wrenches`` writes them again, to be done whenever ``PHYSICS_VERSION`` is raised.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from brainbench.stimuli import get_recipe, simulate
from brainbench.stimuli.engines import PHYSICS_VERSION

GOLDEN = Path(__file__).parents[1] / "stimuli" / "engines" / "golden" / "wrenches.json"
FRAMES = (15, 30, 45, 60, 75, 95)
"""Frames of the recipe that are kept, of 110."""
SETTINGS = {
    "rod fast,precision=double": 1e-6,
    "rod balanced,precision=double": 1e-6,
    "rod accurate,precision=double": 1e-6,
    # Contact magnifies what single precision rounds otherwise on another processor.
    "rod balanced": 5e-3,
    "mujoco fast,time_step=2e-5": 1e-5,
}
"""Engine and fidelity → what may differ from processor to processor, of the largest force and moment."""


def current_wrenches(setting: str) -> np.ndarray:
    """[scene, frame, whisker, 6] of two whiskers in the first two scenes of the recipe ``rodgers``."""
    engine, fidelity = setting.split(" ")
    scenes = [scene.select("C1,C2") for scene in get_recipe("rodgers").scenes[:2]]
    if engine == "mujoco":  # loses friction, and says so
        scenes = [replace(one, objects=tuple(replace(item, friction=0.0) for item in one.objects)) for one in scenes]
    return simulate(scenes, fidelity=fidelity, backend=engine, cache=False)["wrench"].values[:, list(FRAMES)]


def write() -> None:
    wrenches = {name: [float(f"{x:.9g}") for x in current_wrenches(name).ravel()] for name in SETTINGS}
    GOLDEN.parent.mkdir(exist_ok=True)
    GOLDEN.write_text(json.dumps({"physics_version": PHYSICS_VERSION, "wrenches": wrenches}, indent=0) + "\n")


if __name__ == "__main__":
    write()
