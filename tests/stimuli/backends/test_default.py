"""The engine that is meant where none is named."""

import inspect

import pytest

from brainbench.cli.stimuli import draw, sweep
from brainbench.cli.stimuli import simulate as simulate_command
from brainbench.stimuli import fidelity, load_stimuli, recording, render, simulation, tradeoff, validation
from brainbench.stimuli.backends import DEFAULT_BACKEND, get_backend, list_backends
from brainbench.stimuli.generation.engine import simulate_sweeps
from brainbench.stimuli.generation.plan import Settings

ASKED = (
    simulation.simulate, simulation.prepare, load_stimuli, recording.record, render.render, simulate_sweeps,
    validation.peg, validation.point_load, validation.ringdown, validation.slip_off, fidelity.measured,
    fidelity.Fidelity.auto, Settings, tradeoff.Setting, draw.render, draw.plot, simulate_command.simulate, sweep.sweep,
)  # fmt: skip


@pytest.mark.parametrize("function", ASKED, ids=lambda function: f"{function.__module__}.{function.__qualname__}")
def test_one_constant_is_the_default_of_whatever_takes_an_engine(function):
    assert inspect.signature(function).parameters["backend"].default == DEFAULT_BACKEND


def test_the_default_engine_exists_and_runs_on_a_processor():
    assert DEFAULT_BACKEND in list_backends()
    assert "cpu" in get_backend(DEFAULT_BACKEND).devices


def test_the_settings_that_are_picked_automatically_are_measured_ones_of_the_default_engine():
    chosen = fidelity.Fidelity.auto(error=0.03)
    point = next(item for item in fidelity.measured() if fidelity.Fidelity(**item.settings) == chosen)
    assert point.error <= 0.03
    assert point in fidelity.measured(DEFAULT_BACKEND)
