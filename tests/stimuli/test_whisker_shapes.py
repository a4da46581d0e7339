import dataclasses
import logging
import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation, euler_matrix
from brainbench.stimuli import simulation
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.mujoco import MujocoWhiskerEngine
from brainbench.stimuli.motion.trajectories import Still, Translation, Whisking
from brainbench.stimuli.scenes.scene import Animal, Frames, Head, Scene
from brainbench.stimuli.simulation import record, simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engine_scenes import pushed_bar
from tests.factories.engines import FakeEngine

FAST = Fidelity.preset("fast")
ARRAY = WhiskerArray.mouse(whiskers="C1,D4")


def _record(scene, times, **options):
    return record(scene, times, **{"fidelity": FAST, "cache": False, **options})


def test_a_whisker_at_rest_has_its_published_shape():
    shown = _record(Scene("rest", ARRAY, whisking=Still()), [0.0, 0.01])
    for mount, joints, moments in zip(ARRAY, shown.joints, shown.moments, strict=True):
        arcs = np.linspace(0, mount.whisker.arc_length, FAST.links + 1)
        local = np.column_stack([mount.whisker.centre_line(arcs), np.zeros(len(arcs))])
        expected = local @ base_rotation(np.array(mount.angles)).T + mount.position
        np.testing.assert_allclose(joints[0], expected, atol=1e-7)
        np.testing.assert_allclose(joints[1], joints[0], atol=1e-12)
        assert moments.max() < 1e-12


def test_the_moment_at_the_base_is_the_moment_the_follicle_feels():
    scene = dataclasses.replace(pushed_bar(), frames=Frames(0.3, 0.001, 1))
    fidelity = Fidelity.preset("accurate")
    (moments,) = record(scene, [0.3], fidelity=fidelity, cache=False).moments
    wrench = simulate(scene, fidelity=fidelity, cache=False)["wrench"].values[0, 0, 0]
    assert moments[0, 0] == pytest.approx(np.linalg.norm(wrench[3:]), rel=0.01)
    # A point load bends in proportion to the distance from it, and not at all beyond it.
    arcs = np.linspace(0, 1, moments.shape[1]) * scene.array["C2"].whisker.arc_length
    inner = arcs < 4.5e-3
    np.testing.assert_allclose(moments[0, inner] / moments[0, 0], 1 - arcs[inner] / 6e-3, atol=0.04)
    assert moments[0, arcs > 7.5e-3].max() < 0.02 * moments[0, 0]


def test_turning_the_scene_turns_the_shapes():
    head = Head((0.01, -0.02, 0.03), (0.3, -0.5, 1.2))
    plain, turned = (_record(pushed_bar(pose), [0.05, 0.08]) for pose in (Head(), head))
    moved = plain.joints[0] @ euler_matrix(head.rotation).T + head.position
    np.testing.assert_allclose(turned.joints[0], moved, atol=2e-6)


def test_links_keep_their_lengths_while_the_whisker_bends():
    shown = _record(pushed_bar(), [0.0, 0.04, 0.08])
    lengths = np.linalg.norm(np.diff(shown.joints[0], axis=1), axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape), rtol=1e-6)
    assert np.ptp(shown.joints[0][:, -1], axis=0).max() > 1e-4


def test_shapes_come_from_the_cache_and_from_nowhere_else(monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    runs = []

    class Counted(MujocoWhiskerEngine):
        def run(self, jobs, *args, **options):
            runs.append(len(jobs))
            return super().run(jobs, *args, **options)

    monkeypatch.setattr(simulation, "get_engine", lambda name, **options: Counted())
    scene = Scene("air", ARRAY, whisking=Whisking())
    first = _record(scene, [0.002, 0.004], cache=True)
    second = _record(scene, [0.002, 0.004], cache=True)
    assert runs == [2]
    np.testing.assert_array_equal(first.joints[0], second.joints[0])
    _record(scene, [0.002, 0.005], cache=True)
    assert runs == [2, 2]
    for path in (tmp_path / "shapes").glob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    with caplog.at_level(logging.WARNING):
        again = _record(scene, [0.002, 0.004], cache=True)
    assert "damaged" in caplog.text
    np.testing.assert_array_equal(first.joints[0], again.joints[0])


def test_a_backend_without_shapes_is_refused_in_words():
    with pytest.raises(UsageError, match=r"'fake' .*'rod' or 'mujoco'"):
        _record(Scene("air", ARRAY), [0.01], backend=FakeEngine())


def test_times_must_increase():
    with pytest.raises(UsageError, match=r"frame times .*increasing"):
        _record(Scene("air", ARRAY), [0.02, 0.01])


def test_every_animal_is_drawn_where_it_stands():
    far = Animal("b", ARRAY, Still(), Head((0.05, 0.0, 0.0), (0.0, 0.0, math.pi)))
    scene = Scene("two", ARRAY, whisking=Still(), others=(far,))
    shown = _record(scene, [0.001])
    assert len(shown.joints) == len(scene.names) == 4
    turned = shown.joints[0] @ euler_matrix((0.0, 0.0, math.pi)).T + [0.05, 0.0, 0.0]
    np.testing.assert_allclose(shown.joints[2], turned, atol=1e-9)


def test_shapes_travel_with_the_head():
    head = Head(motion=Translation((0.1, 0.0, 0.0), 0.0))
    shown = _record(Scene("travelling", ARRAY, whisking=Still(), head=head), [0.0, 0.1])
    for joints in shown.joints:
        np.testing.assert_allclose(joints[1, 0] - joints[0, 0], [0.01, 0.0, 0.0], atol=1e-9)
        # In steady motion nothing bends any more.
        np.testing.assert_allclose(joints[1] - joints[0], np.tile([0.01, 0.0, 0.0], (len(joints[0]), 1)), atol=1e-5)
