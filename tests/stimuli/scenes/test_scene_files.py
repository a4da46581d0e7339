import math
import pathlib
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.stimuli import simulate
from brainbench.stimuli.motion.trajectories import ROTATIONS, Path, Spin, Still, Translation
from brainbench.stimuli.objects.obstacle import Cylinder
from brainbench.stimuli.scenes.scene import Frames
from brainbench.stimuli.scenes.scene_files import load_array, load_scene
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import build_chain
from tests.factories.scene_files import POLE


def _write(tmp_path, text, name="pole.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_scene_file_becomes_scenes_in_si_units(tmp_path):
    recipe = load_scene(_write(tmp_path, POLE))
    near, _ = recipe.scenes
    assert (recipe.name, recipe.description, recipe.labels) == ("pole", "a pole", ("near", "free"))
    assert near.array.species == "rat"
    assert near.array.side == "left"
    assert near.array.names == tuple(f"C{col}" for col in range(7))
    assert near.array["C2"].whisker.young_modulus == 3.3e9
    assert near.whisking.frequency == 8
    assert near.whisking.rotations == ROTATIONS["knutsen-b"]
    assert near.frames.times == pytest.approx(np.arange(10) * 1e-3)
    assert near.head.position == pytest.approx((1e-3, 2e-3, 3e-3))
    assert near.head.rotation[1] == pytest.approx(math.pi / 2)
    box, pole = near.objects
    assert box.solid.bounds[1] == pytest.approx([0.5e-3, 1e-3, 1.5e-3])
    assert isinstance(pole.solid.parts[0], Cylinder)
    assert pole.position == pytest.approx((0.014, 0.005, 0))
    assert pole.friction == 0.3
    assert pole.motion == Translation((0.0, -0.03, 0.0))


def test_a_scene_overrides_shared_tables_key_by_key(tmp_path):
    near, free = load_scene(_write(tmp_path, POLE)).scenes
    assert free.whisking == Still()
    assert free.head.position == (0, 0, 0)
    assert free.head.rotation == near.head.rotation
    assert len(free.objects) == 1


def test_a_file_may_state_that_its_whiskers_do_not_twist_and_what_they_are_made_of(tmp_path):
    assert [scene.twist for scene in load_scene(_write(tmp_path, POLE)).scenes] == [True, True]
    text = "twist = false\n" + POLE.replace("young_modulus = 3.3e9", "young_modulus = 3.3e9\npoisson_ratio = 0.3")
    near, free = load_scene(_write(tmp_path, text)).scenes
    assert (near.twist, free.twist) == (False, False)
    assert near.array["C2"].whisker.poisson_ratio == 0.3
    with pytest.raises(UsageError, match=r"'twist'.*True or False"):
        load_scene(_write(tmp_path, "twist = 0\n" + POLE))


def test_a_file_holds_whiskers_as_they_were_measured_along_their_length(tmp_path):
    rows = "arc_length = 0.02\nradii = [[0, 5e-5], [0.008, 3e-5], [0.02, 1e-5]]\nmoduli = [[0, 2e9], [0.02, 4e9]]"
    near, _ = load_scene(_write(tmp_path, POLE.replace("young_modulus = 3.3e9", rows))).scenes
    whisker = near.array["C2"].whisker
    assert (whisker.base_radius, whisker.tip_radius, whisker.young_modulus) == (5e-5, 1e-5, 2e9)
    assert whisker.radius(0.014) == pytest.approx(2e-5)
    for wrong in ("[[0, 5e-5], [0.008, 3e-5]]", "[[0, 5e-5], [0.02, -1e-5]]", "[[0, 5e-5], [0.02]]"):
        with pytest.raises(UsageError, match=r"pole\.toml: .*radii of a whisker"):
            load_scene(_write(tmp_path, POLE.replace("young_modulus = 3.3e9", f"arc_length = 0.02\nradii = {wrong}")))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("[array.replace]\narc_length = 0.02", "a table of tables, one for each name"),
        ("[array.replace.C2]\nfollicle = 3", "follicle of a whisker must be a table of its springs; received 3"),
        ("[array.replace.C2]\nfollicle = { about_z = 1e-6 }", "about_z of a follicle holds 2 numbers"),
        ("[array.replace.C2]\nfollicle = { about_z = ['a', 1] }", "about_z of a follicle .* received 'a'"),
    ],
)
def test_properties_of_another_kind_are_named(tmp_path, table, words):
    with pytest.raises(UsageError, match=rf"pole\.toml: .*{words}"):
        load_scene(_write(tmp_path, POLE.replace("[array.replace.C2]\nyoung_modulus = 3.3e9", table)))


def test_a_friction_below_zero_is_refused(tmp_path):
    with pytest.raises(UsageError, match=r"friction.*-1"):
        load_scene(_write(tmp_path, POLE.replace("friction = 0.3", "friction = -1")))


def test_whiskers_can_be_chosen_at_loading(tmp_path):
    assert load_scene(_write(tmp_path, POLE), whiskers="C1-C2").scenes[0].array.names == ("C1", "C2")


def test_a_mesh_is_found_beside_the_file(tmp_path):
    trimesh.creation.box(extents=(1, 1, 1)).export(tmp_path / "cube.stl")
    text = (
        '[[scene]]\nlabel = "cube"\n[[scene.object]]\nshape = "mesh"\npath = "cube.stl"\nunit = "cm"\ndiagonal_mm = 20'
    )
    (scene,) = load_scene(_write(tmp_path, text)).scenes
    assert scene.objects[0].solid.diagonal == pytest.approx(0.02)


def test_a_procedural_shape_is_named_by_family_and_seed(tmp_path):
    path = _write(
        tmp_path,
        '[[scene]]\nlabel = "a"\n[[scene.object]]\nshape = "family:torus"\nseed = 3\ndetail = 2000\n'
        '[[scene.object]]\nshape = "family:brick"\ndiagonal_mm = 20\ncollision = "hull"\n',
    )
    torus, brick = (item.solid for item in load_scene(path).scenes[0].objects)
    assert torus.name == "torus-3"
    assert torus.diagonal == pytest.approx(0.04)
    assert brick.diagonal == pytest.approx(0.02)
    path.write_text('[[scene]]\nlabel = "a"\n[[scene.object]]\nshape = "family:torsu"\n')
    with pytest.raises(UsageError, match="did you mean 'torus'"):
        load_scene(path)


def test_a_mesh_can_be_decomposed_by_keys_of_its_table(tmp_path):
    trimesh.creation.annulus(1, 2, 1, segment=[[0, 0, 0], [0, 0, 1]]).export(tmp_path / "ring.stl")
    text = (
        '[[scene]]\nlabel = "a"\n[[scene.object]]\nshape = "mesh"\npath = "ring.stl"\nunit = "mm"\n'
        'collision = "decomposition"\nthreshold = 0.3\n'
    )
    solid = load_scene(_write(tmp_path, text)).scenes[0].objects[0].solid
    assert len(solid.parts) > 1
    with pytest.raises(UsageError, match=r"threshold .*0\.01 .*1; received 3"):
        load_scene(_write(tmp_path, text.replace("0.3", "3")))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"pole\.toml: the file has no \[\[scene\]\]"),
        ("[[scene]]\n", r"\[\[scene\]\] needs the key 'label'"),
        (
            'descripton = "x"\n[[scene]]\nlabel="a"',
            r"Unknown key of the scene file 'descripton'; did you mean 'description'",
        ),
        (
            '[[scene]]\nlabel="a"\n[scene.whisking]\nfrequency = 3',
            r"key of \[whisking\] 'frequency'; did you mean 'frequency_hz'",
        ),
        (
            '[[scene]]\nlabel="a"\n[scene.whisking]\nfrequency_hz = "3"',
            r"'frequency_hz' of \[whisking\] must be a finite number",
        ),
        (
            '[[scene]]\nlabel="a"\n[scene.whisking]\nkind = "sinusoidal"',
            "Unknown kind of whisking 'sinusoidal'; did you mean 'sinusoid'",
        ),
        ('[[scene]]\nlabel="a"\n[scene.whisking]\nrotations = "knutson"', "did you mean 'knutsen'"),
        (
            '[[scene]]\nlabel="a"\n[scene.head]\nposition_mm = [1, 2]',
            r"'position_mm' of \[head\] holds 3 numbers",
        ),
        ('[[scene]]\nlabel="a"\n[[scene.object]]\nshape = "spere"', "Unknown shape 'spere'; did you mean 'sphere'"),
        (
            '[[scene]]\nlabel="a"\n[[scene.object]]\nshape = "sphere"',
            r"\[\[object\]\] of scene 'a' needs the key 'radius_mm'",
        ),
        (
            '[[scene]]\nlabel="a"\n[[scene.object]]\nshape = "sphere"\nradius_mm = -1',
            "radius of a sphere .*above 0",
        ),
        (
            '[[scene]]\nlabel="a"\n[[scene.object]]\nshape = "sphere"\nradius_mm = 1\ncolour = "red"',
            "Unknown key of .*'colour'",
        ),
        ('[[scene]]\nlabel="a"\n[[scene]]\nlabel="a"', r"pole\.toml: .*label 'a'"),
        ('[array]\nspecies = "mous"\n[[scene]]\nlabel="a"', "Unknown species 'mous'; did you mean 'mouse'"),
        ('[array]\nwhiskers = "C9"\n[[scene]]\nlabel="a"', "Unknown whisker 'C9'"),
        ('[frames]\ncount = 1.5\n[[scene]]\nlabel="a"', r"'count' of \[frames\] must be a whole number"),
        ("scene = 3", "must be a list of tables"),
        ("array = 3", "must be a table"),
    ],
)
def test_mistakes_in_a_scene_file_are_named_with_the_file(tmp_path, text, message):
    with pytest.raises(UsageError, match=message) as caught:
        load_scene(_write(tmp_path, text))
    assert "pole.toml" in str(caught.value)


def test_a_file_that_is_not_toml_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"pole\.toml' .*TOML"):
        load_scene(_write(tmp_path, "= ="))


def test_a_missing_scene_file_is_named(tmp_path):
    with pytest.raises(DataFileNotFoundError, match=r"/gone\.toml'"):
        load_scene(tmp_path / "gone.toml")


def test_the_frames_table_sets_rate_filter_axes_and_clip(tmp_path):
    table = "rate_hz = 100\naverage = 10\nlowpass_hz = 40\nphase = 'causal'\naxes = 'follicle'\nclip_newton = 1"
    frames = load_scene(_write(tmp_path, POLE.replace("interval_ms = 1", table))).scenes[0].frames
    assert frames == Frames(0.0, 0.01, 10, 10, lowpass=40.0, phase="causal", axes="follicle", clip=1.0)
    both = POLE.replace("interval_ms = 1", "interval_ms = 1\nrate_hz = 1000")
    with pytest.raises(UsageError, match=r"\[frames\] .*interval_ms .*rate_hz"):
        load_scene(_write(tmp_path, both))
    with pytest.raises(UsageError, match=r"'rate_hz' .*received 0"):
        load_scene(_write(tmp_path, POLE.replace("interval_ms = 1", "rate_hz = 0")))
    with pytest.raises(UsageError, match="did you mean 'lowpass_hz'"):
        load_scene(_write(tmp_path, POLE.replace("interval_ms = 1", "lowpas_hz = 40")))


MOVING = """
[array]
whiskers = "C1,C2"
[head]
times_ms = [0, 100, 2000]
path_mm = [[0, 0, 0], [1, 0, 0], [1, 2, 0]]
path_deg = [[0, 0, 0], [0, 0, 90], [0, 0, 90]]
[[animal]]
name = "b"
[animal.array]
species = "rat"
whiskers = "C*"
[animal.head]
position_mm = [50, 0, 0]
[animal.whisking]
kind = "still"
[[scene]]
label = "crowd"
"""


def test_a_scene_file_moves_heads_and_holds_several_animals(tmp_path):
    (scene,) = load_scene(_write(tmp_path, MOVING)).scenes
    assert scene.names[:3] == ("a:C1", "a:C2", "b:C0")
    assert scene.head.motion.times == pytest.approx((0, 0.1, 2))
    assert scene.head.motion.displacements[2] == pytest.approx((1e-3, 2e-3, 0))
    assert scene.head.motion.rotations[1] == pytest.approx((0, 0, math.pi / 2))
    (other,) = scene.others
    assert other.head.position == pytest.approx((0.05, 0, 0))
    assert other.whisking == Still()
    assert load_scene(_write(tmp_path, MOVING), whiskers="C1").scenes[0].names == ("a:C1", "b:C1")
    assert load_scene(_write(tmp_path, MOVING), whiskers="b:C3").scenes[0].names == ("C3",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("times_ms = [0, 100, 2000]\n", "", r"\[head\] needs the key 'times_ms' beside its path"),
        ("times_ms = [0, 100, 2000]", "times_ms = 3", "'times_ms' of .* holds numbers"),
        ("[1, 2, 0]]", "[1, 2]]", "'path_mm' of .* holds 3 numbers"),
        ('name = "b"\n', "", r"\[\[animal\]\] needs the key 'name'"),
        ('name = "b"', 'name = "a"', "need different names"),
    ],
)
def test_mistakes_in_moving_scenes_are_named(tmp_path, old, new, message):
    with pytest.raises(UsageError, match=message):
        load_scene(_write(tmp_path, MOVING.replace(old, new)))


def _object_motion(tmp_path, keys):
    text = f'[[scene]]\nlabel = "a"\n[[scene.object]]\nshape = "sphere"\nradius_mm = 1\n{keys}\n'
    return load_scene(_write(tmp_path, text)).scenes[0].objects[0].motion


def test_an_object_turns_or_follows_keyframes(tmp_path):
    assert _object_motion(tmp_path, "") == Still()
    spin = _object_motion(tmp_path, "spin_deg_s = [0, 0, 180]\nspin_onset_ms = 20")
    assert spin == Spin((0.0, 0.0, math.pi), 0.02)
    assert _object_motion(tmp_path, "spin_deg_s = [0, 0, 180]").onset == Spin((0, 0, 1)).onset
    with pytest.raises(UsageError, match="'spin_deg_s' beside 'spin_onset_ms'"):
        _object_motion(tmp_path, "velocity_mm_s = [0, 1, 0]\nspin_onset_ms = 20")
    path = _object_motion(
        tmp_path, "times_ms = [0, 50]\npath_mm = [[0, 0, 0], [1, 0, 0]]\npath_deg = [[0, 0, 0], [0, 0, 90]]"
    )
    assert path == Path((0.0, 0.05), ((0, 0, 0), (1e-3, 0, 0)), ((0, 0, 0), (0, 0, math.pi / 2)))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("spin_deg_s = [0, 0, 9]\nvelocity_mm_s = [1, 0, 0]", r"scene 'a' .*velocity.*spin.*keyframes"),
        ("spin_deg_s = 9", "'spin_deg_s' of .* holds 3 numbers"),
        ("spin_deg = [0, 0, 9]", "did you mean 'spin_deg_s'"),
        ("path_mm = [[0, 0, 0], [1, 0, 0]]", "needs the key 'times_ms' beside its path"),
    ],
)
def test_motions_of_objects_that_cannot_be_meant_are_refused(tmp_path, keys, message):
    with pytest.raises(UsageError, match=message):
        _object_motion(tmp_path, keys)


HANGING = """
gravity_m_s2 = [0, 0, -9.81]
[array]
species = "rat"
whiskers = "C2"
[whisking]
kind = "still"
[frames]
count = 20
[[scene]]
label = "level"
[[scene]]
label = "turned"
head.rotation_deg = [90, 20, 0]
[[scene]]
label = "floats"
gravity_m_s2 = [0, 0, 0]
"""


def test_the_follicle_carries_the_weight_of_a_whisker_however_the_head_is_turned(tmp_path):
    pytest.importorskip("warp")
    recipe = load_scene(_write(tmp_path, HANGING))
    assert [scene.gravity for scene in recipe.scenes] == [(0, 0, -9.81), (0, 0, -9.81), (0, 0, 0)]
    assert "gravity" not in recipe.scenes[2].config()
    level, turned, floats = simulate(recipe.scenes, fidelity="fast", cache=False)["wrench"].values[:, -1, 0]
    weight = 9.81 * build_chain(recipe.scenes[0].array["C2"].whisker, 30).masses.sum()
    assert level[:3] == pytest.approx([0, 0, -weight], rel=0.02, abs=0.02 * weight)
    assert turned[:3] == pytest.approx(level[:3], rel=0.02, abs=0.02 * weight)
    # The lever depends on the direction of the whisker.
    assert not np.allclose(turned[3:], level[3:], rtol=0.1, atol=0)
    assert not floats.any()


def test_the_shipped_pole_stands_where_no_whisker_starts_in_it():
    pytest.importorskip("warp")
    scene = load_scene(pathlib.Path(__file__).parents[3] / "docs" / "scenes" / "pole.toml")
    assert (simulate(scene.scenes, fidelity="fast", cache=False)["status"] == "ok").all()


def _species(tmp_path, text):
    path = tmp_path / "animal.toml"
    path.write_text(text)
    return path


def _rat_file(names):
    rat = WhiskerArray.rat()
    parts = ['species = "rat, in part"', 'rules = "rat"']
    for name in names:
        mount = rat[name]
        place = [1e3 * value for value in mount.position]
        angles = np.degrees(mount.angles).tolist()
        rod = f"arc_length = {mount.whisker.arc_length!r}, curvature = {mount.whisker.curvature!r}"
        parts += [
            "[[mount]]",
            f'name = "{name}"',
            f"position_mm = {place}",
            f"angles_deg = {angles}",
            f"whisker = {{ {rod} }}",
        ]
    return "\n".join(parts)


def test_species_file_with_the_numbers_of_the_rat_is_the_rat(tmp_path):
    array = load_array(_species(tmp_path, _rat_file(WhiskerArray.rat().names)))
    assert array.species == "rat, in part"
    assert array.names == WhiskerArray.rat().names
    for mount, published in zip(array, WhiskerArray.rat(), strict=True):
        assert mount.position == pytest.approx(published.position)
        assert mount.angles == pytest.approx(published.angles)
        assert (mount.row, mount.col) == (published.row, published.col)
        for name in ("base_radius", "tip_radius", "young_modulus", "damping_ratio", "friction", "curvature"):
            assert getattr(mount.whisker, name) == pytest.approx(getattr(published.whisker, name)), name
        assert mount.whisker.density == published.whisker.density


def test_scene_takes_a_species_file_and_its_mirror_image(tmp_path):
    _species(tmp_path, _rat_file(["C1", "C2"]))
    path = tmp_path / "scene.toml"
    path.write_text('[array]\nspecies = "animal.toml"\nside = "both"\nwhiskers = "C2"\n[[scene]]\nlabel = "x"\n')
    (scene,) = load_scene(path).scenes
    assert scene.names == ("RC2", "LC2")
    assert scene.array["LC2"].position == pytest.approx(WhiskerArray.rat(side="left")["C2"].position)


def test_the_species_file_of_the_page_is_valid(tmp_path):
    page = (pathlib.Path(__file__).parents[3] / "docs" / "scene-files.md").read_text(encoding="utf-8")
    block = page.split("## Species files")[1].split("```toml\n")[1].split("```")[0]
    array = load_array(_species(tmp_path, block))
    rat = WhiskerArray.rat()
    assert array["A0"].angles == pytest.approx(rat["A0"].angles, abs=1e-4)
    assert array["A0"].whisker == replace(rat["A0"].whisker, damping_ratio=0.15)
    assert array["A1"].whisker.radius(0.02) == pytest.approx(35e-6)


WHOLE = '[[mount]]\nname = "C2"\nposition_mm = [1, 2, 3]\nangles_deg = [10, 20, 30]\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (WHOLE, "needs 'arc_length', 'base_radius', 'damping_ratio', 'density', 'tip_radius', 'young_modulus'"),
        (WHOLE + "whisker = { lenght = 1 }", "property of the whisker C2.*'lenght'"),
        (WHOLE.replace("C2", "F2"), "row, one of ABCDE, and its column, 0 to 6, as C2; received 'F2'"),
        # A set has a cell for each row and column, and A00 would be in that of A0.
        *((WHOLE.replace("C2", name), f"received '{name}'") for name in ("C02", "C7", "c2")),
        ('rules = "rat"\n' + WHOLE + "whisker = { arc_length = '0.03' }", "arc_length of a whisker .*finite.*'0.03'"),
        (WHOLE.replace("position_mm = [1, 2, 3]\n", ""), "needs the key 'position_mm'"),
        ('rules = "shrew"\n' + WHOLE, "shrew"),
        ('side = "both"\n' + WHOLE, "both"),
        ("mount = []", "received none"),
        ('rules = "rat"\n' + 2 * (WHOLE + "whisker = { arc_length = 0.03 }\n"), "'C2' has several"),
    ],
)
def test_species_file_that_is_no_array_is_refused(tmp_path, text, words):
    with pytest.raises(UsageError, match=words):
        load_array(_species(tmp_path, 'species = "x"\n' + text))
