from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.recorded import (
    LAYOUTS,
    PlayOptions,
    Recorded,
    Tracked,
    Trajectory,
    load_angles,
    load_initial_angles,
    load_tracks,
    load_trajectory,
)
from brainbench.stimuli.motion.trajectories import ROTATIONS, Whisking, follow_angles
from brainbench.stimuli.scenes.recipes import describe_recipe, get_recipe, is_recipe
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.scenes.scene_files import load_scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.tracks.readers import TrackOptions
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.whisker_tracks import write_deeplabcut_csv, write_points, write_whiskerman, write_whiskers

SAMPLE = "whisking_trajectory_sample.csv"


def _coning(times, rate=40.0, opening=0.7):
    """Rotation [n, 3, 3] that spins about an axis which itself turns, and its angular velocity [n, 3]."""
    about_z = Rotation.from_rotvec(np.outer(times * rate, [0, 0, 1]))
    about_x = Rotation.from_rotvec(np.outer(opening * np.sin(9 * times), [1, 0, 0]))
    velocity = np.array([0, 0, rate]) + about_z.apply(np.outer(9 * opening * np.cos(9 * times), [1, 0, 0]))
    return (about_z * about_x).as_matrix(), velocity


def _sampled(count, rate, motion=_coning):
    return Trajectory(("RC1",), motion(np.arange(count) / rate)[1][None], rate)


def test_integration_converges_with_the_fourth_power_of_the_sampling_step():
    errors = []
    for rate in (250.0, 500.0, 1000.0):
        times = np.linspace(0, 0.4, 33)
        found = _sampled(int(0.5 * rate), rate).rotation("RC1", times)
        errors.append(np.abs(found - _coning(times)[0]).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 3.7).all()
    assert errors[-1] < 1e-6


def test_a_long_recording_stays_a_rotation_to_rounding():
    trajectory = _sampled(60_000, 1000.0)
    found = trajectory.rotation("RC1", np.array([0.0, 10.0, 59.9]))
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=1e-14)


def test_a_steady_turn_is_integrated_exactly():
    velocity = np.array([3.0, -20.0, 7.0])
    trajectory = Trajectory(("RC1",), np.tile(velocity, (1, 100, 1)), 1000.0)
    times = np.array([0.0, 0.0123, 0.05, 0.0999])
    np.testing.assert_allclose(
        trajectory.rotation("RC1", times), Rotation.from_rotvec(np.outer(times, velocity)).as_matrix(), atol=1e-13
    )


def test_a_closed_loop_returns_to_where_it_began():
    # Half-way the motion runs back: Ω(t) = −Ω(T − t) undoes every rotation, whatever the axes.
    count = 1001
    half = _coning(np.arange(count // 2) / 1000)[1]
    velocity = np.concatenate([half, np.zeros((1, 3)), -half[::-1]])
    trajectory = Trajectory(("RC1",), velocity[None], 1000.0)
    final = trajectory.rotation("RC1", np.array([(count - 1) / 1000]))[0]
    np.testing.assert_allclose(final, np.eye(3), atol=1e-9)


def test_playing_the_velocities_of_whisking_is_whisking():
    """Angular velocities of the published sinusoid, by differences of rotations, play back as that sinusoid."""
    array = WhiskerArray.mouse(side="both", whiskers="A1,C2,E0")
    whisking, rate = Whisking(frequency=8.0, protraction=0.5, retraction=0.2, onset=0.0), 1000.0
    times = np.arange(1000) / rate
    names, velocities = [], []
    for mount in array:
        names.append(mount.side[0].upper() + mount.name)
        ahead, behind = (base_rotation(whisking.angles(mount, times + shift)) for shift in (1e-6, -1e-6))
        turn = Rotation.from_matrix(ahead @ np.swapaxes(behind, 1, 2)).as_rotvec()
        velocities.append(turn / 2e-6)
    recorded = Recorded(Trajectory(tuple(names), np.array(velocities), rate), start=-0.2)
    fine = np.linspace(0, 0.99, 3001)
    for mount in array:
        np.testing.assert_allclose(recorded.angles(mount, fine), whisking.angles(mount, fine), atol=1e-7)


def test_whiskers_are_matched_by_name_and_missing_ones_move_as_their_neighbour():
    names = LAYOUTS["whiskit-62"]
    assert len(names) == 62
    assert names[10] == "RB5"
    assert names[25:31] == ("RE1", "RE2", "RE3", "RE4", "RE5", "RE6")
    recorded = Recorded(Trajectory(names, np.zeros((62, 5, 3))))
    mouse = WhiskerArray.mouse(side="both")
    assert recorded.line(mouse["RE0"]) == "RE1"
    assert recorded.line(mouse["LE0"]) == "LE1"
    assert recorded.line(mouse["RC0"]) == "RC0"
    assert recorded.line(WhiskerArray.rat(side="both")["LE6"]) == "LE6"
    only_c = Recorded(Trajectory(("RC0", "RC1"), np.zeros((2, 5, 3))))
    assert only_c.line(mouse["RC6"]) == "RC1"
    with pytest.raises(UsageError, match=r"row A .*RA0 .*'RC0', 'RC1'"):
        only_c.line(mouse["RA0"])


@pytest.mark.parametrize("species", ["mouse", "rat"])
def test_the_layouts_of_sixty_lines_are_the_arrays(species):
    array = {"mouse": WhiskerArray.mouse, "rat": WhiskerArray.rat}[species](side="both")
    assert LAYOUTS[f"{species}-60"] == array.names


def test_starting_angles_replace_rest_where_they_are_given():
    mouse = WhiskerArray.mouse(whiskers="C1,C2")
    recorded = Recorded(Trajectory(("RC1", "RC2"), np.zeros((2, 50, 3))), initial={"RC2": (1.0, 0.1, 0.2)}, start=0.3)
    np.testing.assert_allclose(recorded.angles(mouse["C2"], np.array([0.0, 0.02])), [[1.0, 0.1, 0.2]] * 2, atol=1e-12)
    moved = recorded.angles(mouse["C1"], np.array([0.0]))[0] - mouse["C1"].angles
    np.testing.assert_allclose(moved, [0.3, 0.3 * 0.578, 0.3 * 0.243], atol=1e-12)


def test_a_scene_longer_than_the_recording_is_refused():
    recorded = Recorded(Trajectory(("RC2",), np.zeros((1, 100, 3))))
    scene = Scene("long", WhiskerArray.mouse(whiskers="C2"), whisking=recorded, frames=Frames(0.0, 0.01, 20))
    with pytest.raises(UsageError, match=r"0\.1 s; .*0\.19 s"):
        simulate(scene, cache=False)


def test_the_recording_counts_in_the_configuration():
    trajectory = Trajectory(("RC2",), np.zeros((1, 100, 3)))
    other = Trajectory(("RC2",), np.full((1, 100, 3), 1e-9))
    assert Recorded(trajectory).config() != Recorded(other).config()
    assert Recorded(trajectory).config() == Recorded(Trajectory(("RC2",), np.zeros((1, 100, 3)))).config()
    assert Recorded(trajectory).config() != Recorded(trajectory, start=0.1).config()


def _write(path, lines):
    path.write_text("".join(",".join(map(str, line)) + "\n" for line in lines), encoding="utf-8")
    return path


def test_files_are_read_with_or_without_trailing_commas(tmp_path):
    values = np.arange(62 * 6, dtype=float).reshape(62, 6)
    plain = load_trajectory(_write(tmp_path / "a.csv", values))
    text = (tmp_path / "a.csv").read_text(encoding="utf-8").replace("\n", ",\r\n")
    (tmp_path / "b.csv").write_text(text, encoding="utf-8", newline="")
    assert load_trajectory(tmp_path / "b.csv").content_hash == plain.content_hash
    np.testing.assert_array_equal(plain.velocity[1, 1], [9, 10, 11])


@pytest.mark.parametrize(
    ("lines", "options", "error", "message"),
    [
        ([[1, 2]] * 62, {}, DataError, "2 numbers per line; velocities come in threes"),
        ([[1, 2, 3, 4, 5, 6]] * 60, {}, UsageError, r"60 lines, which does not tell whose whiskers.*rat-60 \(60\)"),
        ([[1, 2, 3, 4, 5, 6]] * 62, {"layout": "rat-60"}, DataError, "62 lines; the layout 'rat-60' has 60"),
        ([[1, 2, 3]] * 62, {"layout": "rat60"}, UsageError, "did you mean 'rat-60'"),
        ([["a", 2, 3]] * 62, {}, DataError, r"bad\.csv' .*comma"),
        ([[1, 2, 3]] * 61 + [[1]], {}, DataError, r"bad\.csv' .*comma"),
        ([[1, 2, 3, "nan", 1, 1]] * 62, {}, DataError, "not finite"),
        ([[1, 2, 3]] * 62, {}, DataError, "at least two samples"),
        ([[1, 2, 3, 4, 5, 6]] * 62, {"rate": 0.0}, UsageError, r"rate .*received 0"),
    ],
)
def test_files_that_are_no_trajectories_are_refused(tmp_path, lines, options, error, message):
    with pytest.raises(error, match=message):
        load_trajectory(_write(tmp_path / "bad.csv", lines), **options)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(DataFileNotFoundError, match=r"/gone\.csv'"):
        load_trajectory(tmp_path / "gone.csv")
    with pytest.raises(DataFileNotFoundError, match=r"'gone\.csv'"):
        get_recipe("rodgers-recorded gone.csv")


def test_the_recorded_recipe_asks_for_its_file_and_for_nothing_twice():
    assert is_recipe("rodgers-recorded some/file.csv")
    assert "FILE" in describe_recipe("rodgers-recorded")
    with pytest.raises(UsageError, match="'rodgers-recorded FILE'"):
        get_recipe("rodgers-recorded")
    trajectory = Trajectory(("RC2",), np.zeros((1, 1000, 3)))
    with pytest.raises(UsageError, match=r"'rodgers-recorded' .*one of"):
        get_recipe("rodgers-recorded x.csv", trajectory=trajectory)
    with pytest.raises(UsageError, match=r"'rodgers' .*'rodgers-recorded'"):
        get_recipe("rodgers", trajectory=trajectory)
    with pytest.raises(UsageError, match="'cat'; did you mean 'rat'"):
        get_recipe("rodgers-recorded", trajectory=trajectory, species="cat")


def test_a_scene_file_plays_a_recording(tmp_path):
    _write(tmp_path / "w.csv", np.zeros((60, 9)))
    _write(tmp_path / "init.csv", np.full((60, 3), 0.5))
    text = '[array]\nspecies = "rat"\n[whisking]\nkind = "recorded"\npath = "w.csv"\nlayout = "rat-60"\nrate_hz = 500\n'
    (tmp_path / "a.toml").write_text(text + '[[scene]]\nlabel = "a"\n', encoding="utf-8")
    whisking = load_scene(tmp_path / "a.toml").scenes[0].whisking
    assert whisking.trajectory.rate == 500
    assert whisking.trajectory.velocity.shape == (60, 3, 3)
    more = 'start_deg = 90\ninitial_path = "init.csv"\n[[scene]]\nlabel = "a"\n'
    (tmp_path / "b.toml").write_text(text + more, encoding="utf-8")
    whisking = load_scene(tmp_path / "b.toml").scenes[0].whisking
    assert whisking.start == pytest.approx(math.pi / 2)
    assert whisking.initial["LE6"] == (0.5, 0.5, 0.5)
    (tmp_path / "c.toml").write_text(
        text.replace('path = "w.csv"\n', "") + '[[scene]]\nlabel = "a"\n', encoding="utf-8"
    )
    with pytest.raises(UsageError, match=r"\[whisking\] .*'path'"):
        load_scene(tmp_path / "c.toml")


# Starting angles from which the published sample was computed, for three of its lines (SeNSE-lab/whiskitphysics,
# code/data/whisking_init_angle_sample.csv), with the couplings in the script beside it: torsion per row, and elevation
# from +10° to +35° times the coefficient, so 25/45 of it.
@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "first", "elevation", "torsion"),
    [
        ("RA0", (0.397737074800567, 0.921493951023932, 0.891169693899575), 0.12 * 25 / 45, -0.75),
        ("RC0", (0.760537074800567, 0.21450987755983, 0.330293414960113), 0.30 * 25 / 45, 0.20),
        ("RD0", (0.987367074800567, -0.101485390472079, 0.266206829920227), 0.14 * 25 / 45, 0.40),
    ],
)
def test_the_published_sample_is_an_eight_hertz_whisk_of_45_degrees(reference, name, first, elevation, torsion):
    trajectory = load_trajectory(reference / "whiskers" / "rat" / SAMPLE)
    base, times = base_rotation(first), np.linspace(0, 0.999, 2000)
    angles = follow_angles(lambda t: trajectory.rotation(name, t) @ base, times, first, name)
    azimuth = math.radians(45) * (1 - np.cos(2 * np.pi * 8 * times)) / 2
    expected = np.array(first) + azimuth[:, None] * [1.0, elevation, torsion]
    # The file holds central differences over 2 ms, which lose (2π·8·1 ms)²/6 = .04 % of the amplitude.
    np.testing.assert_allclose(angles, expected, atol=math.radians(0.05))


@pytest.mark.shared
def test_the_sample_mirrors_left_and_right_and_returns(reference):
    trajectory = load_trajectory(reference / "whiskers" / "rat" / SAMPLE)
    assert trajectory.duration == 1.0
    times = np.array([0.05, 0.3, 0.7])
    flip = np.diag([-1.0, 1.0, 1.0])
    for name in ("A2", "C3", "E1"):
        right, left = (trajectory.rotation(side + name, times) for side in "RL")
        np.testing.assert_allclose(left, flip @ right @ flip, atol=1e-9)
        final = trajectory.rotation("R" + name, np.array([1.0]))[0]
        assert np.linalg.norm(Rotation.from_matrix(final).as_rotvec()) < math.radians(0.1)


@pytest.mark.shared
def test_the_published_starting_angles_belong_to_the_rat_array(reference):
    initial = load_initial_angles(reference / "whiskers" / "rat" / "whisking_init_angle.csv", layout="rat-60")
    rat = WhiskerArray.rat(side="both")
    for name, angles in initial.items():
        change = np.array(angles) - rat[name].angles
        # Both sides were recorded: the right starts 7.25° in front of rest, the left 9° behind it.
        azimuth = math.radians(7.25) if name[0] == "R" else -math.radians(8.98)
        mirror = 1 if name[0] == "R" else -1
        assert mirror * change[0] == pytest.approx(azimuth, abs=2e-4)


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize("species", ["mouse", "rat"])
def test_the_sample_whisks_against_the_rodgers_stimuli(reference, species):
    path = reference / "whiskers" / "rat" / SAMPLE
    recipe = get_recipe("rodgers-recorded", trajectory=load_trajectory(path), species=species, whiskers="B0,C1")
    assert [scene.label for scene in recipe.scenes] == [scene.label for scene in get_recipe("rodgers").scenes]
    if species == "mouse":
        by_name = get_recipe(f"rodgers-recorded {path}", whiskers="B0,C1").scenes[0]
        assert by_name.config() == recipe.scenes[0].config()
    scene = recipe.scenes[3]
    assert scene.array.species == species
    dataset = simulate(scene, fidelity=Fidelity.preset("fast"), cache=False)
    assert (dataset["status"] == "ok").all()
    assert dataset["contact"].values.any()
    assert not dataset["contact"].values[0, 0].any()


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


def test_frames_that_a_table_leaves_out_are_gaps(tmp_path):
    pixels = _filmed() / SCALE * [1, -1] + [300, 400]
    path = _write_deeplabcut(tmp_path / "a", pixels)
    whole = load_tracks(path, {"RC2": ""}, TRACK, EXACT)
    head, rows = path.read_text().splitlines()[:3], path.read_text().splitlines()[3:]
    # Ten times two frames: 40 ms would be lost of a whisk of 167 ms.
    path.write_text("\n".join([*head, *(row for frame, row in enumerate(rows) if frame % 20 not in (10, 11))]) + "\n")
    cut = load_tracks(path, {"RC2": ""}, TRACK, EXACT)
    assert cut.end == pytest.approx(whole.end)
    np.testing.assert_allclose(np.diff(cut.turns[0, :, 0]), np.diff(whole.turns[0, :, 0]), atol=0.01)
    np.testing.assert_allclose(np.ptp(cut.turns[0, :, 0] - whole.turns[0, :, 0]), 0, atol=0.01)


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


def write_angles(path, times, degrees):
    rows = [f"{time!r},{angle!r}" for time, angle in zip(times.tolist(), degrees.tolist(), strict=True)]
    path.write_text("\n".join(["time_s,RC2.theta_deg", *rows]) + "\n")
    return path


def test_angles_that_begin_anew_after_a_whole_turn_are_counted_through(tmp_path):
    times = np.arange(50) * 0.002
    angles = 20 * np.sin(20 * np.pi * times) ** 2 - 1
    plain = load_angles(write_angles(tmp_path / "plain.csv", times, angles), EXACT)
    for name, shown in (("wrapped", angles % 360), ("turned", angles + 720), ("half", (angles + 180) % 360 - 180)):
        again = load_angles(write_angles(tmp_path / f"{name}.csv", times, shown), EXACT)
        np.testing.assert_allclose(again.turns, plain.turns, atol=1e-12)


@pytest.mark.parametrize(
    ("lost", "words"), [((0, 3), "beginning: cut it to 0.006 to 0.098"), ((46, 50), "end: cut it")]
)
def test_angles_that_are_missing_at_an_end_are_no_gap(tmp_path, lost, words):
    times, angles = np.arange(50) * 0.002, np.linspace(0, 20, 50)
    angles[slice(*lost)] = np.nan
    with pytest.raises(DataError, match=f"lacks a whisker at its {words}"):
        load_angles(write_angles(tmp_path / "angles.csv", times, angles), EXACT)


@pytest.mark.parametrize(("rate", "digits"), [(300, 5), (90, 4), (240, 5)])
def test_times_that_a_table_rounds_run_no_faster(tmp_path, rate, digits):
    times = np.arange(10 * rate) / rate
    degrees = 20 * np.sin(2 * np.pi * 8 * times)
    tracked = load_angles(write_angles(tmp_path / "angles.csv", times.round(digits), degrees), EXACT)
    angles = tracked.angles(ARRAY["RC2"], times[:-1])[:, 0] - ARRAY["RC2"].angles[0]
    np.testing.assert_allclose(np.degrees(angles), degrees[:-1], atol=0.05)


def test_a_table_of_angles_without_a_row_is_refused(tmp_path):
    times = np.delete(np.arange(50) * 0.002, 30)
    with pytest.raises(DataError, match="evenly spaced seconds"):
        load_angles(write_angles(tmp_path / "angles.csv", times, np.zeros(49)), EXACT)


def test_angles_before_a_scene_begins_are_one_sentence(tmp_path):
    with pytest.raises(DataError, match=r"angles\.csv' has no time from 0 on"):
        load_angles(write_angles(tmp_path / "angles.csv", np.arange(-50, 0) * 0.002, np.zeros(50)))


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
