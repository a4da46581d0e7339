"""The world of PyBullet: distances, inertia, limits."""

import math
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from brainbench.core.errors import MissingDependencyError, UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.bullet import model
from brainbench.stimuli.engines.bullet.model import FOLLICLE, MOST_LINKS, BulletWorld
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere
from brainbench.stimuli.whiskers.chain import build_chain
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.whiskers import C2

needs_bullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="PyBullet is made for Python below 3.12")
COARSE = Fidelity(links=8, time_step=2e-4)


def _run(*jobs, fidelity=COARSE, backend="bullet", **options):
    return get_engine(backend).run(jobs, fidelity, **options)


def test_without_pybullet_the_error_names_the_extra_or_the_python(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingDependencyError, match=r"\[bullet\]"):
        model.engine()
    monkeypatch.setattr(sys, "version_info", (3, 12, 0, "final", 0))
    with pytest.raises(MissingDependencyError, match=r"'bullet' .*3\.12.*'mujoco'"):
        _run(Job(C2, StillFollicle(), (), np.array([0.01])))


@needs_bullet
@pytest.mark.parametrize(
    "part",
    [
        Capsule((0.0, 0.0, -0.002), (0.0, 0.0, 0.002), 1e-3),
        Cylinder((0.0, 0.0, 0.002), (0.0, 0.0, -0.002), 1e-3),
        Cylinder((-0.002, 0.0, 0.0), (0.002, 0.0, 0.0), 1e-3),
        Sphere((0.0, 0.0, 0.0), 1e-3),
        Box((0.0, 0.0, 0.0), (2e-3, 3e-3, 1e-3), (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)),
        ConvexPart(np.array([[x, y, z] for x in (-2e-3, 2e-3) for y in (-1e-3, 1e-3) for z in (-1e-3, 1e-3)])),
    ],
)
@pytest.mark.parametrize("gap", [0.01, -0.003])
def test_distances_to_every_shape_are_those_of_geometry(part, gap):
    cylinder = Whisker(0.01, 50e-6, 50e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.3)
    with BulletWorld(build_chain(cylinder, 2), [Obstacle((part,))], 0.0, np.zeros(3)) as world:
        # The second link runs from 5 to 10 mm along x; all parts reach 1 mm from their centre along y.
        world.place([0.0] * (FOLLICLE + 4))
        world.place_obstacle(0, np.array([7.5, -1.05 - gap, 0.0]), np.array([1.0, 0, 0, 0]))
        (link, obstacle, point, normal, distance), *_ = world.closest(0.1)
    assert (link, obstacle) == (1, 0)
    assert distance == pytest.approx(gap, abs=1e-6)
    np.testing.assert_allclose(normal, [0, 1, 0], atol=1e-5)
    assert point[1] == pytest.approx(-0.05, abs=1e-6)


@needs_bullet
def test_the_joint_space_inertia_is_that_of_the_chain():
    chain = build_chain(C2, 7)
    with BulletWorld(chain, [], math.inf, np.zeros(3)) as world:
        hinges = world.mass_matrix([0.0] * (FOLLICLE + 14))[FOLLICLE:, FOLLICLE:]
    # Bullet's unit is mg·mm² = 1e-12 kg·m²; about z the chain states its own.
    np.testing.assert_allclose(hinges[1::2, 1::2] * 1e-12, chain._planar_mass(), rtol=1e-5)


@needs_bullet
def test_more_links_than_pybullet_moves_are_refused():
    job = Job(C2, StillFollicle(), (), np.array([0.01]), gravity=(0.0, 0.0, -9.81))
    assert _run(job, fidelity=Fidelity(links=MOST_LINKS, time_step=1e-3))[0].status == "ok"
    with pytest.raises(UsageError, match=r"60 links .*received 61"):
        _run(job, fidelity=Fidelity(links=MOST_LINKS + 1, time_step=1e-3))
    with pytest.raises(UsageError, match=r"workers .*received 0"):
        _run(job, workers=0)
