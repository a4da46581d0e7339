"""``brainbench stimuli fit`` and ``brainbench stimuli design``: results, and errors before anything is simulated."""

from __future__ import annotations

import json

import numpy as np
import pytest

from brainbench.stimuli import WhiskerArray
from tests.factories.whisker_measurements import write_ringdown
from tests.factories.whisker_tracks import write_points

WHISKER = WhiskerArray.of("mouse")["C2"].whisker
QUICK = ["--links", "8", "--steps-per-period", "80"]
QUICK_DESIGN = ("--fidelity", "fast", "--check", "fast", "--iterations", "1", "--starts", "1", "--searches", "1")
NETWORKS = "zhuang-small.simclr,resnet18-small.supervised"


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
    assert found["young_modulus"]["value"] == pytest.approx(3.5e9, rel=0.03)
    assert found["young_modulus"]["laplace"]["low"] < 3.5e9 < found["young_modulus"]["laplace"]["high"]
    assert json.loads((tmp_path / "fit.json").read_text()) == data
    assert (tmp_path / "fit.png").stat().st_size > 10_000


@pytest.mark.slow
def test_contacts_of_a_track_are_printed(run, tmp_path):
    from brainbench.stimuli.fitting.contacts import LoadedWhisker

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
        (["--known", "arc_length"], "name=value"),
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


@pytest.fixture
def poles(tmp_path):
    """A scene file with eight poles of different radii."""
    lines = [
        '[array]\nspecies = "mouse"\nside = "right"\nwhiskers = "C2"\n',
        "[whisking]\nfrequency_hz = 20\nprotraction_deg = 30\nretraction_deg = 10\n",
        "[frames]\nfirst_ms = 51\ninterval_ms = 3\ncount = 60\n",
    ]
    lines += [
        f'[[scene]]\nlabel = "r{number}"\n[[scene.object]]\nshape = "cylinder"\nradius_mm = {number / 10}\n'
        "height_mm = 20\nposition_mm = [10.5, 2, 3]\n"
        for number in range(2, 10)
    ]
    path = tmp_path / "poles.toml"
    path.write_text("\n".join(lines), encoding="utf-8")
    return str(path)


@pytest.mark.slow
def test_two_networks_are_told_apart_on_held_out_objects(run, poles):
    arguments = ("stimuli", "design", poles, "--variables", "object_y", "--networks", NETWORKS, *QUICK_DESIGN)
    data = json.loads(run(*arguments, "--json").out)
    assert data["search"] == "gradient"
    assert data["contrast"][1] >= data["contrast"][0]
    assert data["gain"]["low"] <= data["leads"][1] - data["leads"][0] <= data["gain"]["high"]
    assert set(data["layers"]) == set(NETWORKS.split(","))


@pytest.mark.slow
def test_a_design_for_networks_is_told_in_words(run, poles):
    told = run("stimuli", "design", poles, "--variables", "object_y", "--networks", NETWORKS, *QUICK_DESIGN).out
    for words in ("lead of the true network, held-out objects", "by gradient", "status", "object_y"):
        assert words in told


def test_without_networks_objects_are_told_apart(run, poles):
    found = run("stimuli", "design", poles, "--variables", "protraction", *QUICK_DESIGN)
    assert "whisks" in found.out
    assert "r2 – r3" in found.out


def test_a_wrong_network_is_refused_before_anything_is_simulated(run, poles):
    found = run("stimuli", "design", poles, "--networks", "zhuang-smal.simclr,resnet18-small.supervised", *QUICK_DESIGN)
    assert found.status == 2
    assert "did you mean 'zhuang-small.simclr'" in found.err
    assert "two networks apart; received 1" in run("stimuli", "design", poles, "--networks", "zhuang-small").err
