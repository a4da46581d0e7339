"""What the engines give is what they gave when the physics last changed its version.

``python -m tests.stimuli.engines.test_golden_wrenches`` writes that anew.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brainbench.stimuli import get_recipe, simulate
from brainbench.stimuli.engines import PHYSICS_VERSION

ADVICE = (
    "The engines give other numbers than before. If that is meant, raise brainbench.stimuli.engines.PHYSICS_VERSION, "
    "so that no cached simulation of the old physics is taken for the new one, and write these numbers again with "
    "'python -m tests.stimuli.engines.test_golden_wrenches', and the package's stimuli with 'python -m "
    "tests.stimuli.test_stimulus_set'; if not, the change has a fault."
)
GOLDEN = Path(__file__).parent / "golden" / "wrenches.json"
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

KEPT = json.loads(GOLDEN.read_text(encoding="utf-8"))
LONG = ("mujoco fast,time_step=2e-5", "rod accurate,precision=double")
"""Settings that take more than a few seconds."""


def _wrenches(setting: str) -> np.ndarray:
    """[scene, frame, whisker, 6] of two whiskers in the first two scenes of the recipe ``rodgers``."""
    engine, fidelity = setting.split(" ")
    scenes = [scene.select("C1,C2") for scene in get_recipe("rodgers").scenes[:2]]
    if engine == "mujoco":  # loses friction, and says so
        scenes = [replace(one, objects=tuple(replace(item, friction=0.0) for item in one.objects)) for one in scenes]
    return simulate(scenes, fidelity=fidelity, backend=engine, cache=False)["wrench"].values[:, list(FRAMES)]


def test_the_golden_wrenches_are_of_this_version_of_the_physics():
    assert KEPT["physics_version"] == PHYSICS_VERSION, ADVICE
    assert set(KEPT["wrenches"]) == set(SETTINGS)


@pytest.mark.parametrize(
    "setting", [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in SETTINGS]
)
def test_an_engine_gives_the_golden_wrenches(setting):
    found = _wrenches(setting)
    golden = np.reshape(KEPT["wrenches"][setting], found.shape)
    for part in (slice(0, 3), slice(3, 6)):
        peak = np.abs(golden[..., part]).max()
        assert peak > 0
        assert np.abs(found - golden)[..., part].max() <= SETTINGS[setting] * peak, ADVICE


if __name__ == "__main__":
    written = {name: [float(f"{x:.9g}") for x in _wrenches(name).ravel()] for name in SETTINGS}
    GOLDEN.write_text(json.dumps({"physics_version": PHYSICS_VERSION, "wrenches": written}, indent=0) + "\n")
