"""What engines share: names, devices, jobs that cannot be."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from brainbench.stimuli.engines import get_engine, list_engines
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import MICRO, MILLI, Job, Load, StillFollicle
from brainbench.stimuli.objects.obstacle import Obstacle, Sphere
from tests.factories.engine_scenes import C2


def test_force_is_mass_times_acceleration():
    mass, acceleration = 3e-7, 12.0
    in_milligrams, in_mm_per_ms2 = mass * MICRO, acceleration * MILLI / MILLI**2
    assert in_milligrams * in_mm_per_ms2 == pytest.approx(mass * acceleration * MILLI)


def test_torque_is_force_times_lever():
    force, lever = 2e-3, 0.04
    assert (force * MILLI) * (lever * MILLI) == pytest.approx(force * lever * MICRO)


COARSE = Fidelity(links=8, time_step=1e-4)
TIMES = np.linspace(0.0, 0.01, 11)
CORNERS = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]])
TETRAHEDRON = Mesh(CORNERS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32))


def _run(*jobs, fidelity=COARSE, **options):
    return get_engine("mujoco").run(jobs, fidelity, **options)


def test_unknown_backends_and_bad_jobs_are_refused():
    assert "mujoco" in list_engines()
    with pytest.raises(UsageError, match="did you mean 'mujoco'"):
        get_engine("mojoco")
    with pytest.raises(UsageError, match=r"frame times .*increasing"):
        Job(C2, StillFollicle(), (), np.array([0.2, 0.1]))
    with pytest.raises(UsageError, match=r"\(0 s\) .*\(0\.1 s\)"):
        Job(C2, StillFollicle(), (), np.array([0.0]), start=0.1)
    with pytest.raises(UsageError, match=r"arc of a load .*\(m\).*0\.015265.*received 0\.02"):
        Job(C2, StillFollicle(), (), np.array([0.1]), loads=(Load(0.02, (0, 0, 1e-6)),))
    with pytest.raises(UsageError, match=r"workers .*received 0"):
        _run(Job(C2, StillFollicle(), (), np.array([0.1])), workers=0)


def test_a_surface_without_parts_is_refused_in_words():
    parts = Obstacle((Sphere((0, 0, 0), 1e-3),), surface=TETRAHEDRON)
    get_engine("mujoco").check([Job(C2, StillFollicle(), (parts,), TIMES)], COARSE)
    bare = Obstacle((), surface=TETRAHEDRON)
    with pytest.raises(UsageError, match=r"'mujoco' .* 4 triangles.*'rod'"):
        get_engine("mujoco").check([Job(C2, StillFollicle(), (parts, bare), TIMES)], COARSE)


def test_an_engine_whose_whiskers_only_bend_refuses_twist():
    jobs = [Job(C2, StillFollicle(), (), TIMES)]
    engine = get_engine("bullet")
    engine.check(jobs, Fidelity())
    engine.check(jobs, Fidelity(twist=False))
    with pytest.raises(UsageError, match=r"'bullet'.*'rod'"):
        engine.check(jobs, Fidelity(twist=True))
