from __future__ import annotations

import dataclasses
import math
import re
import sys

import numpy as np
import pytest

from brainbench.core.errors import MissingDependencyError, UsageError
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.figures import pictures as module
from brainbench.stimuli.figures.pictures import Picture, Style, film_times, plot, render, still_time
from brainbench.stimuli.figures.surfaces import Camera
from brainbench.stimuli.motion.trajectories import Still, Translation, Whisking
from brainbench.stimuli.objects.solid import PlacedObject, box, cylinder, sphere
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import Recording, record, simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engines import FakeEngine

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


def _picture(scene, camera=ABOVE, style=SMALL, times=(0.0,)):
    return Picture(record(scene, times, fidelity=FAST, cache=False), camera, style)


def _grey(image):
    """Pixels with the hue of objects: bluish and not white."""
    red, green, blue = np.moveaxis(image.astype(int), -1, 0)
    return (red < 250) & (blue > red) & (np.abs(green - (red + blue) / 2) < 12)


def test_an_object_has_its_true_size_and_place_in_a_drawing_to_scale():
    image = _picture(SCENE).frame(0)
    assert image.shape == (240, 320, 3)
    y, x = np.nonzero(_grey(image))
    assert len(x) * 1e-8 == pytest.approx(math.pi * 1.5e-3**2, rel=0.05)
    # 0.1 mm a pixel; the pole stands 2 mm right of the middle and 3 mm rostral of it.
    assert x.mean() == pytest.approx(160 + 20, abs=1)
    assert y.mean() == pytest.approx(120 - 30, abs=1)


def test_a_moving_object_moves_in_the_picture():
    moving = dataclasses.replace(POLE, motion=Translation((0.0, -0.1, 0.0), 0.0))
    picture = _picture(dataclasses.replace(SCENE, objects=(moving,)), times=(0.0, 0.02))
    rows = [np.nonzero(_grey(picture.frame(index)))[0].mean() for index in (0, 1)]
    assert rows[1] - rows[0] == pytest.approx(20, abs=1)


def _count_coloured(image):
    return int((np.ptp(image.astype(int), axis=-1) > 35).sum())


def test_whiskers_vanish_behind_objects_and_shine_through_them_when_asked():
    plate = box((0.06, 0.06, 1e-3))
    seen = [_count_coloured(_picture(dataclasses.replace(SCENE, objects=())).frame(0))]
    for height, opacity in ((-0.02, 1.0), (0.03, 1.0), (0.03, 0.4)):
        scene = dataclasses.replace(SCENE, objects=(PlacedObject(plate, (0.0, 0.0, height)),))
        seen.append(_count_coloured(_picture(scene, style=dataclasses.replace(SMALL, opacity=opacity)).frame(0)))
    alone, before, behind, through = seen
    assert alone > 200
    assert before == pytest.approx(alone, rel=0.2)
    assert behind == 0
    assert through > 0.5 * alone


def test_thicker_whiskers_cover_more():
    covered = [
        _count_coloured(_picture(SCENE, style=dataclasses.replace(SMALL, thickness=thickness)).frame(0))
        for thickness in (1.0, 4.0)
    ]
    assert covered[1] > 1.5 * covered[0]


def test_a_picture_is_written_whole_and_the_same_every_time(tmp_path):
    from PIL import Image

    written = [render(SCENE, tmp_path / name, style=SMALL, fidelity="fast", cache=False) for name in ("a.png", "b.png")]
    first, second = (path.read_bytes() for path in written)
    assert first == second
    with Image.open(written[0]) as image:
        assert image.size == (320, 240)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_a_gif_has_a_frame_per_instant_and_repeats(tmp_path):
    from PIL import Image

    moving = dataclasses.replace(POLE, motion=Translation((0.0, -0.1, 0.0), 0.0))
    scene = dataclasses.replace(SCENE, objects=(moving,))
    style = dataclasses.replace(SMALL, frames_per_second=20.0)
    calls = []
    path = render(
        scene,
        tmp_path / "film.gif",
        times=[0.0, 0.01, 0.02],
        camera=ABOVE,
        style=style,
        fidelity="fast",
        cache=False,
        progress=lambda *call: calls.append(call),
    )
    with Image.open(path) as film:
        assert (film.n_frames, film.size, film.info["loop"], film.info["duration"]) == (3, (320, 240), 0, 50)
        rows = []
        for index in range(3):
            film.seek(index)
            rows.append(np.nonzero(_grey(np.asarray(film.convert("RGB"))))[0].mean())
    assert rows[0] < rows[1] < rows[2]
    assert calls[-1] == (3, 3, "drawing frames")


def test_an_mp4_has_a_frame_per_instant(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path = render(SCENE, tmp_path / "film.mp4", times=[0.0, 0.01, 0.02], style=SMALL, fidelity="fast", cache=False)
    frames = ffmpeg.read_frames(str(path))
    told = next(frames)
    frames.close()
    assert (told["size"], told["fps"], ffmpeg.count_frames_and_secs(str(path))[0]) == ((320, 240), 25.0, 3)


@pytest.mark.parametrize(("package", "name"), [("matplotlib", "a.png"), ("imageio_ffmpeg", "a.mp4")])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, package, name):
    monkeypatch.setitem(sys.modules, package, None)
    backend = FakeEngine()
    with pytest.raises(MissingDependencyError, match=r"\[report\]"):
        render(SCENE, tmp_path / name, times=[0.0], style=SMALL, backend=backend)
    assert not backend.jobs
    assert not list(tmp_path.iterdir())


def test_the_telling_instant_of_a_scene_is_its_first_full_protraction():
    assert still_time(get_recipe("rodgers").scenes[0]) == pytest.approx(0.075)
    slow = dataclasses.replace(SCENE, whisking=Whisking(frequency=8.0, onset=0.0), frames=Frames(0.0, 0.01, 20))
    assert still_time(slow) == pytest.approx(1 / 16)
    assert still_time(SCENE) == pytest.approx(0.045)


def test_a_film_runs_from_start_to_stop():
    np.testing.assert_allclose(film_times(SCENE, 0.01, 0.03, 0.005), [0.01, 0.015, 0.02, 0.025, 0.03])
    assert film_times(SCENE)[-1] == pytest.approx(0.09)
    with pytest.raises(UsageError, match=r"received 0\.05 s to 0\.01 s"):
        film_times(SCENE, 0.05, 0.01)
    with pytest.raises(UsageError, match="at most 10,000"):
        film_times(SCENE, 0.0, 1.0, 1e-6)


@pytest.mark.parametrize(
    ("name", "times", "message"),
    [
        ("a.jpg", None, "did you mean '.png'"),
        ("a.png", [0.0, 0.1], "shows one instant"),
        ("a.png", [1e6], r"ends at .* ms; received the instant 1e\+09 ms"),
        ("a.gif", [0.0, 1e6], r"ends at .* ms; received the instant 1e\+09 ms"),
    ],
)
def test_impossible_files_are_refused(tmp_path, name, times, message):
    with pytest.raises(UsageError, match=message):
        render(SCENE, tmp_path / name, times=times)


BALL = PlacedObject(sphere(3e-3), position=(0.015, 0.002, 0.003))


def _simulate(unstable=None, **changes):
    array = changes.pop("array", WhiskerArray.mouse())
    scenes = [Scene(label, array, (BALL,), frames=Frames(0.0, 0.005, 20)) for label in ("one", "two/three")]
    return simulate(scenes, fidelity=Fidelity(), backend=FakeEngine(unstable=unstable))


@pytest.fixture(scope="module")
def dataset():
    return _simulate()


@pytest.fixture(scope="module")
def few():
    return _simulate(array=WhiskerArray.mouse(whiskers="C1,C2"))


def _panels(figure):
    return [panel for panel in figure.axes if panel.axison]


def test_every_whisker_has_its_panel_on_the_grid_to_one_scale(dataset):
    figure = module._figure(dataset.isel(stimulus=0), "one", "Fxyz", (-40.0, 40.0), (800, 480))
    panels = _panels(figure)
    assert len(figure.axes) == 35
    assert len(panels) == 30
    names = [panel.texts[0].get_text() for panel in panels]
    assert names == [str(name) for name in dataset["whisker"].values]
    assert len({panel.get_ylim() for panel in panels}) == 1
    # Row A above row E, column 0 left of column 4.
    place = {name: panel.get_position() for name, panel in zip(names, panels, strict=True)}
    assert place["A0"].y0 > place["E0"].y1
    assert place["A0"].x1 < place["A4"].x0


def test_lines_are_the_channels_in_millinewtons_and_micronewton_metres(few):
    one = few.isel(stimulus=0)
    for channel, picked, factor in (("Fxyz", slice(0, 3), 1e3), ("My", slice(4, 5), 1e6)):
        (panel, *_) = _panels(module._figure(one, "one", channel, (-1.0, 1.0), (800, 480)))
        drawn = np.stack([line.get_ydata() for line in panel.lines[1:]], axis=-1)
        np.testing.assert_allclose(drawn, one["wrench"].values[:, 0, picked] * factor, rtol=1e-6)
        np.testing.assert_allclose(panel.lines[1].get_xdata(), one["time"].values * 1e3)
    (panel, *_) = _panels(module._figure(one, "one", "M", (0.0, 1.0), (800, 480)))
    np.testing.assert_allclose(
        panel.lines[1].get_ydata(), np.linalg.norm(one["wrench"].values[:, 0, 3:], axis=-1) * 1e6, rtol=1e-6
    )


def test_contacts_are_shaded_and_only_they(dataset):
    one = dataset.isel(stimulus=0)
    touched = one["contact"].values.any(axis=0)
    assert touched.any()
    assert not touched.all()
    panels = _panels(module._figure(one, "one", "F", (0.0, 1.0), (800, 480)))
    shaded = [any(len(item.get_paths()) for item in panel.collections) for panel in panels]
    np.testing.assert_array_equal(shaded, touched)


def test_unstable_whiskers_say_so():
    broken = _simulate(unstable={3: "energy grew"}, array=WhiskerArray.mouse(whiskers="A*"))
    panels = _panels(module._figure(broken.isel(stimulus=0), "one", "F", (0.0, 1.0), (800, 480)))
    said = [[text.get_text() for text in panel.texts][1:] for panel in panels]
    assert ["unstable" in texts for texts in said] == [False, False, False, True, False]
    assert [texts == ["no contact"] for texts in said] == [
        not touched and index != 3 for index, touched in enumerate(broken["contact"].values[0].any(axis=0))
    ]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_several_stimuli_make_a_file_each_with_equal_bytes_every_time(few, tmp_path, suffix):
    paths = plot(few, tmp_path / f"traces.{suffix}", size=(400, 240))
    assert [path.name for path in paths] == [f"traces-one.{suffix}", f"traces-two_three.{suffix}"]
    before = [path.read_bytes() for path in paths]
    assert [path.read_bytes() for path in plot(few, tmp_path / f"traces.{suffix}", size=(400, 240))] == before


def test_panels_fill_the_picture_whichever_whiskers_there_are(few):
    row = _simulate(array=WhiskerArray.mouse(whiskers="C1,C2"))
    figure = module._figure(row.isel(stimulus=0), "one", "F", (0.0, 1.0), (800, 480))
    boxes = [panel.get_position() for panel in figure.axes]
    assert len(boxes) == 2
    assert min(box.height for box in boxes) > 0.7
    assert sum(box.width for box in boxes) > 0.8


def test_one_stimulus_and_a_part_of_the_time_can_be_chosen(few, tmp_path):
    (path,) = plot(few, tmp_path / "one.png", stimulus="one", window=(0.02, 0.05), size=(400, 240))
    assert path == tmp_path / "one.png"
    with pytest.raises(UsageError, match=r"0\.021–0\.022 s"):
        plot(few, tmp_path / "none.png", window=(0.021, 0.022))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"channel": "Gx"}, "Unknown channel 'Gx'"),
        ({"stimulus": "on"}, "did you mean 'one'"),
        ({"out": "a.jpg"}, "Allowed: '.png', '.svg', '.pdf'"),
        ({"out": "a"}, "format of a picture .a.\\. Allowed"),
    ],
)
def test_wrong_requests_are_refused_in_words(dataset, tmp_path, options, message):
    out = tmp_path / options.pop("out", "a.png")
    with pytest.raises(UsageError, match=message):
        plot(dataset, out, **options)


def test_two_sides_do_not_share_a_panel(tmp_path):
    both = _simulate(array=WhiskerArray.mouse(side="both", whiskers="C2"))
    with pytest.raises(UsageError, match=r"two whiskers .*one side"):
        plot(both, tmp_path / "a.png")
