import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.recorded import LAYOUTS, Recorded, Trajectory, load_initial_angles, load_trajectory
from brainbench.stimuli.motion.trajectories import Whisking, follow_angles
from brainbench.stimuli.scenes.recipes import describe_recipe, get_recipe, is_recipe
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.scenes.scene_files import load_scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.array import WhiskerArray

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
