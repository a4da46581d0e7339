"""Tracked whisking: a filmed whisker turns and moves in the scene as it did before the camera."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli import Fidelity, load_scene, simulate
from brainbench.stimuli.motion.tracked import PlayOptions, Tracked, load_angles, load_tracks
from brainbench.stimuli.motion.trajectories import ROTATIONS
from brainbench.stimuli.tracks.readers import TrackOptions
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.whisker_tracks import write_deeplabcut_csv, write_points, write_whiskerman, write_whiskers

RATE, SCALE = 500.0, 5e-5
TIMES = np.arange(200) / RATE
SWING = 0.3 * np.sin(2 * np.pi * 6 * TIMES)
"""Azimuth [rad] of a whisk of 6 Hz."""
ARRAY = WhiskerArray.mouse(side="both")
TRACK = TrackOptions(metres_per_pixel=SCALE, frame_rate=RATE)
EXACT = PlayOptions(lowpass=None)


def _filmed(*, turn=0.0, mirrored=False, sway=0.0, rise=None, angles=SWING):
    """Return points [frame, point, axis] (m) of a whisker that swings before a camera turned by ``turn`` (rad)."""
    reach = np.linspace(0, 0.015, 12)
    angle = (angles + turn)[:, None]
    points = np.stack([np.cos(angle) * reach, np.sin(angle) * reach], axis=-1)
    points[:, :, 1] += sway * np.sin(2 * np.pi * 6 * TIMES)[:, None]
    if mirrored:
        points[..., 0] *= -1
    if rise is not None:
        flat = np.cos(rise)[:, None, None] * points
        points = np.concatenate([flat, (np.sin(rise)[:, None] * reach)[..., None]], axis=-1)
    return points


def _played(path, points, options=EXACT, **whiskers):
    return load_tracks(write_points(path, points), whiskers or {"RC2": ""}, TRACK, options)


@pytest.mark.parametrize("turn", [0.0, 1.9, math.pi])
@pytest.mark.parametrize("name", ["RC2", "LC2"])
def test_a_tracked_whisker_turns_as_it_was_filmed_however_the_camera_was_turned(tmp_path, turn, name):
    tracked = _played(tmp_path / "a.csv", _filmed(turn=turn), **{name: ""})
    angles = tracked.angles(ARRAY[name], TIMES) - ARRAY[name].angles
    # Counter-clockwise seen from above is protraction on the right and retraction on the left.
    np.testing.assert_allclose(angles[:, 0], SWING - np.median(SWING), atol=1e-5)
    sense = 1 if name[0] == "R" else -1
    row = ROTATIONS["knutsen"].elevation[2], sense * ROTATIONS["knutsen"].torsion[2]
    np.testing.assert_allclose(angles[:, 1:], sense * angles[:, :1] * np.array(row), atol=1e-12)


def _write_deeplabcut(path, pixels):
    return write_deeplabcut_csv(path.with_suffix(".csv"), pixels, np.ones(pixels.shape[:2]))


def _write_whisk(path, pixels):
    return write_whiskers(path.with_suffix(".whiskers"), {(frame, 0): trace for frame, trace in enumerate(pixels)})


def _write_whiskerman(path, pixels):
    ends = np.concatenate([pixels[:, [0, 6, -1]], np.zeros((len(pixels), 3, 1))], axis=2).swapaxes(1, 2)
    return write_whiskerman(path.with_suffix(".tr4"), ends, ends[:, :, 0], np.ones(len(pixels)))


@pytest.mark.parametrize(("write", "label"), [(_write_deeplabcut, ""), (_write_whisk, ""), (_write_whiskerman, "1")])
def test_files_of_every_tracker_are_played(tmp_path, write, label):
    pixels = _filmed(turn=0.3) / SCALE * [1, -1] + [300, 400]
    tracked = load_tracks(write(tmp_path / "a", pixels), {"RC2": label}, TRACK, EXACT)
    np.testing.assert_allclose(tracked.turns[0, :, 0], SWING - np.median(SWING), atol=1e-4)


def test_a_view_from_below_is_mirrored(tmp_path):
    below = PlayOptions(view="bottom", lowpass=None)
    tracked = _played(tmp_path / "a.csv", _filmed(turn=0.7, mirrored=True), below)
    np.testing.assert_allclose(tracked.turns[0, :, 0], SWING - np.median(SWING), atol=1e-5)


def test_the_direction_of_rest_may_be_given(tmp_path):
    tracked = _played(tmp_path / "a.csv", _filmed(turn=0.5), PlayOptions(rest=0.4, lowpass=None))
    np.testing.assert_allclose(tracked.turns[0, :, 0], SWING + 0.1, atol=1e-5)


def test_three_axes_tell_the_elevation_too(tmp_path):
    rise = 0.1 + 0.2 * SWING
    tracked = _played(tmp_path / "a.csv", _filmed(rise=rise))
    np.testing.assert_allclose(tracked.turns[0, :, 1], rise - np.median(rise), atol=1e-4)
    angles = tracked.angles(ARRAY["RC2"], TIMES) - ARRAY["RC2"].angles
    np.testing.assert_allclose(angles[:, 1], rise - np.median(rise), atol=1e-4)


def test_bases_move_as_they_did_when_rostral_is_known(tmp_path):
    # The animal faces the right of the image, so that what goes up there goes to its left.
    tracked = _played(tmp_path / "a.csv", _filmed(sway=4e-4), PlayOptions(rostral=0.0, lowpass=None))
    moved = tracked.displacement(ARRAY["RC2"], TIMES)
    way = -4e-4 * np.sin(2 * np.pi * 6 * TIMES)
    np.testing.assert_allclose(moved[:, 0], way - np.median(way), atol=2e-8)
    np.testing.assert_allclose(moved[:, 1:], 0, atol=2e-8)
    assert _played(tmp_path / "b.csv", _filmed(sway=4e-4)).shifts is None


def test_whiskers_that_were_not_tracked_move_as_the_nearest_of_their_side(tmp_path):
    tracked = _played(tmp_path / "a.csv", _filmed())
    other = tracked.angles(ARRAY["RD3"], TIMES) - ARRAY["RD3"].angles
    np.testing.assert_allclose(other[:, 0], tracked.turns[0, :, 0], atol=1e-12)
    np.testing.assert_allclose(other[:, 2], ROTATIONS["knutsen"].torsion[3] * other[:, 0], atol=1e-12)
    with pytest.raises(UsageError, match="left side was tracked, which LC2 needs; tracked are 'RC2'"):
        tracked.angles(ARRAY["LC2"], TIMES)


def test_short_gaps_are_filled_and_named_and_long_ones_refused(tmp_path, caplog):
    points = _filmed()
    points[50:56] = np.nan
    tracked = _played(tmp_path / "a.csv", points)
    assert "6 of 200 samples were missing" in caplog.text
    np.testing.assert_allclose(tracked.turns[0, :, 0], SWING - np.median(SWING), atol=0.02)
    points[50:90] = np.nan
    with pytest.raises(DataError, match=r"gap of 80 ms from 0\.098 s on; gaps are filled up to 20 ms"):
        _played(tmp_path / "b.csv", points)
    assert _played(tmp_path / "b.csv", points, PlayOptions(longest_gap=0.1)).turns.shape == (1, 200, 3)


def test_the_filter_takes_the_noise_and_leaves_the_whisk(tmp_path):
    noise = np.random.default_rng(0).normal(scale=0.02, size=len(TIMES))
    smooth = _played(tmp_path / "a.csv", _filmed(angles=SWING + noise), PlayOptions()).turns[0, :, 0]
    inner = slice(20, -20)
    left = smooth - smooth.mean() - (SWING - SWING.mean())
    assert np.std(left[inner]) < 0.012
    assert np.std(np.diff(left[inner], 2)) < 0.1 * np.std(np.diff(noise, 2))
    with pytest.raises(UsageError, match="below half of the frame rate, 250 Hz; received 300"):
        _played(tmp_path / "a.csv", _filmed(), PlayOptions(lowpass=300))


def test_a_scene_beyond_the_track_is_refused(tmp_path):
    tracked = _played(tmp_path / "a.csv", _filmed())
    with pytest.raises(UsageError, match=r"from 0 to 0\.398 s; the scene needs it at 0\.5 s"):
        tracked.angles(ARRAY["RC2"], np.array([0.1, 0.5]))


def test_a_table_of_angles_tells_all_three(tmp_path):
    rows = [f"{t},{math.degrees(a)},{2.0 * k},-1" for k, (t, a) in enumerate(zip(TIMES, SWING, strict=True))]
    head = "time_s,RC2.theta_deg,RC2.phi_deg,RC2.zeta_deg"
    (tmp_path / "a.csv").write_text("\n".join([head, *rows]))
    tracked = load_angles(tmp_path / "a.csv", EXACT)
    turned = tracked.angles(ARRAY["RC2"], TIMES) - ARRAY["RC2"].angles
    expected = np.stack([SWING, np.radians(2.0 * np.arange(200)), np.full(200, -np.radians(1))], axis=1)
    np.testing.assert_allclose(turned, expected, atol=1e-9)
    (tmp_path / "b.csv").write_text("time_s,RC2.theta\n0,1\n1,2\n")
    with pytest.raises(DataError, match=r"RC2\.theta_deg .*it has 'time_s', 'RC2\.theta'"):
        load_angles(tmp_path / "b.csv")


def test_arrays_that_are_no_motion_are_refused():
    with pytest.raises(DataError, match=r"needs turns \[1, n, 3\]"):
        Tracked(("RC2",), np.zeros((2, 5, 3)), RATE)
    with pytest.raises(DataError, match="have gaps"):
        Tracked(("RC2",), np.full((1, 5, 3), np.nan), RATE)


SCENES = """
[array]
whiskers = "C2"
[whisking]
kind = "track"
path = "tracks/{trial}.csv"
whiskers = { C2 = "" }
frame_rate_hz = 500
mm_per_pixel = 0.05
rostral_deg = 90
[frames]
first_ms = 10
interval_ms = 10
count = 12
[[scene]]
label = "{trial}"
"""


def test_a_scene_file_has_one_scene_for_each_trial_with_its_own_whisking(tmp_path):
    (tmp_path / "tracks").mkdir()
    for trial, size in (("monday-1", 0.2), ("monday-2", 1.0)):
        write_points(tmp_path / "tracks" / f"{trial}.csv", _filmed(sway=1e-4, angles=size * SWING))
    (tmp_path / "trials.toml").write_text(SCENES)
    recipe = load_scene(tmp_path / "trials.toml")
    assert recipe.labels == ("monday-1", "monday-2")
    first, second = (scene.whisking.turns[0, :, 0] for scene in recipe.scenes)
    np.testing.assert_allclose(second, 5 * first, atol=1e-3)
    assert len({str(scene.config()["whisking"]) for scene in recipe.scenes}) == 2
    felt = simulate(recipe.scenes, fidelity=Fidelity(links=6, time_step=2e-4), cache=False)
    size = np.linalg.norm(felt["wrench"].values[..., :3], axis=-1).max(axis=(1, 2))
    assert (felt["status"] == "ok").all()
    # Inertial forces of a whisk five times as wide.
    assert 3 < size[1] / size[0] < 7


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("tracks/{trial}.csv", "tracks/a.csv", "path holds {trial} once"),
        ("tracks/{trial}.csv", "none/{trial}.csv", "there is no file 'none/{trial}.csv'"),
        ('label = "{trial}"', 'label = "a"', "{trial}"),
        ("mm_per_pixel = 0.05\n", "", "needs the key 'mm_per_pixel' beside 'rostral_deg'"),
        ('whiskers = { C2 = "" }\n', "", "names its whiskers"),
        ("frame_rate_hz = 500\n", "", "frames per second of the video"),
    ],
)
def test_scene_files_say_what_a_track_lacks(tmp_path, before, after, message):
    (tmp_path / "tracks").mkdir()
    write_points(tmp_path / "tracks" / "a.csv", _filmed())
    (tmp_path / "trials.toml").write_text(SCENES.replace(before, after))
    with pytest.raises((UsageError, DataError)) as error:
        load_scene(tmp_path / "trials.toml")
    assert message in str(error.value)
