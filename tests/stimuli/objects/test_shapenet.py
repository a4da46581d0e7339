import json
import re

import pytest
import trimesh

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.stimuli.objects.shapenet import SYNSETS, load_shapenet, read_categories, read_ids
from brainbench.stimuli.sweeps.sweep_scenes import SweepGrid, SweepScenes

PLANE, CHAIR, OTHER = "02691156/aa", "03001627/bb", "03001627/cc"


@pytest.fixture
def tree(tmp_path):
    root = tmp_path / "ShapeNetCore.v2"
    for name, extents in ((PLANE, (1, 2, 3)), (CHAIR, (1, 1, 1))):
        path = root / name / "models" / "model_normalized.obj"
        path.parent.mkdir(parents=True)
        trimesh.creation.box(extents=extents).export(path)
    old = root / OTHER / "model.obj"
    old.parent.mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=1).export(old)
    return root


def test_every_model_of_a_tree_is_found_with_its_label(tree):
    found = load_shapenet(tree)
    assert [(model.name, model.label) for model in found] == [(PLANE, "airplane"), (CHAIR, "chair"), (OTHER, "chair")]
    assert found.counts == {"airplane": 1, "chair": 2}
    assert found.missing == ()


def test_an_id_list_chooses_orders_and_reports_what_is_missing(tree, tmp_path, caplog):
    ids = tmp_path / "ids.txt"
    ids.write_text(f"# mine\n{CHAIR}\n04379243/zz\n\n{PLANE}  # a plane\n")
    found = load_shapenet(tree, ids=ids)
    assert [model.name for model in found] == [CHAIR, PLANE]
    assert found.missing == ("04379243/zz",)
    assert re.search("1 of 3 .*'04379243/zz'", caplog.text)


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_a_category_map_may_split_a_synset(tree, tmp_path, suffix):
    path = tmp_path / f"labels{suffix}"
    given = {"03001627": "seat", OTHER: "ball chair"}
    rows = "name,label\n" + "".join(f"{name},{label}\n" for name, label in given.items())
    path.write_text(json.dumps(given) if suffix == ".json" else rows)
    assert read_categories(path) == given
    assert [model.label for model in load_shapenet(tree, categories=path)] == ["02691156", "seat", "ball chair"]


def test_a_model_becomes_a_solid_of_the_wanted_size(tree):
    model = load_shapenet(tree, ids=[PLANE]).models[0]
    solid = model.solid(diagonal=0.03)
    assert solid.diagonal == pytest.approx(0.03)
    assert solid.name == PLANE
    assert solid.notes == ()


def test_sweeps_take_the_models_and_load_them_only_when_needed(tree):
    found = load_shapenet(tree)
    scenes = SweepScenes(SweepGrid(), found.solids(), whiskers="C1")
    assert scenes.objects == (PLANE, CHAIR, OTHER)
    for model in found:
        model.path.unlink()
    with pytest.raises(DataFileNotFoundError):
        scenes[0]


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        (["chair"], r"named SYNSET/MODEL.*has 'chair'"),
        (["03001627/../x"], r"named SYNSET/MODEL"),
        ([CHAIR, CHAIR], r"occur twice in the ids: '03001627/bb'"),
    ],
)
def test_ids_that_name_no_model_are_refused(tree, ids, message):
    with pytest.raises(UsageError, match=message):
        load_shapenet(tree, ids=ids)


def test_a_folder_without_models_says_what_it_should_hold(tree, tmp_path):
    with pytest.raises(DataError, match=r"ShapeNetCore\.v2' .*model_normalized\.obj"):
        load_shapenet(tree, ids=["03001627/nothing"])
    with pytest.raises(DataFileNotFoundError, match=r"ShapeNet .*/nowhere'"):
        load_shapenet(tmp_path / "nowhere")
    bad = tmp_path / "bad.csv"
    bad.write_text("02691156,air,plane\n")
    with pytest.raises(DataError, match=r"Row 1 .*bad\.csv'.*'02691156,air,plane'"):
        read_categories(bad)
    bad.write_text('02691156,"' + "x" * 200_000)
    with pytest.raises(DataError, match=r"bad\.csv"):
        read_categories(bad)


@pytest.mark.shared
def test_the_published_list_has_9981_models_of_53_named_categories(reference):
    names = read_ids(reference / "stimuli" / "shapenet_9981_ids.txt")
    assert len(names) == 9981
    synsets = [name.partition("/")[0] for name in names]
    assert len(set(synsets)) == 53
    assert set(synsets) <= set(SYNSETS)
    assert synsets.count("02958343") == 1212
