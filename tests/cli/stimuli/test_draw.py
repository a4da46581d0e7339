import json

import pytest


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
