"""Measuring error against cost: points are kept, tables of other experiments are refused."""

import json
from dataclasses import replace

import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.validation import bench_tests
from brainbench.tradeoffs import whiskers
from brainbench.tradeoffs.study import run_study
from brainbench.tradeoffs.whiskers import SimulationSetting


@pytest.fixture
def quick(monkeypatch):
    """A coarse reference, one peg and four kinds of scenes, so that a point takes a moment."""
    coarse = SimulationSetting(Fidelity(links=8, time_step=2e-4, steps_per_period=10), "mujoco")
    monkeypatch.setattr(whiskers, "REFERENCE", coarse)
    monkeypatch.setattr(whiskers, "PEGS", ((0.5, 0.1),))
    monkeypatch.setattr(bench_tests, "SPECIES", ("mouse",))
    monkeypatch.setattr(bench_tests, "FREQUENCIES", (20.0,))
    monkeypatch.setattr(bench_tests, "FRICTIONS", (0.0,))


COARSE = SimulationSetting(Fidelity(links=6, time_step=2e-4, steps_per_period=10), "mujoco")
SOLVED = whiskers.REFERENCE.fidelity.contact_tolerance
FINE = SimulationSetting(Fidelity(links=8, time_step=2e-4, steps_per_period=10), "mujoco")


@pytest.mark.slow
def test_a_setting_is_measured_once_and_the_reference_differs_from_itself_by_nothing(quick, tmp_path):
    path = tmp_path / "table.json"
    (first,) = run_study(whiskers.study([FINE]), path)
    assert first["error_50"] == first["error_90"] == first["error_95"] == first["untrusted"] == 0
    assert min(first["static_error"], first["ring_error"]) > 0
    both = run_study(whiskers.study([FINE, COARSE]), path)
    # Cost is a measured time, so an equal number means that the point was kept.
    assert both[0] == first
    assert both[1]["error_95"] >= both[1]["error_90"] >= both[1]["error_50"] > 0
    assert json.loads(path.read_text())["points"] == both


def test_a_table_of_other_experiments_is_refused(tmp_path):
    path = tmp_path / "table.json"
    path.write_text(json.dumps({"protocol": 1, "points": []}))
    with pytest.raises(DataError, match=r"table\.json' was not measured with protocol 6, mujoco"):
        run_study(whiskers.study([COARSE]), path)


def test_an_unknown_backend_is_refused_before_anything_is_measured(tmp_path):
    with pytest.raises(UsageError, match="did you mean 'mujoco'"):
        run_study(whiskers.study([SimulationSetting(COARSE.fidelity, "mujocco")]), tmp_path / "table.json")


@pytest.mark.slow
def test_collision_geometries_of_a_concave_object_are_measured_beside_the_bench_tests(quick, tmp_path):
    path = tmp_path / "table.json"
    chosen = [FINE, *(replace(FINE, collision=name) for name in ("exact", "decomposition-0.02", "hull"))]
    bench, exact, cut, hull = run_study(whiskers.study(chosen), path)
    assert exact["error_95"] == exact["untrusted"] == 0
    assert exact["pieces"] == 24
    # A hull fills the hollow that whiskers move in: some start inside and cannot be trusted.
    assert 0 < cut["error_50"] < 0.5
    assert hull["untrusted"] > 0.1 + cut["untrusted"]
    assert hull["error_90"] is None
    assert 1 < cut["pieces"] < 24
    assert [point.settings["links"] for point in whiskers.best([bench, exact, cut, hull])] == [8]
    # Kept points are not measured again.
    assert run_study(whiskers.study(chosen[1:]), path) == [bench, exact, cut, hull]


@pytest.mark.parametrize("text", ["hul", "decomposition", "decomposition-fine", "hull-0.1"])
def test_an_unknown_collision_geometry_is_refused(text):
    with pytest.raises(UsageError, match=f"'{text}'.*'decomposition-0.02'"):
        SimulationSetting(COARSE.fidelity, collision=text)


def test_every_backend_and_collision_geometry_that_is_asked_for_is_in_the_grid():
    chosen = whiskers.settings(links=(), backends=("mujoco", "bullet"), collisions=("hull", "exact"))
    assert len([item for item in chosen if item.collision is None]) == 2 * 3
    hollow = [item for item in chosen if item.collision is not None]
    assert {(item.backend, item.collision) for item in hollow} == {
        (backend, collision) for backend in ("mujoco", "bullet") for collision in ("hull", "exact")
    }
    assert len(hollow) == 3 * 4


def test_the_front_leaves_out_failed_and_beaten_settings():
    def point(links, error, cost):
        return {"links": links, "links_per_mm": None, "time_step": 1e-4, "steps_per_period": None,
                "backend": "mujoco", "error_90": error, "cost": cost}  # fmt: skip

    points = [point(6, 0.1, 1.0), point(8, 0.2, 2.0), point(10, 0.05, 3.0), point(4, None, None)]
    assert [best.settings["links"] for best in whiskers.best(points)] == [6, 10]


def test_the_grid_holds_the_presets_and_no_setting_twice():
    chosen = whiskers.settings()
    assert len(set(chosen)) == len(chosen)
    assert SimulationSetting(Fidelity.preset("balanced")) in chosen


def test_the_solver_is_an_axis_of_the_backend_that_has_two_and_no_rival_of_the_presets():
    chosen = whiskers.settings(
        links=(8,), time_steps=((1e-3, 25.0),), backends=("mujoco", "rod"), solvers=("quasistatic",)
    )
    assert [(item.backend, item.fidelity) for item in chosen] == [
        ("rod", Fidelity(links=8, time_step=1e-3, solver="quasistatic", contact_tolerance=1e-6))
    ]
    with pytest.raises(UsageError, match="'static'; did you mean 'quasistatic'"):
        whiskers.settings(solvers=("static",))
    point = {"links": 8, "links_per_mm": None, "time_step": 1e-3, "steps_per_period": None, "backend": "rod"}
    moving, still = ({**point, "solver": name, "error_90": 0.1, "cost": 1.0} for name in ("dynamic", "quasistatic"))
    assert len(whiskers.best([moving, {**still, "error_90": 0.01}])) == 1
    assert whiskers.best([still]) == []


@pytest.mark.slow
def test_what_few_iterations_leave_of_contact_forces_is_among_the_errors(quick, monkeypatch, tmp_path):
    pytest.importorskip("warp")
    monkeypatch.setattr(bench_tests, "FRICTIONS", (0.8,))
    same = Fidelity(links=8, time_step=2e-4, steps_per_period=10, precision="double")
    monkeypatch.setattr(whiskers, "REFERENCE", SimulationSetting(replace(same, contact_tolerance=SOLVED), "rod"))
    chosen = [SimulationSetting(replace(same, contact_tolerance=each), "rod") for each in (None, 1e-6)]
    few, solved = run_study(whiskers.study(chosen), tmp_path / "table.json")
    # Two points, though they differ in the tolerance alone.
    assert few["error_90"] > 0.1
    assert solved["error_90"] < 1e-4


@pytest.mark.slow
def test_a_setting_without_inertia_is_measured_in_all_that_does_not_ring(tmp_path):
    pytest.importorskip("warp")
    chosen = whiskers.settings(links=(10,), time_steps=((1e-3, None),), backends=("rod",), solvers=("quasistatic",))
    (point,) = run_study(whiskers.study(chosen), tmp_path / "table.json")
    assert point["ring_error"] is None
    assert point["static_error"] < 0.02
    assert point["error_90"] > point["error_50"] > 0.01
