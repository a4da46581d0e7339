"""The engine that is meant where none is named."""

import inspect

import pytest

from brainbench.cli.stimuli import scenes, simulate
from brainbench.cli.stimuli import simulate as simulate_command
from brainbench.stimuli import load_stimuli, simulation
from brainbench.stimuli.engines import fidelity, get_engine, list_engines
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE
from brainbench.stimuli.figures import pictures
from brainbench.stimuli.sweeps.plan import GenerationSettings, simulate_sweeps
from brainbench.stimuli.validation import bench_tests
from tests.factories import out_of_plane

ASKED = (
    simulation.simulate, simulation.prepare, load_stimuli, simulation.record, pictures.render, simulate_sweeps,
    bench_tests.peg, bench_tests.point_load, bench_tests.ringdown, bench_tests.slip_off, out_of_plane.load_aside,
    out_of_plane.push_aside, fidelity.measured,
    fidelity.Fidelity.auto, GenerationSettings, scenes.render, scenes.plot,
    simulate_command.simulate, simulate.sweep,
)  # fmt: skip


@pytest.mark.parametrize("function", ASKED, ids=lambda function: f"{function.__module__}.{function.__qualname__}")
def test_one_constant_is_the_default_of_whatever_takes_an_engine(function):
    assert inspect.signature(function).parameters["backend"].default == DEFAULT_ENGINE


def test_the_default_engine_exists_and_runs_on_a_processor():
    assert DEFAULT_ENGINE in list_engines()
    assert "cpu" in get_engine(DEFAULT_ENGINE).devices


def test_the_settings_that_are_picked_automatically_are_measured_ones_of_the_default_engine():
    chosen = fidelity.Fidelity.auto(error=0.1)
    point = next(item for item in fidelity.measured() if fidelity.Fidelity(**item.settings, error=0.1) == chosen)
    assert point.error <= 0.1
    assert point in fidelity.measured(DEFAULT_ENGINE)
