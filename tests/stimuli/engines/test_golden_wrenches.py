"""What the engines give is what they gave when the physics last changed its version."""

import json

import numpy as np
import pytest

from brainbench.stimuli.engines import PHYSICS_VERSION
from tests.factories.golden_wrenches import GOLDEN, SETTINGS, current_wrenches

ADVICE = (
    "The engines give other numbers than before. If that is meant, raise brainbench.stimuli.engines.PHYSICS_VERSION, "
    "so that no cached simulation of the old physics is taken for the new one, and write these numbers again with "
    "'python -m tests.factories.golden_wrenches', and the package's stimuli with 'python -m "
    "tests.factories.shipped_stimuli'; if not, the change has a fault."
)
KEPT = json.loads(GOLDEN.read_text(encoding="utf-8"))
LONG = ("mujoco fast,time_step=2e-5", "rod accurate,precision=double")
"""Settings that take more than a few seconds."""


def test_the_golden_wrenches_are_of_this_version_of_the_physics():
    assert KEPT["physics_version"] == PHYSICS_VERSION, ADVICE
    assert set(KEPT["wrenches"]) == set(SETTINGS)


@pytest.mark.parametrize(
    "setting", [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in SETTINGS]
)
def test_an_engine_gives_the_golden_wrenches(setting):
    found = current_wrenches(setting)
    golden = np.reshape(KEPT["wrenches"][setting], found.shape)
    for part in (slice(0, 3), slice(3, 6)):
        peak = np.abs(golden[..., part]).max()
        assert peak > 0
        assert np.abs(found - golden)[..., part].max() <= SETTINGS[setting] * peak, ADVICE
