"""Drag of moving air, against Oseen's equations, numerical solutions, the cantilever under uniform load and Galilei."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.air import drag_coefficient, drag_per_length, small_deflection
from brainbench.stimuli.fitting.gradients import GradientRun
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.scenes.scene_files import load_scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.engine_scenes import NEEDLE, H, post

CYLINDER = Whisker(0.02, 4e-5, 4e-5, 3e9, 1300.0, 1.0)
CALM = replace(H, damping_ratio=1.0)
FINE = Fidelity(links=12, time_step=1e-4)


def run(whisker, flow, *, follicle=None, obstacles=(), times=(0.2,), fidelity=FINE, backend="rod", **job):
    given = Job(whisker, follicle or StillFollicle(), obstacles, np.array(times), air_flow=flow, **job)
    (trace,) = get_engine(backend).run([given], fidelity, record_shape=True)
    assert trace.status == "ok", trace.reason
    return trace


def drag_on(points, whisker, flow):
    """Drag [N, 3] (N) on each link of a whisker at rest, from its joints [N + 1, 3]."""
    along = np.diff(points, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    wind = np.array(flow) - along * (along @ np.array(flow))[:, None]
    speed = np.linalg.norm(wind, axis=1)
    middle = (np.arange(len(along)) + 0.5) * whisker.arc_length / len(along)
    force = drag_per_length(2 * whisker.radius(middle), speed) * whisker.arc_length / len(along)
    return (force / speed)[:, None] * wind


def test_slow_drag_is_that_of_oseen():
    reynolds = np.geomspace(1e-4, 0.5, 20)
    lamb = 8 * np.pi / (reynolds * (0.5 - np.euler_gamma + np.log(8 / reynolds)))
    assert drag_coefficient(reynolds) == pytest.approx(lamb, rel=0.16)


def test_faster_drag_is_that_of_steady_solutions():
    # Dennis & Chang (1970), J. Fluid Mech. 42:471.
    assert drag_coefficient([5, 7, 10, 20, 40]) == pytest.approx([4.116, 3.421, 2.846, 2.045, 1.522], rel=0.15)


def test_cantilever_under_uniform_load():
    length, speed = CYLINDER.arc_length, 0.6
    load, rigidity = float(drag_per_length(8e-5, speed)), float(CYLINDER.bending_stiffness(0.0))

    trace = run(CYLINDER, (0.0, speed, 0.0))

    assert trace.wrench[0] == pytest.approx([0, load * length, 0, 0, 0, load * length**2 / 2], rel=2e-3, abs=5e-8)
    assert trace.link_positions[0, -1, 1] == pytest.approx(load * length**4 / (8 * rigidity), rel=5e-3)


@pytest.mark.parametrize("solver", ["dynamic", "quasistatic"])
def test_tapered_whisker_bends_as_beam_theory_says(solver):
    s = np.linspace(0, H.arc_length, 2001)
    trace = run(CALM, (0.0, 0.0, -0.5), fidelity=replace(FINE, solver=solver))

    force = np.trapezoid(drag_per_length(2 * H.radius(s), 0.5), s)
    assert trace.wrench[0, 2] == pytest.approx(-force, rel=5e-3)
    assert -trace.link_positions[0, -1, 2] == pytest.approx(small_deflection(H, 0.5), rel=0.02)


def test_flow_along_a_straight_whisker_does_nothing():
    assert np.abs(run(CYLINDER, (3.0, 0.0, 0.0)).wrench).max() < 1e-12


@dataclass(frozen=True)
class Train:
    """A base that moves on and on."""

    velocity: tuple[float, float, float]

    def pose(self, times):
        position, euler = StillFollicle().pose(times)
        return position + np.outer(times, self.velocity), euler


def test_moving_whisker_feels_the_wind_of_its_motion():
    bent = replace(CALM, curvature=15.0)
    flow = np.array([0.1, 0.4, 0.3])
    resting = run(bent, tuple(flow))
    moving = run(bent, (0.0, 0.0, 0.0), follicle=Train(tuple(-flow)))

    assert moving.wrench == pytest.approx(resting.wrench, rel=2e-3, abs=1e-11)
    assert np.linalg.norm(resting.wrench[0, :3]) == pytest.approx(
        np.linalg.norm(drag_on(resting.link_positions[0], bent, flow).sum(axis=0)), rel=1e-3
    )


def test_mujoco_bends_alike_under_the_same_forces():
    flow, whisker = (0.0, 1.5, 0.0), CALM
    trace = run(whisker, flow)
    points = trace.link_positions[0]
    arcs = (np.arange(12) + 0.5) * whisker.arc_length / 12
    forces = drag_on(points, whisker, flow).tolist()
    loads = tuple(Load(arc, tuple(force)) for arc, force in zip(arcs.tolist(), forces, strict=True))

    same = run(whisker, None, loads=loads, backend="mujoco")

    assert same.wrench[0] == pytest.approx(trace.wrench[0], rel=5e-3, abs=1e-9)
    assert same.link_positions[0, -1] == pytest.approx(points[-1], rel=2e-3, abs=1e-6)


def test_wind_presses_a_whisker_against_a_post():
    flow = (0.0, -2.0, 0.0)
    trace = run(CALM, flow, obstacles=(post(0.012, -0.0011),), times=(0.3,))

    assert trace.contact[0]
    drag = drag_on(trace.link_positions[0], CALM, flow).sum(axis=0)
    assert trace.wrench[0, :3] == pytest.approx(trace.contact_wrench[0, :3] + drag, abs=0.01 * np.abs(drag).max())
    assert trace.contact_wrench[0, 1] > 0.1 * np.abs(drag[1])


def test_thin_tip_in_fast_air_is_stable_at_long_steps():
    whisker, flow, times = replace(NEEDLE, damping_ratio=0.1), (0.0, 3.0, 1.0), np.linspace(0.01, 0.2, 20)
    coarse = run(whisker, flow, times=times, fidelity=Fidelity(links=12, time_step=2e-3, steps_per_period=None))
    fine = run(whisker, flow, times=times)
    assert coarse.wrench[-1] == pytest.approx(fine.wrench[-1], rel=1e-3, abs=1e-12)
    # Once the ringing is over, nothing moves.
    assert np.ptp(fine.wrench[-5:], axis=0).max() < 1e-3 * np.abs(fine.wrench[-1]).max()


def test_still_air_damps():
    loads, times = (Load(0.02, (0.0, 2e-6, 0.0), stop=0.05),), np.linspace(0.05, 0.15, 101)
    undamped = replace(H, damping_ratio=0.0)
    fidelity = Fidelity(links=12, time_step=2e-5, steps_per_period=None)
    swings = [
        np.ptp(run(undamped, flow, loads=loads, times=times, fidelity=fidelity).link_positions[60:, -1, 1])
        for flow in (None, (0.0, 0.0, 0.0))
    ]
    assert swings[1] < 0.9 * swings[0]


FILE = """
air_flow_m_s = [0, 0, 2]
[array]
whiskers = "C2"
[whisking]
kind = "still"
[frames]
first_ms = 100
count = 2
[[scene]]
label = "from below"
[[scene]]
label = "from the side"
air_flow_m_s = [2, 0, 0]
head = { rotation_deg = [0, 90, 0] }
[[scene]]
label = "at rest"
air_flow_m_s = [0, 0, 0]
"""


def test_scene_files_hold_a_flow_in_world_axes(tmp_path):
    path = tmp_path / "wind.toml"
    path.write_text(FILE)
    scenes = load_scene(path).scenes
    wrenches = simulate(scenes, fidelity="fast", cache=False)["wrench"].values[:, -1, 0]

    assert [scene.air_flow for scene in scenes] == [(0, 0, 2), (2, 0, 0), (0, 0, 0)]
    assert scenes[0].config()["air_flow"] == [0, 0, 2]
    assert wrenches[0, 2] > 1e-6
    # The head is turned with the wind: z of the array is x of the world.
    turned = np.concatenate([scenes[1].head.matrix.T @ part for part in np.split(wrenches[1], 2)])
    assert turned == pytest.approx(wrenches[0], rel=1e-4, abs=1e-10)
    assert not wrenches[2].any()


@pytest.mark.parametrize(
    ("speed", "words"),
    [(50.0, "Reynolds number 333.*drag is known up to 180, so up to 27.1 m/s"), (25.0, "lifts a whisker of 20 mm off")],
)
def test_flow_that_nothing_stands_is_refused(speed, words):
    with pytest.raises(UsageError, match=words):
        run(H, (0.0, speed, 0.0))


def test_engines_without_air_say_so():
    for backend in ("mujoco", "bullet"):
        with pytest.raises(UsageError, match=f"'{backend}' feel no air; leave air_flow out, or use the backend 'rod'"):
            run(H, (0.0, 1.0, 0.0), backend=backend)
    with pytest.raises(UsageError, match="no air"):
        GradientRun(lambda values: [Job(H, StillFollicle(), (), np.array([0.1]), air_flow=(0, 1, 0))], [1.0])
