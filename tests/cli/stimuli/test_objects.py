import json

import pytest
import trimesh

from brainbench.geometry import load_mesh
from brainbench.stimuli.objects import procedural


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


def test_a_shapenet_folder_is_counted(run, tmp_path):
    path = tmp_path / "02691156" / "aa" / "models" / "model_normalized.obj"
    path.parent.mkdir(parents=True)
    trimesh.creation.box().export(path)
    ids = tmp_path / "ids.txt"
    ids.write_text("02691156/aa\n02691156/bb\n")
    data = json.loads(run("stimuli", "objects", str(tmp_path), "--ids", str(ids), "--json").out)
    assert data == {"models": 1, "labels": {"airplane": 1}, "missing": ["02691156/bb"]}
    assert "1 models of 1 labels, 0 missing" in run("stimuli", "objects", str(tmp_path)).out


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
        (("torus", "--ids", "ids.txt"), "--ids cannot be used for one object"),
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
