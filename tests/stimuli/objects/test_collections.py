from __future__ import annotations

import json
import pickle
import re

import numpy as np
import pytest
import trimesh

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.stimuli.objects.collections import (
    PROCEDURAL_24,
    SYNSETS,
    load_shapenet,
    read_categories,
    read_ids,
    resolve_objects,
)
from brainbench.stimuli.objects.procedural import list_families
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
    labels = {name: model.label for name, model in found.items()}
    assert list(labels.items()) == [(PLANE, "airplane"), (CHAIR, "chair"), (OTHER, "chair")]
    assert [model.name for model in found.values()] == list(found)


def test_an_id_list_chooses_orders_and_reports_what_is_missing(tree, tmp_path, caplog):
    ids = tmp_path / "ids.txt"
    ids.write_text(f"# mine\n{CHAIR}\n04379243/zz\n\n{PLANE}  # a plane\n")
    found = load_shapenet(tree, ids=ids)
    assert list(found) == [CHAIR, PLANE]
    assert re.search("1 of 3 .*'04379243/zz'", caplog.text)


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_a_category_map_may_split_a_synset(tree, tmp_path, suffix):
    path = tmp_path / f"labels{suffix}"
    given = {"03001627": "seat", OTHER: "ball chair"}
    rows = "name,label\n" + "".join(f"{name},{label}\n" for name, label in given.items())
    path.write_text(json.dumps(given) if suffix == ".json" else rows)
    assert read_categories(path) == given
    models = load_shapenet(tree, categories=path).values()
    assert [model.label for model in models] == ["02691156", "seat", "ball chair"]


def test_a_model_becomes_a_solid_of_40_mm(tree):
    solid = load_shapenet(tree, ids=[PLANE])[PLANE].load()
    assert solid.diagonal == pytest.approx(0.04)
    assert solid.name == PLANE
    assert solid.notes == ()


def test_sweeps_take_the_models_and_load_them_only_when_needed(tree):
    found = load_shapenet(tree)
    scenes = SweepScenes(SweepGrid(), {name: model.load for name, model in found.items()}, whiskers="C1")
    assert scenes.objects == (PLANE, CHAIR, OTHER)
    for path in tree.rglob("*.obj"):
        path.unlink()
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


def test_a_family_a_member_and_several_members():
    found = resolve_objects(["torus", "mug-3", "bowl:3"])
    assert list(found) == ["torus-0", "mug-3", "bowl-0", "bowl-1", "bowl-2"]
    assert [item.label for item in found.values()] == ["torus", "mug", "bowl", "bowl", "bowl"]


def test_the_24_classes_are_families_and_have_so_many_members_each():
    assert len(set(PROCEDURAL_24)) == 24
    assert set(PROCEDURAL_24) <= set(list_families())
    found = resolve_objects(["procedural-24:40"])
    assert len(found) == 960
    labels = [item.label for item in found.values()]
    assert {label: labels.count(label) for label in set(labels)} == dict.fromkeys(PROCEDURAL_24, 40)


def test_members_of_a_collection_have_2000_to_20000_triangles_and_travel_between_processes():
    found = resolve_objects(["procedural-24:3"])
    counts = []
    for name in ("brick-0", "cylinder-1", "ellipsoid-2", "pyramid-1"):
        solid = pickle.loads(pickle.dumps(found[name])).load()
        assert solid.mesh is not None
        assert solid.mesh.diagnosis.watertight
        counts.append(len(solid.mesh.faces))
    assert all(1_900 <= count <= 20_000 for count in counts)
    assert max(counts) > 2 * min(counts)


def test_surfaces_alone_are_the_same_shapes_for_engines_that_collide_meshes():
    (usual,) = resolve_objects(["pyramid-3"]).values()
    (surface,) = resolve_objects(["pyramid-3"], surfaces=True).values()
    solid, other = surface.load(), usual.load()
    assert solid.parts == ()
    assert solid.surface is not None
    assert other.surface is not None
    np.testing.assert_array_equal(solid.surface.vertices, other.surface.vertices)
    assert surface.source != usual.source


def test_equal_objects_have_equal_sources_and_others_have_not():
    first, again = resolve_objects(["torus:2"]), resolve_objects(["torus:2"])
    assert [item.source for item in first.values()] == [item.source for item in again.values()]
    sources = {item.source for item in (*first.values(), *resolve_objects(["torus:2"], collision="hull").values())}
    assert len(sources) == 4


def test_files_of_one_folder_are_their_own_class_and_of_several_folders_share_the_folders(tmp_path):
    for folder in ("cups", "bricks"):
        (tmp_path / folder).mkdir()
        for name in ("a", "b"):
            trimesh.creation.box().export(tmp_path / folder / f"{name}.stl")
    one = resolve_objects([str(tmp_path / "cups" / "*.stl")], unit="cm")
    assert [(item.name, item.label) for item in one.values()] == [("a", "a"), ("b", "b")]
    both = resolve_objects([str(tmp_path / "*" / "*.stl")], unit="cm")
    assert [(item.name, item.label) for item in both.values()] == [
        ("bricks/a", "bricks"), ("bricks/b", "bricks"), ("cups/a", "cups"), ("cups/b", "cups"),
    ]  # fmt: skip
    assert one["a"].load().diagonal == pytest.approx(3**0.5 * 0.01)


def test_a_shapenet_tree_names_its_models_and_their_classes(tmp_path):
    for model in ("03797390/a", "03797390/b", "03001627/c"):
        path = tmp_path / model / "models" / "model_normalized.obj"
        path.parent.mkdir(parents=True)
        trimesh.creation.box().export(path)
    found = resolve_objects([f"shapenet:{tmp_path}"])
    assert {item.label for item in found.values()} == {"mug", "chair"}
    first = resolve_objects([f"shapenet:{tmp_path}:2"])
    assert list(first) == list(found)[:2]
    assert pickle.loads(pickle.dumps(found["03797390/a"])).load().diagonal == pytest.approx(0.04)
    with pytest.raises(UsageError, match=r"number of models .*at most 3; received 9"):
        resolve_objects([f"shapenet:{tmp_path}:9"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["torsu"], "Unknown object 'torsu'; did you mean 'torus'"),
        (["procedural-42:3"], "did you mean 'procedural-24'"),
        (["torus:none"], "1,000,000"),
        (["torus-2:3"], "write torus-2 or torus:3"),
        (["torus", "torus-0"], "same name, 'torus-0'"),
        ([], "There is no object"),
    ],
)
def test_what_names_no_object_is_said(words, message):
    with pytest.raises(UsageError, match=message):
        resolve_objects(words)


def test_files_need_a_unit_and_must_exist(tmp_path):
    trimesh.creation.box().export(tmp_path / "a.stl")
    with pytest.raises(UsageError, match="--unit"):
        resolve_objects([str(tmp_path / "a.stl")])
    with pytest.raises(DataError, match=r"/\*\.obj'"):
        resolve_objects([str(tmp_path / "*.obj")], unit="m")
