"""``brainbench stimuli design``: for objects, and for two networks."""

import json

import pytest

QUICK = ("--fidelity", "fast", "--check", "fast", "--iterations", "1", "--starts", "1", "--searches", "1")
NETWORKS = "zhuang-small.simclr,resnet18-small.supervised"


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
    arguments = ("stimuli", "design", poles, "--variables", "object_y", "--networks", NETWORKS, *QUICK)
    data = json.loads(run(*arguments, "--json").out)
    assert data["search"] == "gradient"
    assert data["contrast"][1] >= data["contrast"][0]
    assert data["gain"]["low"] <= data["leads"][1] - data["leads"][0] <= data["gain"]["high"]
    assert set(data["layers"]) == set(NETWORKS.split(","))


@pytest.mark.slow
def test_a_design_for_networks_is_told_in_words(run, poles):
    told = run("stimuli", "design", poles, "--variables", "object_y", "--networks", NETWORKS, *QUICK).out
    for words in ("lead of the true network, held-out objects", "by gradient", "status", "object_y"):
        assert words in told


def test_without_networks_objects_are_told_apart(run, poles):
    found = run("stimuli", "design", poles, "--variables", "protraction", *QUICK)
    assert "whisks" in found.out
    assert "r2 – r3" in found.out


def test_a_wrong_network_is_refused_before_anything_is_simulated(run, poles):
    found = run("stimuli", "design", poles, "--networks", "zhuang-smal.simclr,resnet18-small.supervised", *QUICK)
    assert found.status == 2
    assert "did you mean 'zhuang-small.simclr'" in found.err
    assert "two networks apart; received 1" in run("stimuli", "design", poles, "--networks", "zhuang-small").err
