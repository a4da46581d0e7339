"""Contacts on the centre line of the bent rod, beside elastica and beside the straight links."""

import dataclasses

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere
from tests.factories.contact_scenes import HARD_OBJECTS, contact_jobs, difference, held_job, meshed, sliding_job
from tests.factories.engine_scenes import C2
from tests.factories.gradients import touching_job
from tests.factories.rod_chain import in_double

wp = pytest.importorskip("warp")

ELASTICA = np.array([-0.022566, -0.085888])
"""Force (mN) on the base of the whisker that two posts hold, by shooting: each post pushes along its normal at one arc
length of a tapered rod without extension, clamped along x; unknown are forces, directions, arc lengths and moment."""


def _held(fidelity, *, backend="rod", about_x=0.0, **how):
    """The last reading's force (mN) of a whisker between two posts, turned back about x."""
    job = held_job(about_x=about_x, **how)
    trace = get_engine(backend).run([job], Fidelity.parse(fidelity), workers=1)[0]
    assert trace.status == "ok"
    return trace.wrench[-1, :3] @ euler_matrix((about_x, 0.0, 0.0)) * 1e3


def _miss(fidelity, **how):
    return np.linalg.norm(_held(fidelity, **how)[:2] - ELASTICA) / np.linalg.norm(ELASTICA)


@pytest.mark.parametrize(
    ("preset", "most", "straight"), [("fast", 0.02, 0.4), ("balanced", 0.005, 0.2), ("accurate", 0.002, 0.04)]
)
def test_a_whisker_between_opposed_posts_is_the_elastica(preset, most, straight):
    assert _miss(preset) < most
    # The control: straight links push along normals that are off by half a bend.
    assert _miss(f"{preset},contact_line=links") > straight


@pytest.mark.parametrize(
    "shape",
    [Sphere((0, 0, 0), 1e-4), Cylinder((0, 0, -4e-3), (0, 0, 4e-3), 1e-4), Box((0, 0, 0), (1e-4, 1e-4, 4e-3))],
)
def test_primitives_touch_the_rod(shape):
    assert (_held("fast", shape=shape) == _held("fast,contact_line=rod", shape=shape)).all()
    assert (_held("fast", shape=shape) != _held("fast,contact_line=links", shape=shape))[:2].all()


def test_the_error_falls_with_the_links_and_does_not_depend_on_where_joints_fall():
    misses = [_miss(f"accurate,links={links}") for links in (14, 20, 40, 60)]
    assert (np.diff(misses) < 0).all()
    forces = [_held(f"accurate,links={links}") for links in (59, 60, 61)]
    assert np.ptp(forces, axis=0).max() < 0.005 * np.linalg.norm(ELASTICA)
    straight = [_held(f"accurate,links={links},contact_line=links") for links in (59, 60, 61)]
    assert np.ptp(straight, axis=0).max() > 0.05 * np.linalg.norm(ELASTICA)


@pytest.mark.parametrize("links", [14, 15, 16])
def test_two_contacts_of_one_link_stay_apart(links):
    """With 15 links of 2.2 mm both posts, 2 mm apart, press on one of them."""
    assert _miss(f"balanced,links={links}") < 0.015


def test_edges_of_boxes_press_as_they_do_with_many_links():
    fine, coarse = (
        _held(f"{fidelity},contact_line=rod", shape=Box((0, 0, 0), (1e-4, 1e-4, 4e-3)))
        for fidelity in ("accurate,links=60", "accurate")
    )
    assert np.linalg.norm(coarse - fine) < 0.01 * np.linalg.norm(fine)


@pytest.mark.parametrize("line", ["rod", "links"])
def test_opposed_contacts_press_together_in_short_steps(line):
    """The one that only the other's force presses on must not wait for a step: each would be thrown off in turn."""
    job = contact_jobs(20, each=1, objects=HARD_OBJECTS)[16]
    job = dataclasses.replace(job, times=job.times[:40])
    setting = f"accurate,steps_per_period=none,contact_line={line}"
    long, short = (
        get_engine("rod").run([job], Fidelity.parse(f"{setting},time_step={step}"), workers=1)[0]
        for step in (5e-5, 1e-5)
    )
    assert difference(short, long) < 0.002
    assert short.penetration < 1e-6


def test_a_plane_of_bending_is_like_any_other():
    upright = _held("balanced")
    np.testing.assert_allclose(_held("balanced", about_x=0.9), upright, atol=2e-3 * 0.09)


def _slide(fidelity, job=None):
    """Ripple of Fx, peak to peak, under a post that slides along the pressed whisker at constant depth."""
    trace = get_engine("rod").run([job or sliding_job()], Fidelity.parse(fidelity), workers=1)[0]
    # The last readings stand apart: the post stops.
    force, t = trace.wrench[90:450, 0], np.linspace(-1, 1, 360)
    return np.ptp(force - np.polyval(np.polyfit(t, force, 6), t)) / np.abs(force).mean()


def test_a_sliding_post_makes_no_sawtooth():
    assert _slide("balanced") < 0.003 < 0.04 < _slide("balanced,contact_line=links")


def test_slip_reverses_when_that_of_many_links_does():
    """Its speed is a small difference of large ones there: a tenth of a ms is a large part of one reading."""
    job = contact_jobs(11, each=1, objects=("post",))[1]
    job = dataclasses.replace(job, times=job.times[:34])
    steps = "balanced,time_step=2e-5,steps_per_period=400"
    fine, bent, straight = (
        get_engine("rod").run([job], Fidelity.parse(f"{steps},links={links},contact_line={line}"), workers=1)[0]
        for links, line in ((50, "rod"), (11, "rod"), (11, "links"))
    )
    assert difference(bent, fine) < 0.02
    assert difference(straight, fine) > 0.03


def test_other_backends_take_straight_links():
    with pytest.raises(UsageError, match="'mujoco' touch with straight links; leave contact_line out"):
        _held("balanced,contact_line=rod", backend="mujoco")


def _prism(corners, radius=1e-4):
    angles = np.arange(corners) * 2 * np.pi / corners
    return ConvexPart(np.array([[radius * np.cos(a), radius * np.sin(a), z] for z in (-4e-3, 4e-3) for a in angles]))


@pytest.mark.parametrize(("preset", "most"), [("fast", 0.02), ("balanced", 0.006), ("accurate", 0.002)])
def test_posts_of_triangles_press_as_round_ones(preset, most):
    mesh = _prism(32)
    assert _miss(preset, shape=mesh) < most < 0.06 < _miss(f"{preset},contact_line=links", shape=mesh)


def test_a_sliding_post_of_triangles_makes_no_sawtooth():
    """Edges pass the joints: what slides past one there comes no nearer to it."""
    job = sliding_job()
    (post,) = job.obstacles
    job = dataclasses.replace(job, obstacles=(dataclasses.replace(post, parts=(_prism(32, radius=3e-4),)),))
    assert _slide("balanced", job) < 0.005 < 0.06 < _slide("balanced,contact_line=links", job)


@pytest.mark.parametrize("kind", ["edge", "slot"])
def test_boxes_of_triangles_press_as_boxes_do(kind):
    """In single precision whiskers that lie flush are sensitive to everything."""
    jobs = contact_jobs(11, each=1, objects=(kind,))[:6]
    fidelity = Fidelity.parse("balanced,precision=double")
    boxes, meshes = (get_engine("rod").run(some, fidelity, workers=1) for some in (jobs, meshed(jobs, kind)))
    assert [trace.status for trace in meshes] == [trace.status for trace in boxes]
    gaps = [difference(mesh, box) for mesh, box in zip(meshes, boxes, strict=True) if box.status == "ok"]
    assert len(gaps) >= 5
    assert max(gaps) < 2e-3


def test_a_contact_at_a_joint_is_on_the_link_behind_it_however_its_arc_is_rounded():
    place_of = in_double("centre_line").place_of

    @wp.kernel(enable_backward=False, module="unique")
    def place(shares: wp.array(dtype=wp.float64)):
        i = wp.tid()
        shares[i] = place_of(shares[i])

    given = [1 - 1e-12, 1 + 1e-12, -1e-12, 0.3, 1 - 1e-4]
    shares = wp.array(given, dtype=wp.float64, device="cpu")
    wp.launch(place, len(given), [shares], device="cpu")
    assert shares.numpy().tolist() == [1, 1, 0, 0.3, 1 - 1e-4]


def _struck(shape, speed, settings, times):
    """A whisker that an object strikes from the side and sweeps past."""

    def motion(times):
        places = np.array([0.012, -3e-3, 0.0]) + np.outer(times, [0.0, speed, 0.0])
        return places, np.tile([1.0, 0, 0, 0], (len(times), 1))

    job = Job(C2, StillFollicle(), (Obstacle((shape,), motion, 0.4),), times)
    setting = f"balanced,precision=double,contact_tolerance=1e-8,{settings}"
    return get_engine("rod", retry=1).run([job], Fidelity.parse(setting), workers=1)[0]


FACE = Box((0, 0, 0), (2e-3, 1e-3, 5e-3))
"""A whisker that it strikes lies flush on its face, over one or two links, and bends around its edges."""
WIDE = Box((0, 0, 0), (6e-3, 1e-3, 5e-3))


def _flush(fidelity, friction, middle=11e-3, half=3e-3):
    """A whisker pressed flat onto a face, and its forces off their course, a polynomial, as a share of their mean."""
    job = touching_job(Box((middle, 3.2e-3, 0.3e-3), (half, 1e-3, 8e-3)), friction=friction)
    job = dataclasses.replace(job, times=np.arange(1, 601) * 5e-5)
    trace = get_engine("rod", errors=True).run([job], Fidelity.parse(fidelity), workers=1)[0]
    force, time = trace.wrench[300:, 1], np.linspace(-1, 1, 300)
    if trace.status != "ok":
        return trace, np.inf
    return trace, (force - np.polyval(np.polyfit(time, force, 8), time)).std() / np.abs(force).mean()


@pytest.mark.parametrize(("preset", "most"), [("fast", 0.04), ("balanced", 0.02), ("accurate", 0.01)])
@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_a_whisker_flush_on_a_face_swings_little(preset, most, friction):
    straight, bent = (_flush(f"{preset},contact_line={line}", friction)[1] for line in ("links", "rod"))
    assert straight < bent < most


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("step", [5e-6, 1e-5, 2e-5])
def test_flush_whiskers_of_few_links_in_short_steps_say_that_they_swing(step, friction):
    setting = f"fast,links=8,links_per_mm=none,steps_per_period=none,time_step={step}"
    told = [_flush(setting, friction, *place) for place in ((11e-3, 3e-3), (1e-2, 3e-3), (11e-3, 1.5e-3))]
    assert max(swing for _, swing in told) > 0.01
    for trace, swing in told:
        assert trace.status == "unstable" or trace.error > swing
        assert trace.status == "unstable" or trace.remark or swing < 0.05


@pytest.mark.parametrize(
    ("shape", "speed", "most"),
    [
        (Capsule((0, 0, -5e-3), (0, 0, 5e-3), 1e-3), 1.2, 0.01),
        (Sphere((0, 0, 0), 2e-3), 1.2, 0.01),
        (Cylinder((0, 0, -5e-3), (0, 0, 5e-3), 5e-4), 1.2, 0.01),
        (FACE, 0.2, 0.015),
        (FACE, 1.2, 0.02),
        (WIDE, 0.2, 0.015),
        (WIDE, 0.8, 0.02),
        (WIDE, 1.2, 0.02),
    ],
)
def test_blows_converge_with_the_step(shape, speed, most):
    times = np.arange(1, 31) * (0.03 * min(1.2 / speed, 2) / 30)
    coarse, fine = (_struck(shape, speed, f"time_step={step}", times) for step in (1e-5, 1e-6))
    assert difference(coarse, fine) < most
