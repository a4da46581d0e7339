import json
from pathlib import Path

import pytest

from brainbench.stimuli.stimulus_set import hash_stimulus_set, write_stimulus_set
from tests.factories.recordings import make_stimuli

SCENE = """
description = "A pole before two whiskers"
[array]
whiskers = "C1,C2"
[frames]
first_ms = 1
interval_ms = 5
count = 10
[[object]]
shape = "cylinder"
radius_mm = 1
height_mm = 10
position_mm = [12, 8, 3]
velocity_mm_s = [0, -30, 0]
friction = 0.3
[[scene]]
label = "whisking"
[[scene]]
label = "still"
[scene.whisking]
kind = "still"
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "pole.toml"
    path.write_text(SCENE)
    return str(path)


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


def test_show_says_how_fast_and_about_what_an_object_turns(run, tmp_path):
    path = tmp_path / "turning.toml"
    path.write_text(SCENE.replace("velocity_mm_s = [0, -30, 0]", "spin_deg_s = [0, 30, -40]"))
    assert "turns by 50°/s about (0, 30, -40)" in run("stimuli", "show", str(path)).out


def test_show_as_json_is_si(run, scene):
    data = json.loads(run("stimuli", "show", scene, "--stimulus", "still", "--json").out)
    (only,) = data["scenes"]
    assert only["whisking"] == {"kind": "still"}
    assert only["objects"][0]["position"] == [0.012, 0.008, 0.003]
    assert only["objects"][0]["solid"]["size"] == pytest.approx([0.002, 0.002, 0.01])
    assert data["array"]["whiskers"] == ["C1", "C2"]


def test_simulate_explains_what_it_left_out_and_show_reads_the_file(run, scene, tmp_path):
    file = tmp_path / "set.h5"
    result = run("stimuli", "simulate", scene, "--fidelity", "fast", "--out", str(file), "--explain", "--json")
    assert result.status == 0, result.err
    data = json.loads(result.out)
    # Whiskers at rest are not stepped.
    assert (data["explanation"]["simulated"], data["explanation"]["silent"]) == (2, 2)
    assert data["explanation"]["out_of_reach"] == {"still": [], "whisking": []}
    assert [item["stimulus"] for item in data["stimuli"]] == ["whisking", "still"]
    text = run("stimuli", "simulate", scene, "--fidelity", "fast", "--explain").out
    assert "2 stimuli × 2 whiskers = 4 runs of " in text
    assert "earlier, read from" in text
    shown = run("stimuli", "show", str(file)).out
    assert "simulated by rod" in shown
    assert "whisking" in shown


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


def test_simulate_writes_whiskers_that_cannot_be_trusted_and_names_them(run, tmp_path):
    import xarray as xr

    scene = str(Path(__file__).parents[2] / "docs" / "scenes" / "inside.toml")
    arguments = ("stimuli", "simulate", scene, "--whiskers", "C1,C4", "--out", str(tmp_path / "a.h5"))
    shown = json.loads(run(*arguments, "--json").out)
    assert [(row["stimulus"], row["whisker"]) for row in shown["unstable"]] == [("inside", "C4")]
    assert "deep in an object" in shown["unstable"][0]["reason"]
    assert "C4" in run(*arguments).out
    with xr.open_dataset(tmp_path / "a.h5", engine="h5netcdf") as dataset:
        assert dataset["status"].values.tolist() == [["ok", "unstable"]]
        assert dataset["wrench"].isnull().any(("time", "channel")).values.tolist() == [[False, True]]
    score = ("score", "zhuang-small", "--stimuli", str(tmp_path / "a.h5"), "--recordings", "demo-rodgers")
    assert run(*score).status != 0
