import json

import pytest
import trimesh

from brainbench.stimuli import read_stimulus_set

SMALL = ("--whiskers", "C3", "--fidelity", "fast", "--limit", "2")


def test_a_grid_is_counted_beside_the_published_counts(run):
    out = run("stimuli", "sweep", "thesis-high", "torus", "brick-3").out
    for words in ("416", "208", "2,076,048", "288", "312", "torus-0/n0_h", "408 more"):
        assert words in out


def test_counts_and_labels_as_json(run):
    data = json.loads(run("stimuli", "sweep", "thesis-low", "torus", "--json").out)
    assert data["scenes"] == len(data["labels"]) == 16
    assert data["sweeps_per_object"] == 16
    assert data["files"] == []


def test_sweeps_are_simulated_once_into_one_file_per_object(run, tmp_path):
    trimesh.creation.box(extents=(1, 2, 1)).export(tmp_path / "cube.stl")
    arguments = ("stimuli", "sweep", "thesis-low", "brick", str(tmp_path / "cube.stl"), "--unit", "cm")
    result = run(*arguments, "--out", str(tmp_path / "out"), *SMALL, "--json")
    assert result.status == 0
    files = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert files == ["brick-0.h5", "cube.h5"]
    dataset = read_stimulus_set(tmp_path / "out" / "cube.h5")
    assert list(dataset["stimulus"].values) == json.loads(result.out)["labels"][16:18]
    before = [(tmp_path / "out" / name).stat().st_mtime_ns for name in files]
    assert run(*arguments, "--out", str(tmp_path / "out"), *SMALL).status == 0
    assert [(tmp_path / "out" / name).stat().st_mtime_ns for name in files] == before
    # What is there is never taken for something else.
    other = run(*arguments, "--out", str(tmp_path / "out"), *SMALL[:-1], "3", "--whiskers", "C2")
    assert other.status == 2
    assert "is there already with other sweeps and whiskers" in other.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("thesis-lo", "torus"), "Unknown sweep grid 'thesis-lo'; did you mean 'thesis-low'"),
        (("thesis-low", "torsu"), "did you mean 'torus'"),
        (("thesis-low", "torus", "torus-0"), "Several objects have the same name"),
    ],
)
def test_what_cannot_be_swept_is_named(run, arguments, message):
    result = run("stimuli", "sweep", *arguments)
    assert result.status == 2
    assert message in result.err


def test_a_mesh_file_needs_its_unit(run, tmp_path):
    trimesh.creation.box().export(tmp_path / "cube.stl")
    assert "--unit" in run("stimuli", "sweep", "thesis-low", str(tmp_path / "cube.stl")).err
