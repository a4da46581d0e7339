import dataclasses
import re

import numpy as np
import pytest

from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.figures import scenes as module
from brainbench.stimuli.figures.pictures import Picture, Style
from brainbench.stimuli.figures.scenes import render
from brainbench.stimuli.figures.surfaces import Camera
from brainbench.stimuli.motion.trajectories import Still
from brainbench.stimuli.objects.solid import PlacedObject, cylinder
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.whisker_shapes import Recording, record
from brainbench.stimuli.whiskers.array import WhiskerArray

FAST = Fidelity.preset("fast")


SMALL = Style(size=(320, 240))


ARRAY = WhiskerArray.mouse(whiskers="C1,C2")


POLE = PlacedObject(cylinder(1.5e-3, 8e-3), position=(0.012, 0.008, 0.003))


SCENE = Scene("pole", ARRAY, (POLE,), Still(), frames=Frames(0.0, 0.01, 10))


ABOVE = Camera("top", "orthographic", target=(0.01, 0.005, 0.0), width=0.032)


def test_moments_colour_the_whiskers():
    recording = record(SCENE, [0.0], fidelity=FAST, cache=False)
    loaded = tuple(np.linspace(2e-7, 0, item.shape[1])[None] for item in recording.moments)
    recording = Recording(recording.scene, recording.times, recording.joints, loaded)
    picture = Picture(recording, ABOVE, dataclasses.replace(SMALL, color="moment"))
    assert picture.moment_limit == pytest.approx(2e-7)
    image = picture.frame(0).astype(int)
    yellow = (image[..., 0] > 180) & (image[..., 1] > 130) & (image[..., 2] < 90)
    assert yellow.any()
    fixed = Picture(recording, ABOVE, dataclasses.replace(SMALL, color="moment", moment_limit=1e-5))
    image = fixed.frame(0).astype(int)
    assert not ((image[..., 0] > 180) & (image[..., 1] > 130) & (image[..., 2] < 90)).any()


def test_whiskers_of_unknown_shape_are_drawn_black_and_unbent_and_said_aloud(caplog, tmp_path, monkeypatch):
    recording = record(SCENE, [0.0], fidelity=FAST, cache=False)
    broken = (np.full_like(recording.joints[0], np.nan), recording.joints[1])
    recording = Recording(recording.scene, recording.times, broken, recording.moments)
    assert recording.unstable == ("C1",)
    monkeypatch.setattr(module, "record", lambda *args, **options: recording)
    render(SCENE, tmp_path / "a.png", times=[0.0], camera=ABOVE, style=SMALL)
    assert re.search("unstable .*'C1'", caplog.text)
    # Both still rest at t = 0, so the one whose shape is not known lies where it lay.
    whole = record(SCENE, [0.0], fidelity=FAST, cache=False)
    np.testing.assert_allclose(recording.unbent(0, 0), whole.joints[0][0], atol=1e-7)
    pictures = [Picture(some, ABOVE, SMALL) for some in (whole, recording)]
    known, unknown = (picture._whiskers(0, picture.lens) for picture in pictures)
    assert len(known.corners) == len(unknown.corners)
    assert unknown.colors.reshape(-1, 3).min(axis=1).min() < known.colors.reshape(-1, 3).max(axis=1).min()


def test_a_failed_picture_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    monkeypatch.setattr(Picture, "frame", lambda self, index: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        render(SCENE, path, style=SMALL, fidelity="fast", cache=False)
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1
