"""Which whiskers stay in one plane, and that these are computed without twist."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.reach import reachable, stays_in_plane
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, Cylinder, Obstacle, Sphere
from tests.factories.engine_scenes import H

CURVED = replace(H, curvature=20.0)
TIMES = np.linspace(0, 0.02, 21)
IN_PLANE, ACROSS = (0.0, 1e-6, 0.0), (0.0, 0.0, 1e-6)


def _stays(whisker=CURVED, obstacles=(), follicle=None, **options):
    job = Job(whisker, follicle or StillFollicle(), obstacles, TIMES[1:], **options)
    position, euler = job.follicle.pose(TIMES)
    reach = reachable(whisker, position, job.obstacles, TIMES, surfaces=True)
    return stays_in_plane(job, reach, position, euler, TIMES)


def _load(*force):
    return Load(0.01, force)


def _moving(part, velocity):
    turn = [1.0, 0.0, 0.0, 0.0]
    return Obstacle((part,), lambda t: (np.outer(t, velocity), np.tile(turn, (len(t), 1))), friction=0.3)


class Turning:
    """A base that turns by one of its Euler angles."""

    def __init__(self, which):
        self.which = which

    def pose(self, times):
        """Return positions and Euler angles."""
        position, euler = StillFollicle().pose(times)
        euler[:, self.which] += 10 * times
        return position, euler


@pytest.mark.parametrize(
    ("options", "stays"),
    [
        ({}, True),
        ({"loads": (_load(*IN_PLANE),)}, True),
        ({"loads": (_load(*ACROSS),)}, False),
        ({"whisker": H, "loads": (_load(*ACROSS),)}, True),
        ({"whisker": H, "loads": (_load(*ACROSS), _load(0.0, 2e-6, 2e-6))}, False),
        ({"gravity": (0.0, -9.8, 0.0)}, True),
        ({"gravity": (0.0, 0.0, -9.8)}, False),
        ({"follicle": Turning(0)}, True),
        ({"follicle": Turning(1)}, False),
        ({"obstacles": (Obstacle((Capsule((0.01, -0.001, -0.01), (0.01, -0.001, 0.01), 1e-3),)),)}, True),
        ({"obstacles": (Obstacle((Capsule((0.01, -0.001, -0.01), (0.011, -0.001, 0.01), 1e-3),)),)}, False),
        ({"obstacles": (Obstacle((Capsule((0.01, -0.001, 0.0005), (0.01, -0.001, 0.01), 1e-3),)),)}, False),
        ({"obstacles": (Obstacle((Cylinder((0.01, 0.0, 0.0005), (0.01, 0.0, 0.01), 1e-3),)),)}, True),
        ({"obstacles": (Obstacle((Sphere((0.01, -0.001, 0.0), 1e-3),)),)}, True),
        ({"obstacles": (Obstacle((Sphere((0.01, -0.001, 1e-4), 1e-3),)),)}, False),
        ({"obstacles": (Obstacle((Box((0.01, -0.002, 0.0), (1e-3, 1e-3, 1e-3)),)),)}, False),
        ({"obstacles": (_moving(Sphere((0.01, -0.002, 0.0), 1e-3), (0.0, 0.05, 0.0)),)}, True),
        ({"obstacles": (_moving(Sphere((0.01, -0.002, 0.0), 1e-3), (0.0, 0.05, 0.05)),)}, False),
    ],
)
def test_a_whisker_stays_in_its_plane_when_everything_is_its_own_mirror_image(options, stays):
    assert _stays(**options) is stays


@pytest.mark.parametrize(("force", "same"), [(IN_PLANE, True), (ACROSS, False)])
def test_a_whisker_that_stays_in_its_plane_is_computed_without_twist(force, same):
    job = Job(CURVED, StillFollicle(), (), np.array([0.01, 0.02]), loads=(_load(*force),))
    fine = Fidelity.parse("balanced,precision=double")
    on, off = (RodEngine().run([job], replace(fine, twist=twist), workers=1)[0] for twist in (True, False))
    assert np.array_equal(on.wrench, off.wrench) is same
