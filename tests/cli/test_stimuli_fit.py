"""``brainbench stimuli fit``: parameters and contacts from files, and its errors."""

from __future__ import annotations

import json

import numpy as np
import pytest

from brainbench.stimuli import WhiskerArray
from tests.factories.ringdown_table import write_ringdown
from tests.factories.whisker_tracks import write_points

WHISKER = WhiskerArray.of("mouse")["C2"].whisker
QUICK = ["--links", "8", "--steps-per-period", "80"]


@pytest.fixture(scope="module")
def ringdown_file(tmp_path_factory):
    """Base wrenches of a ring-down, as a table in mN and µN·m."""
    return write_ringdown(tmp_path_factory.mktemp("fit") / "ringdown.csv")


def test_a_ring_down_is_fitted_written_and_drawn(run, ringdown_file, tmp_path):
    result = run(
        "stimuli", "fit", str(ringdown_file), "--whisker", "mouse:C2", "--parameters",
        "young_modulus,damping_ratio,deflection", *QUICK, "--out", str(tmp_path / "fit.json"), "--picture",
        str(tmp_path / "fit.png"), "--json",
    )  # fmt: skip
    assert result.status == 0, result.err
    data = json.loads(result.out)
    found = {one["name"]: one for one in data["estimates"]}
    assert data["status"] == "ok"
    assert found["young_modulus"]["value"] == pytest.approx(4e9, rel=0.03)
    assert found["young_modulus"]["laplace"]["low"] < 4e9 < found["young_modulus"]["laplace"]["high"]
    assert json.loads((tmp_path / "fit.json").read_text()) == data
    assert (tmp_path / "fit.png").stat().st_size > 10_000


def test_contacts_of_a_track_are_printed(run, tmp_path):
    from brainbench.stimuli.fitting.elastica import LoadedWhisker

    shape = LoadedWhisker(WHISKER).shapes(np.zeros((1, 3)), np.array([0.009]), np.array([8e-5]))
    path = write_points(tmp_path / "track.csv", np.repeat(shape.place[:, ::2], 3, axis=0))
    words = ("stimuli", "fit", str(path), "--contacts", "--metres-per-pixel", "5e-5", "--frame-rate", "500")
    data = json.loads(run(*words, "--json").out)
    assert [one["status"] for one in data["frames"]] == ["ok"] * 3
    assert data["frames"][0]["force"] == pytest.approx(8e-5, rel=0.02)
    assert "force µN" in run(*words).out
    late = write_points(tmp_path / "late.csv", np.repeat(shape.place[:, 8::2], 3, axis=0))
    start = 1e3 * 0.009 * 8 / 48
    data = json.loads(run(*words[:2], str(late), *words[3:], "--first-arc", str(start), "--json").out)
    assert data["frames"][0]["force"] == pytest.approx(8e-5, rel=0.02)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--whisker", "C2"], "mouse:C2"),
        (["--whisker", "mouse:C9"], "C"),
        (["--parameters", "young_moduls"], "young_modulus"),
        (["--known", "arc_length"], "NAME=VALUE"),
        (["--known", "arc_lenth=0.02"], "arc_length"),
        (["--bounds", "young_modulus=5"], "LOW:HIGH"),
        (["--known", "density=1200,density=1300"], "'density' more than once"),
        (["--bounds", "density=1:2,density=1:3"], "'density' more than once"),
        (["--contacts"], "--contacts cannot be used with wrenches"),
        (["--contacts", "--picture", "fit.png"], "--picture cannot be used with --contacts"),
        (["--contacts", "--parameters", "density"], "--parameters cannot be used with --contacts"),
        (["--contacts", "--level", "0.9"], "--level cannot be used with --contacts"),
        (["--scene", "x.toml", "--deflection", "2"], "--deflection cannot be used with --scene"),
        (["--frame-rate", "500", "--parts", "a,b"], "--frame-rate and --parts cannot be used with wrenches"),
        (["--frames", "3"], "--frames cannot be used without --contacts"),
        (["--first-arc", "3"], "--first-arc cannot be used without --contacts"),
        (["--noise", "20"], "--noise cannot be used with wrenches"),
        (["--intervals", "laplac"], "laplace"),
    ],
)
def test_wrong_options_are_told_before_any_simulation(run, ringdown_file, words, told):
    result = run("stimuli", "fit", str(ringdown_file), *words)
    assert result.status == 2
    assert told in result.err


def test_a_track_without_scale_is_refused(run, tmp_path):
    path = write_points(tmp_path / "track.csv", np.zeros((3, 2, 2)))
    result = run("stimuli", "fit", str(path))
    assert result.status == 2
    assert "metres_per_pixel" in result.err
    assert "--stimulus cannot be used with a track" in run("stimuli", "fit", str(path), "--stimulus", "near").err


def test_a_design_is_printed(run, tmp_path):
    path = tmp_path / "posts.toml"
    posts = "".join(
        f'[[scene]]\nlabel = "r{radius}"\n[[scene.object]]\nshape = "cylinder"\nradius_mm = {radius}\nheight_mm = 20\n'
        "position_mm = [10.5, 2, 3]\n"
        for radius in (0.3, 0.6)
    )
    path.write_text(f'[array]\nwhiskers = "C2"\n{posts}')
    words = ["--variables", "protraction", "--iterations", "1", "--starts", "1", "--check", "fast"]
    result = run("stimuli", "design", str(path), *words, "--json")
    assert result.status == 0, result.err
    data = json.loads(result.out)
    assert data["whisks"] < 1
    assert list(data["distances"]) == ["r0.3 – r0.6"]
    wrong = run("stimuli", "design", str(path), "--variables", "protracton")
    assert wrong.status == 2
    assert "protraction" in wrong.err
