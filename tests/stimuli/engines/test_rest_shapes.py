"""Rest shapes in space: closed forms, balance without loads, and stiffness beside Kirchhoff's equations."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from brainbench.core.errors import UsageError
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.fitting.contacts import find_contacts
from brainbench.stimuli.fitting.gradients import GradientRun
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.scenes.scene_files import load_scene
from brainbench.stimuli.simulation import bending_moments, record
from brainbench.stimuli.tracks.contract import new_shapes
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain
from tests.factories.kirchhoff import KirchhoffRod, load_rod, rod_paths

ENGINES = pytest.mark.parametrize("backend", ["rod", "mujoco"])
ROD = Whisker(0.03, 5e-5, 2e-5, 3e9, 1300.0, 1.0)
HELIX = replace(ROD, bends=((0.0, 90.0, 60.0), (0.03, 90.0, 60.0)))
ESS = replace(ROD, bends=((0.0, 80.0, 0.0), (0.03, -80.0, 0.0)))
TWISTED_ESS = replace(ROD, bends=((0.0, 60.0, 20.0), (0.01, 40.0, 50.0), (0.03, -70.0, 0.0)))
SHAPES = pytest.mark.parametrize("whisker", [HELIX, ESS, TWISTED_ESS], ids=["helix", "s", "twisted s"])
FINE = Fidelity(links=24, time_step=2e-4)


def run(whisker, *, backend="rod", times=(0.3,), fidelity=FINE, **job):
    given = Job(whisker, StillFollicle(), (), np.array(times), **job)
    (trace,) = get_engine(backend).run([given], fidelity, record_shape=True)
    assert trace.status == "ok", trace.reason
    return trace


@cache
def _equilibrium(whisker, arc, force):
    rod = KirchhoffRod.of(whisker)
    return rod, load_rod(rod, arc, force)


def test_constant_curvature_and_torsion_are_a_helix():
    s, speed = np.linspace(0, 0.03, 13), np.hypot(90.0, 60.0)
    axis, x = np.array([60.0, 0.0, 90.0]) / speed, np.array([1.0, 0.0, 0.0])
    along = axis * (axis @ x)
    turn = speed * s[:, None]
    helix = along * s[:, None] + ((x - along) * np.sin(turn) + np.cross(axis, x) * (1 - np.cos(turn))) / speed
    np.testing.assert_allclose(HELIX.rest_points(s), helix, atol=1e-12)


def test_curvature_that_changes_sign_is_an_s():
    s = np.linspace(0, 0.03, 100_001)
    heading = 80.0 * (s - s**2 / 0.03)
    steps = np.stack([np.cos(heading), np.sin(heading), 0 * s], axis=1)
    np.testing.assert_allclose(ESS.rest_points(s), cumulative_trapezoid(steps, s, axis=0, initial=0), atol=1e-10)
    # A plane S needs no roll of its links.
    assert not build_chain(ESS, 20).rest_rolls.any()


def test_rows_may_lie_as_near_as_they_like():
    s = np.linspace(0, 0.03, 13)
    doubled = replace(ROD, bends=((0.0, 90.0, 60.0), (1e-12, 90.0, 60.0), (0.03, 90.0, 60.0)))
    np.testing.assert_allclose(doubled.rest_points(s), HELIX.rest_points(s), atol=1e-14)
    np.testing.assert_array_equal(HELIX.rest_points(s[3]), HELIX.rest_points(s)[3])


def test_a_whisker_is_no_tighter_than_it_is_thick():
    for changes in ({"bends": ((0.0, 0.0, 0.0), (0.03, 0.0, 2.1e4))}, {"curvature": -1.1e4}):
        with pytest.raises(UsageError, match=r"radius 5e-05 m cannot turn by 2[12]000 rad/m"):
            replace(ROD, **changes)


@pytest.mark.parametrize("curvature", [200.0, 1000.0, 5000.0])
def test_links_that_wind_up_the_rest_shape_are_refused_with_a_number_that_does(curvature):
    coil = replace(ROD, bends=((0.0, curvature, 0.0), (0.03, curvature, 0.0)))
    least = int(0.03 * curvature / 1.5) + 1
    with pytest.raises(UsageError, match=f"too few .* turns by up to {curvature:g} rad/m at rest.*choose {least} or"):
        build_chain(coil, least - 2)
    chain = build_chain(coil, least)
    assert np.abs(chain.rest_angles).max() < 1.6


def test_tables_with_torsion_belong_to_one_side():
    rods = {"curvature": 0.0, "arc_length": 0.03, "bends": HELIX.bends}
    both = WhiskerArray.of("rat", side="both", whiskers="C2")
    for changes in (rods, {"position": (0.01, 0.0, 0.0)}):
        with pytest.raises(UsageError, match=r"'C2' names whiskers of both; name each side, as in RC2 and LC2"):
            both.replace("C2", **changes)
    turned = both.replace("RC2", **rods)
    mirrored = turned.replace("LC2", **rods | {"bends": turned["RC2"].mirrored().whisker.bends})
    assert mirrored["LC2"].whisker == mirrored["RC2"].mirrored().whisker
    plane = both.replace("C2", **rods | {"bends": ESS.bends})
    assert plane["LC2"].whisker == plane["RC2"].whisker


@SHAPES
def test_links_lead_from_joint_to_joint(whisker):
    chain, frame, point = build_chain(whisker, 20), np.eye(3), np.zeros(3)
    for turn, length, end in zip(chain.rest_turns, chain.lengths, chain.points[1:], strict=True):
        frame = frame @ turn
        point = point + frame[:, 0] * length
        np.testing.assert_allclose(point, end, atol=1e-12)


@ENGINES
@SHAPES
def test_without_load_a_whisker_keeps_its_shape(whisker, backend):
    trace = run(whisker, backend=backend, times=(0.1,), loads=(Load(0.03, (0.0, 0.0, 1e-15)),))
    nodes = np.linspace(0, 0.03, 25)
    np.testing.assert_allclose(trace.link_positions[0], whisker.rest_points(nodes), atol=2e-8)
    assert np.abs(trace.wrench[0]).max() < 1e-12


@ENGINES
@SHAPES
@pytest.mark.parametrize("force", [(0.0, 4e-6, 0.0), (2e-6, -1e-6, 3e-6)])
def test_stiffness_is_that_of_a_kirchhoff_rod(whisker, backend, force):
    arc = 0.024
    loaded = run(whisker, backend=backend, loads=(Load(arc, force),))
    rod, exact = _equilibrium(whisker, arc, force)
    unbent = whisker.rest_points([arc])[0]

    scale = np.abs(exact.wrench).reshape(2, 3).max(axis=1).repeat(3)
    np.testing.assert_array_less(np.abs(loaded.wrench[0] - exact.wrench), 0.01 * scale + 1e-12)
    # Joint 19 of 24 links lies a little before the load; all of them on the loaded rod.
    arcs = np.linspace(0, 0.03, 25)[:20]
    points, _, _ = rod_paths(rod, exact.force, exact.moment, np.append(arcs, arc))
    bend = np.linalg.norm(points[-1] - unbent)
    assert bend > 5e-4
    assert np.linalg.norm(loaded.link_positions[0, :20] - points[:20], axis=1).max() < 0.02 * bend


def test_weight_of_a_helix_lies_on_its_base():
    trace = run(HELIX, gravity=(0.0, 0.0, -9.81))
    chain = build_chain(HELIX, 24)
    assert trace.wrench[0, 2] == pytest.approx(-9.81 * HELIX.mass, rel=1e-4)
    assert trace.wrench[0, 4] == pytest.approx(
        9.81 * chain.masses @ (chain.points[:-1] + chain.points[1:])[:, 0] / 2, rel=0.02
    )


def test_moments_of_a_plane_s_are_those_of_its_load():
    for whisker in (ESS, HELIX):
        job = Job(whisker, StillFollicle(), (), np.array([0.3]), loads=(Load(0.03, (0.0, 1e-6, 0.0)),))
        (trace,) = get_engine("rod").run([job], FINE, record_shape=True)
        moments = bending_moments(job, trace.link_positions)[0]
        if whisker is HELIX:  # its twist cannot be told from its joints
            assert np.isnan(moments).all()
            continue
        levers = trace.link_positions[0, -1, 0] - trace.link_positions[0, :-1, 0]
        np.testing.assert_allclose(moments[2:18], 1e-6 * levers[2:18], rtol=0.05)


def test_left_whisker_is_the_mirror_image():
    right = WhiskerArray.mouse(whiskers="C2")
    length = right["C2"].whisker.arc_length
    right = right.replace("C2", curvature=0.0, bends=((0.0, 60.0, 40.0), (length, -40.0, 90.0)))
    both, s = right.on_side("both"), np.linspace(0, length, 9)
    ends = []
    for mount in both:
        still = StillFollicle(mount.position, mount.angles)
        job = Job(mount.whisker, still, (), np.array([0.1]), gravity=(0.0, 0.0, -9.81))
        (trace,) = get_engine("rod").run([job], FINE, record_shape=True)
        ends.append((trace.link_positions[0], trace.wrench[0]))
    mirror = np.array([-1, 1, 1])
    assert both.mounts[1].whisker.rest_points(s)[:, 2] == pytest.approx(-both.mounts[0].whisker.rest_points(s)[:, 2])
    np.testing.assert_allclose(ends[1][0], ends[0][0] * mirror, atol=1e-9)
    np.testing.assert_allclose(ends[1][1], ends[0][1] * [-1, 1, 1, 1, -1, -1], atol=1e-12)


FILE = """
[array]
whiskers = "C2"
[array.replace.C2]
curvature = 0
bends = [[0, 60, 0], [0.015265, -60, 80]]
[whisking]
kind = "still"
[frames]
count = 2
[[scene]]
label = "alone"
"""


def test_scene_files_hold_bends(tmp_path):
    path = tmp_path / "bent.toml"
    path.write_text(FILE)
    (scene,) = load_scene(path).scenes
    recording = record(scene, [0.0, 0.01], fidelity="fast", cache=False)
    np.testing.assert_allclose(recording.joints[0][1], recording.unbent(0, 1), atol=1e-9)


@pytest.mark.parametrize(
    ("bends", "words"),
    [
        (((0, 1, 0), (0.02, 1, 0), (0.01, 1, 0), (0.03, 1, 0)), "ascend from 0 to that of the whisker, 0.03"),
        (((0.01, 1, 0), (0.03, 1, 0)), "ascend from 0"),
        (((0, 1, 0), (0.03, float("nan"), 0)), "bends of a whisker"),
        (((0, 1), (0.03, 1)), "bends of a whisker"),
    ],
)
def test_tables_that_are_no_shape_are_refused(bends, words):
    with pytest.raises(UsageError, match=words):
        replace(ROD, bends=bends)


def test_two_rest_shapes_are_one_too_many():
    with pytest.raises(UsageError, match="by its curvature or by its table of bends, not both"):
        replace(HELIX, curvature=3.0)


def test_what_knows_parabolas_alone_says_so():
    with pytest.raises(UsageError, match="'bullet' rest as parabolas; leave bends out, or use the backend 'rod'"):
        run(HELIX, backend="bullet")
    with pytest.raises(UsageError, match="no bends"):
        GradientRun(lambda values: [Job(HELIX, StillFollicle(), (), np.array([0.1]))], [1.0])
    shapes = new_shapes(np.arange(3.0), np.linspace(0, 0.02, 5)[:, None] * np.ones((3, 1, 2)))
    with pytest.raises(UsageError, match="rest shape is y = A x²"):
        find_contacts(shapes, HELIX)
