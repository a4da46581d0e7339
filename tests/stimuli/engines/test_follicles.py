"""Follicles that give way, against springs in series, an oscillator of one degree of freedom and a centrifuge."""

import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.objects.obstacle import Obstacle, Sphere
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.stimulus_set import read_stimulus_set, write_stimulus_set
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import FollicleSprings, Whisker, build_chain

ENGINES = pytest.mark.parametrize("backend", ["rod", "mujoco"])
STRAIGHT = Whisker(0.03, 5e-5, 2e-5, 3e9, 1300.0, 0.1)
SOFT = FollicleSprings(along_y=(0.2, 2e-4), along_z=(0.4, 4e-4), about_y=(4e-6, 4e-9), about_z=(2e-6, 2e-9))


def run(whisker, *, backend="rod", times=(0.2,), follicle=None, obstacles=(), fidelity="balanced", **job):
    given = Job(whisker, follicle or StillFollicle(), obstacles, np.array(times), **job)
    (trace,) = get_engine(backend).run([given], Fidelity.of(fidelity), record_shape=True)
    assert trace.status == "ok", trace.reason
    return trace


@ENGINES
def test_springs_and_cantilever_bend_in_series(backend):
    arc, force = 0.02, (0.0, 2e-6, 1e-6)
    job = {"backend": backend, "loads": (Load(arc, force),), "times": [0.4]}
    rigid, soft = run(STRAIGHT, **job), run(replace(STRAIGHT, follicle=SOFT), **job)

    slides = [0.0, force[1] / 0.2, force[2] / 0.4]
    turns = [0.0, -force[2] * arc / 4e-6, force[1] * arc / 2e-6]
    assert soft.displacement[0, :3] == pytest.approx(slides, rel=0.01, abs=1e-7)
    # Two turns one after the other, as in MuJoCo, have a small part about the third axis.
    assert soft.displacement[0, 3:] == pytest.approx(turns, rel=0.01, abs=1e-4)
    assert soft.wrench[0] == pytest.approx(rigid.wrench[0], rel=0.01, abs=1e-9)
    moved = soft.link_positions[0, -1] - rigid.link_positions[0, -1]
    tip = STRAIGHT.arc_length
    assert moved[1:] == pytest.approx([slides[1] + turns[2] * tip, slides[2] - turns[1] * tip], rel=0.02)
    assert rigid.displacement is None


def test_quasistatic_whisker_leans_on_its_springs():
    fidelity = replace(Fidelity.of("balanced"), solver="quasistatic")
    soft = run(replace(STRAIGHT, follicle=SOFT), fidelity=fidelity, loads=(Load(0.02, (0.0, 2e-6, 0.0)),))

    assert soft.displacement[0, [1, 5]] == pytest.approx([1e-5, 0.02], rel=0.01)


@ENGINES
@pytest.mark.parametrize("ratio", [0.1, 0.4])
def test_stiff_whisker_rings_on_its_spring(backend, ratio):
    chain = build_chain(STRAIGHT, 11)
    centres = np.cumsum(chain.lengths) - chain.lengths + chain.centres
    inertia = float(chain.masses @ centres**2 + chain.inertias[:, 1].sum())
    stiffness = 2e-8
    omega = math.sqrt(stiffness / inertia)
    spring = stiffness, 2 * ratio * math.sqrt(stiffness * inertia)
    whisker = replace(STRAIGHT, young_modulus=1e13, follicle=FollicleSprings(about_z=spring))
    times = np.linspace(0, 1, 101)[1:] * 2 / (ratio * omega)

    trace = run(whisker, backend=backend, times=times, gravity=(0.0, -0.5, 0.0), fidelity="accurate")

    # A step of weight: the turn overshoots and rings about its balance.
    pull = -0.5 * float(chain.masses @ centres) / stiffness
    phase = times * omega * math.sqrt(1 - ratio**2)
    ring = np.cos(phase) + ratio / math.sqrt(1 - ratio**2) * np.sin(phase)
    expected = pull * (1 - np.exp(-ratio * omega * times) * ring)
    assert trace.displacement[:, 5] == pytest.approx(expected, abs=0.02 * abs(pull))


def test_stiff_springs_tend_to_a_rigid_follicle():
    loads = (Load(0.02, (0.0, 2e-5, 1e-5)),)
    times = np.linspace(0.002, 0.1, 50)
    rigid = run(STRAIGHT, loads=loads, times=times)
    changes = []
    for factor in (10.0, 100.0, 1000.0):
        axes = ("along_y", "along_z", "about_y", "about_z")
        springs = {axis: tuple(factor * np.array(getattr(SOFT, axis))) for axis in axes}
        soft = run(replace(STRAIGHT, follicle=FollicleSprings(**springs)), loads=loads, times=times)
        changes.append(np.linalg.norm(soft.wrench - rigid.wrench) / np.linalg.norm(rigid.wrench))

    assert changes[2] < changes[1] / 3 < changes[0] / 9
    assert changes[2] < 0.02


@ENGINES
def test_contact_presses_through_the_springs(backend):
    arc, depth = 0.018, 2e-4
    along = FollicleSprings(along_y=(0.05, 1e-4), about_z=(2e-6, 2e-9))
    radius = 1e-3
    away = -(radius + float(STRAIGHT.radius(arc)) + 1e-5)

    def motion(times):
        way = (depth + 1e-5) * (1 - np.cos(np.pi * np.clip(times / 0.1, 0, 1))) / 2
        return np.stack([np.full_like(way, arc), away + way, 0 * way], -1), np.tile([1.0, 0, 0, 0], (len(way), 1))

    ball = Obstacle((Sphere((0.0, 0.0, 0.0), radius),), friction=0.0, motion=motion)
    rigid, soft = (
        run(replace(STRAIGHT, follicle=springs), backend=backend, obstacles=(ball,), times=[0.25])
        for springs in (None, along)
    )

    given = depth / rigid.wrench[0, 1]
    expected = depth / (given + 1 / 0.05 + arc**2 / 2e-6)
    assert soft.wrench[0, 1] == pytest.approx(expected, rel=0.03)
    assert soft.displacement[0, [1, 5]] == pytest.approx([expected / 0.05, expected * arc / 2e-6], rel=0.03)


class Centrifuge:
    """A base that turns about z at a constant rate."""

    def __init__(self, rate):
        self.rate = rate

    def pose(self, times):
        euler = np.tile([math.pi / 2, 0.0, -math.pi / 2], (len(times), 1))
        euler[:, 0] += self.rate * times
        return np.zeros((len(times), 3)), euler


@ENGINES
def test_turning_base_pulls_the_whisker_out(backend):
    chain = build_chain(STRAIGHT, 11)
    centre = float(chain.masses @ (np.cumsum(chain.lengths) - chain.lengths + chain.centres) / chain.masses.sum())
    mass, rate, stiffness = chain.masses.sum(), 60.0, 0.01
    damping = 1.4 * math.sqrt(stiffness * mass)
    whisker = replace(STRAIGHT, young_modulus=1e12, follicle=FollicleSprings(along_x=(stiffness, damping)))

    trace = run(whisker, backend=backend, follicle=Centrifuge(rate), times=[0.08])

    pull = mass * rate**2
    assert trace.displacement[0, 0] == pytest.approx(pull * centre / (stiffness - pull), rel=0.01)
    outward = base_rotation(Centrifuge(rate).pose(np.array([0.08]))[1])[0, :, 0]
    assert trace.wrench[0, :3] @ outward == pytest.approx(stiffness * trace.displacement[0, 0], rel=0.02)


def test_follicle_that_gives_way_too_far_is_told():
    job = Job(
        replace(STRAIGHT, follicle=FollicleSprings(along_y=(1e-4, 1e-6))), StillFollicle(), (), np.array([0.1]),
        loads=(Load(0.01, (0.0, 1e-5, 0.0)),),
    )  # fmt: skip
    for backend in ("rod", "mujoco"):
        (trace,) = get_engine(backend).run([job], Fidelity.of("fast"))
        assert trace.status == "unstable"
        assert "the follicle gave way at" in trace.reason


def test_bullet_states_that_it_cannot():
    pytest.importorskip("pybullet")
    job = Job(replace(STRAIGHT, follicle=SOFT), StillFollicle(), (), np.array([0.1]))
    with pytest.raises(UsageError, match="have rigid follicles; leave follicle out"):
        get_engine("bullet").run([job], Fidelity.of("fast"))


def test_stimulus_set_says_how_far_follicles_have_gone(tmp_path):
    post = PlacedObject(sphere(2e-3), position=(0.015, 0.002, 0.003))
    springs = {"about_y": [2e-7, 2e-10], "about_z": [2e-7, 2e-10]}
    soft = WhiskerArray.mouse(whiskers="C1,C2").replace("C2", follicle=springs)
    whisking = Whisking(frequency=20.0, protraction=0.3, retraction=0.1)
    scene = Scene("one", array=soft, objects=(post,), whisking=whisking, frames=Frames(0.0, 2e-3, 20))
    dataset = simulate(scene, fidelity="fast", cache=False)

    again = read_stimulus_set(write_stimulus_set(dataset, tmp_path / "set.h5"))
    assert again["displacement"].dims == ("stimulus", "time", "whisker", "axis")
    gone = again["displacement"].sel(whisker="C2").values[0]
    assert np.abs(gone[:, 4:]).max() > 1e-3
    assert not gone[:, :4].any()
    assert not again["displacement"].sel(whisker="C1").values.any()
    rigid = simulate(replace(scene, array=WhiskerArray.mouse(whiskers="C1,C2")), fidelity="fast", cache=False)
    assert "displacement" not in rigid
    np.testing.assert_array_equal(rigid["wrench"].sel(whisker="C1"), dataset["wrench"].sel(whisker="C1"))
