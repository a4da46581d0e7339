"""The tables of docs/unstable-whiskers.md, what is flagged and what is not: each row is simulated, or judged."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brainbench.geometry import Mesh
from brainbench.stimuli import get_recipe, simulate
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.trust import GAVE_WAY, LARGEST_OVERLAP, LARGEST_STRAIN, LOST, halved, judge
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle, Sphere
from tests.factories.contact_scenes import contact_jobs, difference
from tests.factories.engine_scenes import C2
from tests.factories.engines import facts

pytest.importorskip("warp")

PAGE = Path(__file__).parents[3] / "docs" / "unstable-whiskers.md"
TIMES = np.arange(1, 31) * 1e-3


def _reason(*obstacles, loads=(), step=2e-4, engine="rod", times=TIMES):
    job = Job(C2, StillFollicle(), obstacles, times, loads=loads)
    (trace,) = get_engine(engine).run([job], Fidelity(links=10, time_step=step))
    assert (trace.status == "ok") == (trace.reason == "") == np.isfinite(trace.wrench).all()
    return trace.reason


def _judged(**changed):
    return judge(facts(**changed)).reasons[0]


def _moving(start, velocity, part):
    def motion(times):
        return np.add(start, np.outer(times, velocity)), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return Obstacle((part,), motion, friction=0.0)


def _ball(overlap):
    """A ball beside the whisker, 8 mm from its base."""
    return Obstacle((Sphere((0.008, 0.005 + float(C2.radius(0.008)) - overlap, 0.0), 0.005),), friction=0.0)


def _rubbing():
    job = next(job for job in contact_jobs(5, each=1) if job.obstacles[0].friction == 0.8)
    (trace,) = get_engine("rod").run([job], Fidelity(links=10, time_step=2e-4))
    assert trace.unsolved > 0
    return trace.reason


def _peg(radius):
    return Capsule((0.0, 0.0, -0.02), (0.0, 0.0, 0.02), radius)


def _overlapping_boxes():
    """One closed mesh of two overlapping boxes: the whisker lies in the first, beside a face of the second."""
    import trimesh

    boxes = [((-0.05, -0.05, -0.05), (0.05, 0.05, 0.05)), ((-0.06, -0.06, 0.002), (0.06, 0.06, 0.06))]
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=some) for some in boxes])
    return Obstacle((), surface=Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)))


def _struck(speed, *, engine="mujoco", step=1e-4):
    """A box that passes the whisker with its flat face ahead."""
    box = _moving((0.009, -0.002, 0), (0, speed, 0), Box((0.0, 0.0, 0.0), (2e-3, 1e-3, 5e-3)))
    return _reason(box, step=step, engine=engine, times=TIMES / 10)


def _whisking():
    """A whisker that whisks over a flat face with friction, in soft contacts."""
    scene = get_recipe("rodgers").scenes[0].select("C1")
    return str(simulate(scene, fidelity="fast", backend="mujoco", cache=False)["reason"].values.item())


FLAGGED = {
    "starts in an object": ("starts 0.11 mm deep", lambda **some: _reason(_ball(1.1002e-4), **some)),
    "penetrates one too far": (
        "mm deep in an object at 0.0",
        lambda: _reason(_moving((C2.arc_length + 0.0055, 0, 0), (-0.1, 0, 0), Sphere((0, 0, 0), 0.005))),
    ),
    "has an object at its base": (
        "base point",
        lambda **some: _reason(_moving((0, -2e-3, 0), (0, 0.2, 0), _peg(2e-4)), **some),
    ),
    "carries too large a force": ("stretch", lambda: _reason(_moving((5e-4, -1e-3, 0), (0, 0.1, 0), _peg(1e-4)))),
    "has contacts that were not solved": ("missed by 6%", lambda: _judged(residual=0.06)),
    "has contacts without a solution": (
        "missed by 1000%",
        lambda: _reason(_moving((C2.arc_length + 0.0055, 0, 0), (-0.025, 0, 0), Sphere((0, 0, 0), 0.005))),
    ),
    "has too many contacts": ("more contacts", lambda: _judged(crowded=3)),
    "folds": ("bent by", lambda: _reason(loads=(Load(C2.arc_length, (0.0, 1.0, 0.0)),))),
    "has a follicle that gives way too far": ("follicle gave way", lambda: _judged(status=GAVE_WAY, failed=0.1)),
    "is not finite": ("finite", lambda: _judged(status=LOST, failed=0.1)),
    "meets an object that moves too fast": (
        "further than the 0.8 mm up to which contact is followed",
        lambda: _reason(_moving((0.008, -0.1, 0), (0, 3.0, 0), _peg(1e-3)), step=5e-3),
    ),
    "is struck": (
        "changes by 12%",
        lambda: halved(judge(facts(struck=True)), np.array([0.12]), np.array([True])).reasons[0],
    ),
    "is struck too hard": (
        "further than the 0.0121 mm up to which contact is followed; choose a smaller time step (at most 1/42 of it)",
        lambda: _struck(5.0, engine="rod"),
    ),
    "changes at half the step": (
        "changes by 30%",
        lambda: halved(judge(facts(depth=3e-4)), np.array([0.3]), np.array([True])).reasons[0],
    ),
    "loses friction": ("23% of the friction 0.48", _whisking),
}
"""Row of the table: words of the reason, and how it comes about."""

NOT_FLAGGED = {
    "starts in contact": lambda: _reason(_ball(1e-5)),
    "overlaps for a step": lambda: _judged(depth=0.9 * LARGEST_OVERLAP),
    "has an object behind its base": lambda: _reason(Obstacle((Sphere((-1.1e-3, 0.0, 0.0), 1e-3),))),
    "slides with contact forces that were not solved": _rubbing,
    "sticks or slips at another time, or is thrown off by soft contacts": lambda: str(
        judge(facts()).suspicious[0] or ""
    ),
    "lies in bodies that overlap": lambda: _reason(_overlapping_boxes()),
}


def _rows(title):
    """First cells of the table under a line of the page that begins with ``title``."""
    text = PAGE.read_text(encoding="utf-8")
    table = text.split(title, 1)[1].split("\n\n")[1]
    return [re.match(r"\| *(.*?) *\|", line)[1] for line in table.splitlines()[2:]]


def test_the_page_has_these_rows_and_no_others():
    assert _rows("**Flagged**") == list(FLAGGED)
    assert _rows("**Not flagged**") == list(NOT_FLAGGED)


@pytest.mark.parametrize("row", FLAGGED)
def test_what_the_page_calls_flagged_is_flagged(row):
    words, found = FLAGGED[row]
    assert words in found()


@pytest.mark.parametrize("row", NOT_FLAGGED)
def test_what_the_page_calls_not_flagged_is_not(row):
    assert NOT_FLAGGED[row]() == ""


@pytest.mark.parametrize("line", ["links", "rod"])
@pytest.mark.parametrize("links", [8, 20])
def test_nothing_that_presses_along_a_whisker_goes_through_its_tip_in_silence(line, links):
    """No step is short enough for it, so that finer ones must not hide it."""
    jobs = []
    for part in (Sphere((0, 0, 0), 0.005), Box((0, 0, 0), (0.005, 0.005, 0.005))):
        for speed, aside in ((0.01, 0.0), (0.1, 2e-3), (1.0, 0.0)):
            moving = _moving((C2.arc_length + 0.0055, aside, 0), (-speed, 0, 0), part)
            jobs.append(Job(C2, StillFollicle(), (moving,), np.arange(1, 31) * 2.5e-5 / speed))
    traces = get_engine("rod").run(jobs, Fidelity(links=links, time_step=2e-4, contact_line=line))
    silent = [t.penetration for t in traces if t.status == "ok" and not t.wrench.any()]
    assert max(silent, default=0.0) < 1.5e-5
    assert sum(trace.status == "unstable" for trace in traces) > 3


@pytest.mark.parametrize("engine", ["mujoco", "bullet"])
@pytest.mark.parametrize("row", ["starts in an object", "has an object at its base"])
def test_other_engines_share_these_rows(engine, row):
    if engine == "bullet":
        pytest.importorskip("pybullet")
    assert FLAGGED[row][0] in FLAGGED[row][1](engine=engine)


def test_the_blow_that_mujoco_cannot_follow_is_followed_by_rod_in_short_steps():
    assert _struck(5.0, engine="rod", step=2e-6) == ""


@pytest.mark.parametrize(
    ("speed", "place", "friction", "fidelity", "before"),
    [
        (1.2, 0.012, 0.4, "fast", 148),
        (2.8, 0.009, 0.0, "balanced", 0.42),
        (0.7, 0.0125, 0.4, "fast", 2.07),
        (0.35, 0.0135, 0.0, "balanced", 0.77),
    ],
)
def test_a_whisker_that_a_face_strikes_is_right_in_rod(speed, place, friction, fidelity, before):
    moving = _moving((place, -0.002, 0), (0, speed, 0), Box((0.0, 0.0, 0.0), (2e-3, 1e-3, 5e-3)))
    job = Job(C2, StillFollicle(), (replace(moving, friction=friction),), TIMES)
    # On the bent rod whole steps err by .11, .42, .64 and .25 here.
    preset = replace(Fidelity.preset(fidelity), contact_line="links")
    fine = replace(preset, time_step=2e-6, precision="double", contact_tolerance=1e-8)
    found, once, truth = (
        get_engine("rod", retry=retry).run([job], used)[0] for retry, used in ((5, preset), (1, preset), (1, fine))
    )
    assert found.status == once.status == "ok"
    assert difference(found, truth) < 0.15
    assert difference(once, truth) > 0.9 * before


def test_the_numbers_of_the_page_are_those_of_the_rule():
    text = PAGE.read_text(encoding="utf-8").split("**Flagged**")[1]
    for number in (f"{LARGEST_OVERLAP * 1e3:g}"[1:] + " mm", f"{LARGEST_STRAIN * 100:g} %"):
        assert number in text
