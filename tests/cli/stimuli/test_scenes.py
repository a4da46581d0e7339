from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh

from brainbench.geometry import load_mesh
from brainbench.stimuli import load_stimuli
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.stimulus_set import hash_stimulus_set, write_stimulus_set


@pytest.mark.parametrize("command", ["list", "show", "simulate", "render", "plot"])
def test_every_command_explains_itself(run, command):
    result = run("stimuli", command, "--help")
    assert result.status == 0
    assert "Usage" in result.out
    assert "--json" in result.out


def test_show_prints_poses_and_motion_in_millimetres_and_degrees(run, scene):
    out = run("stimuli", "show", scene).out
    for words in ("A pole before two whiskers", "C1, C2", "12, 8, 3", "(0, -30, 0) mm/s", "20 Hz", "friction 0.3"):
        assert words in out
    assert "10 from 1 ms every 5 ms" in out


def test_show_says_how_fast_and_about_what_an_object_turns(run, scene, tmp_path):
    path = tmp_path / "turning.toml"
    path.write_text(Path(scene).read_text().replace("velocity_mm_s = [0, -30, 0]", "spin_deg_s = [0, 30, -40]"))
    assert "turns by 50°/s about (0, 30, -40)" in run("stimuli", "show", str(path)).out


def test_show_as_json_is_si(run, scene):
    data = json.loads(run("stimuli", "show", scene, "--stimulus", "still", "--json").out)
    (only,) = data["scenes"]
    assert only["whisking"] == {"kind": "still"}
    assert only["objects"][0]["position"] == [0.012, 0.008, 0.003]
    assert only["objects"][0]["solid"]["size"] == pytest.approx([0.002, 0.002, 0.01])
    assert data["array"]["whiskers"] == ["C1", "C2"]


@pytest.mark.parametrize("scene", ["no JSON", "[]", "[{}]", "[1]", "null", "[" * 5000])
def test_show_refuses_a_set_whose_scenes_are_no_scenes(run, tmp_path, scene):
    dataset = load_stimuli("rodgers", whiskers="C2").dataset.assign_attrs(scene=scene)
    file = write_stimulus_set(dataset.assign_attrs(content_hash=hash_stimulus_set(dataset)), tmp_path / "set.h5")
    result = run("stimuli", "show", str(file))
    assert (result.status, result.err.count("\n")) == (1, 1)
    assert "set.h5" in result.err


def test_show_tells_where_recorded_whisking_starts(run, tmp_path):
    path = tmp_path / "whisking.csv"
    path.write_text("\n".join([",".join(["0"] * 3000)] * 62))
    out = run("stimuli", "show", f"rodgers-recorded {path}", "--stimulus", "convex-far", "--json").out
    (scene,) = json.loads(out)["scenes"]
    assert scene["whisking"]["kind"] == "recorded"
    text = run("stimuli", "show", f"rodgers-recorded {path}", "--stimulus", "convex-far").out
    assert "azimuth" in text
    assert "-10°" in text


def test_stimuli_are_listed(run):
    assert "rodgers" in run("stimuli", "list").out


@pytest.fixture
def cup(tmp_path):
    """An open box, inside out, in millimetres."""
    box = trimesh.creation.box(extents=(10, 10, 20))
    path = tmp_path / "cup.stl"
    trimesh.Trimesh(box.vertices, box.faces[:, ::-1], process=False).export(path)
    return str(path)


def test_the_families_are_listed(run):
    assert json.loads(run("stimuli", "objects", "--json").out).keys() == set(procedural.list_families())
    assert "family:NAME" in run("stimuli", "objects").out


@pytest.mark.parametrize(("shift", "volume"), [(5, None), (20, 2000)])
def test_what_two_bodies_share_is_not_counted_twice(run, tmp_path, shift, volume):
    boxes = [trimesh.creation.box(extents=(10, 10, 10)) for _ in range(2)]
    boxes[1].apply_translation((shift, shift / 10, 0))
    path = tmp_path / "two.stl"
    trimesh.util.concatenate(boxes).export(path)
    arguments = ("stimuli", "objects", str(path), "--unit", "mm")
    value = json.loads(run(*arguments, "--json").out)["volume_mm3"]
    assert value == (volume if volume is None else pytest.approx(volume))
    assert ("bodies overlap" in run(*arguments).out) == (volume is None)


@pytest.mark.slow
def test_a_member_of_a_family_is_described_and_written(run, tmp_path):
    out = tmp_path / "torus.obj"
    arguments = ("stimuli", "objects", "torus", "--seed", "3", "--diagonal-mm", "30", "--export", str(out))
    data = json.loads(run(*arguments, "--json").out)
    assert data["parameters"].keys() == {"tube_over_ring"}
    assert data["diagnosis"] == "watertight"
    assert data["diagonal_mm"] == pytest.approx(30)
    assert data["convex_parts"] > 10
    assert load_mesh(out, unit="mm").volume * 1e9 == pytest.approx(data["volume_mm3"], rel=1e-4)
    text = run(*arguments).out
    for word in ("torus-3", "tube_over_ring", "watertight", "diagonal 30 mm", "stand out from its mesh", str(out)):
        assert word in text


def test_a_file_is_diagnosed_repaired_and_scaled(run, cup):
    result = run("stimuli", "objects", cup, "--unit", "mm", "--diagonal-mm", "24.5", "--json")
    data = json.loads(result.out)
    assert data["as_read"] == "a surface that is inside out"
    assert data["diagnosis"] == "watertight"
    assert data["size_mm"] == pytest.approx([10, 10, 20], rel=1e-3)
    assert data["notes"] == ["the surface was inside out and was turned"]


def test_a_decomposition_states_its_deviation(run, tmp_path):
    path = tmp_path / "ring.ply"
    trimesh.creation.annulus(5, 10, 4, sections=12).export(path)
    result = run("stimuli", "objects", str(path), "--unit", "mm", "--collision", "decomposition", "--threshold", "0.2")
    assert result.status == 0, result.err
    assert "convex pieces (coacd)" in result.out
    assert "of its diagonal (sampled)" in result.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("torsu",), "did you mean 'torus'"),
        (("torus", "--collision", "hul"), "did you mean 'hull'"),
        (("torus", "--detail", "10"), "at least 2,000 and at most 20,000"),
        (("torus", "--diagonal-mm", "0"), "above 0"),
        (("torus", "--export", "x.dae"), "Unknown mesh format '.dae'"),
        (("--export", "x.obj"), "--export cannot be used without a family or a mesh file"),
        (("torus", "--unit", "mm"), "--unit cannot be used for a family"),
        (("torus", "--method", "cocad"), "did you mean 'coacd'"),
    ],
)
def test_mistakes_are_one_sentence_and_status_two(run, arguments, message):
    result = run("stimuli", "objects", *arguments)
    assert result.status == 2
    assert message in result.err
    assert len(result.err.strip().splitlines()) == 1


def test_a_file_has_a_unit_and_no_seed(run, cup):
    assert "--seed cannot be used for a file" in run("stimuli", "objects", cup, "--unit", "mm", "--seed", "1").err
    result = run("stimuli", "objects", cup)
    assert result.status == 2
    assert "--unit m|cm|mm|um|in" in result.err


def test_render_writes_a_picture_and_says_where(run, scene, tmp_path):
    out = tmp_path / "a.png"
    options = ["--fidelity", "fast", "--size", "160x120", "--view", "1,-1,0.5", "--look-at", "10,5,3", "--width", "30"]
    result = run("stimuli", "render", scene, "--out", str(out), "--stimulus", "still", "--at", "20", *options, "--json")
    assert result.status == 0, result.err
    data = json.loads(result.out)
    assert data["times_s"] == [0.02]
    assert data["camera"]["target"] == pytest.approx([0.01, 0.005, 0.003])
    assert out.stat().st_size > 1000


def test_plot_writes_one_file_per_stimulus(run, scene, tmp_path):
    options = ["--fidelity", "fast", "--channel", "M", "--size", "400x240", "--stop", "30"]
    result = run("stimuli", "plot", scene, "--out", str(tmp_path / "t.svg"), *options)
    assert result.status == 0, result.err
    assert sorted(path.name for path in tmp_path.glob("*.svg")) == ["t-still.svg", "t-whisking.svg"]
    assert "t-still.svg" in result.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render", "{scene}", "-o", "a.png"], "Name one stimulus with --stimulus; there are 'whisking', 'still'"),
        (["render", "{scene}", "-o", "a.png", "-s", "stil"], "did you mean 'still'"),
        (["render", "{scene}", "-o", "a.png", "-s", "still", "--view", "1,2"], "--view takes 3 numbers"),
        (["render", "{scene}", "-o", "a.gif", "-s", "still", "--at", "5"], "--start, --stop and --step"),
        (["render", "{scene}", "-o", "a.png", "-s", "still", "--stop", "5"], "--stop cannot be used for a picture"),
        (["render", "set.h5", "-o", "a.png"], "file of forces"),
        (["render", "rogers", "-o", "a.png"], "did you mean 'rodgers'"),
        (["plot", "{scene}", "-o", "a.bmp"], "Allowed: '.png', '.svg', '.pdf'"),
        (["plot", "{scene}", "-o", "a.png", "--channel", "Gx"], "Unknown channel"),
        (["show", "{scene}", "-s", "x"], "Unknown stimulus"),
    ],
)
def test_wrong_requests_end_with_status_two_and_one_line(run, scene, arguments, message):
    result = run("stimuli", *(item.format(scene=scene) for item in arguments))
    assert result.status == 2
    assert message in result.err
    assert result.out == ""
