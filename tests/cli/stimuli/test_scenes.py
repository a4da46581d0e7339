import json
from pathlib import Path

import pytest

from brainbench.stimuli.stimulus_set import hash_stimulus_set, write_stimulus_set
from tests.factories.recordings import make_stimuli


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
    dataset = make_stimuli(whiskers=2).assign_attrs(scene=scene)
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
