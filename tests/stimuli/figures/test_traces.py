import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.figures import traces as module
from brainbench.stimuli.figures.traces import plot
from brainbench.stimuli.objects.solid import PlacedObject, sphere
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engines import FakeEngine

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
        ({"out": "a"}, "has no ending"),
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
