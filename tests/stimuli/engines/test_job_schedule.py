"""Which whiskers of some scenes are simulated: those that can touch something once each, the others once for all."""

from __future__ import annotations

from dataclasses import replace

from brainbench.stimuli import WhiskerArray
from brainbench.stimuli.engines.job_schedule import plan
from brainbench.stimuli.motion.trajectories import Whisking
from brainbench.stimuli.objects.obstacle import Sphere
from brainbench.stimuli.objects.solid import PlacedObject, Solid
from brainbench.stimuli.scenes.scene import Scene


def _make_scene(label, position):
    ball = PlacedObject(Solid("ball", (Sphere((0.0, 0.0, 0.0), 1e-3),)), position=position)
    return Scene(label, WhiskerArray.mouse(whiskers="C1,C2"), whisking=Whisking(), objects=(ball,))


def test_whiskers_that_reach_nothing_do_the_same_in_every_scene():
    scenes = [_make_scene(label, (1.0, 0.0, z)) for label, z in (("far", 0.0), ("farther", 1.0))]
    schedule = plan(scenes)
    assert len(schedule.jobs) == 2
    assert schedule.places[0] == schedule.places[1]
    assert not any(reach for row in schedule.reaches for reach in row)


def test_whiskers_of_another_motion_or_near_an_object_have_jobs_of_their_own():
    far = _make_scene("far", (1.0, 0.0, 0.0))
    faster = replace(far, whisking=Whisking(frequency=10.0))
    mount = far.mounts[1]
    near = _make_scene("near", tuple(float(x) for x in mount.position))
    schedule = plan([far, faster, near])
    assert len(set(schedule.places[0]) | set(schedule.places[1])) == 4
    assert schedule.places[2][1] not in schedule.places[0]
