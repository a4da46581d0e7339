import pickle

import numpy as np
import pytest
import trimesh

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.objects.collections import PROCEDURAL_24, resolve_objects
from brainbench.stimuli.objects.procedural import list_families


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
    with pytest.raises(UsageError, match=r"\b3 models.*\b9\b"):
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
