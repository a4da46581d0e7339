from __future__ import annotations

import json
from pathlib import Path

import h5py
import pytest
import trimesh


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


def test_simulate_writes_whiskers_that_cannot_be_trusted_and_names_them(run, tmp_path):
    import xarray as xr

    scene = str(Path(__file__).parents[3] / "docs" / "scenes" / "inside.toml")
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


SMALL = ("--whiskers", "C3", "--fidelity", "fast", "--limit", "2", "--workers", "1")


def test_a_grid_is_counted_beside_the_published_counts(run):
    out = run("stimuli", "sweep", "thesis-high", "torus", "brick-3").out
    for words in ("416", "208", "2,076,048", "288", "312", "torus-0/n0_h", "408 more"):
        assert words in out


def test_counts_and_labels_as_json(run):
    data = json.loads(run("stimuli", "sweep", "thesis-low", "torus", "--json").out)
    assert data["scenes"] == len(data["labels"]) == 16
    assert data["sweeps_per_object"] == 16
    assert data["files"] == []


def test_a_collection_is_counted_with_its_splits(run):
    out = run("stimuli", "sweep", "thesis-low", "--objects", "procedural-24:40").out
    assert "960 of 24 classes" in out
    assert "15,360 sweeps" in out
    assert "train 12,288, validation 1,536, test 1,536 (by object)" in out


def test_sweeps_are_simulated_once_into_shards_with_a_manifest(run, tmp_path):
    trimesh.creation.box(extents=(1, 2, 1)).export(tmp_path / "cube.stl")
    folder = tmp_path / "out"
    arguments = ("stimuli", "sweep", "thesis-low", "--objects", "brick:3", str(tmp_path / "cube.stl"), "--unit", "cm")
    result = run(*arguments, "--out", str(folder), *SMALL, "--json")
    assert result.status == 0
    data = json.loads(result.out)
    assert data["sweeps"] == 8
    assert sorted(path.name for path in folder.iterdir()) == [
        "config.json", "manifest.json", "test-00000.h5", "train-00000.h5", "validation-00000.h5",
    ]  # fmt: skip
    manifest = json.loads((folder / "manifest.json").read_text())
    counted = sum(shard["unsolved"] for shard in manifest["shards"])
    assert data["unsolved"] == manifest["unsolved"] == counted
    with h5py.File(folder / "train-00000.h5") as file:
        assert file.attrs["unsolved"] == manifest["shards"][0]["unsolved"]
        assert set(file["object"].asstr()[:]) >= {"cube"}
        assert file["class"].asstr()[:].tolist() == ["brick", "cube"]
    before = [(folder / name).stat().st_mtime_ns for name in ("train-00000.h5", "test-00000.h5")]
    again = run(*arguments, "--out", str(folder), *SMALL)
    assert again.status == 0
    assert "0 of 8 sweeps, marked" in again.out
    assert (f"contact forces of {counted} time steps" in again.out) == (counted > 0)
    assert [(folder / name).stat().st_mtime_ns for name in ("train-00000.h5", "test-00000.h5")] == before
    # What is there is never taken for something else.
    other = run(*arguments, "--out", str(folder), *SMALL, "--whiskers", "C2", "--split", "sweep")
    assert other.status == 2
    assert "another data set" in other.err
    assert "split 'object' (now 'sweep')" in other.err
    assert "whiskers.names" in other.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("thesis-lo", "torus"), "Unknown sweep grid 'thesis-lo'; did you mean 'thesis-low'"),
        (("thesis-low", "torsu"), "did you mean 'torus'"),
        (("thesis-low", "torus", "torus-0"), "Several objects have the same name"),
        (("thesis-low",), "There is no object"),
        (("thesis-low", "torus", "--split", "objects"), "did you mean 'object'"),
        (("thesis-low", "torus", "--scheduler", "tcp://here:1"), "--out"),
        (("thesis-low", "torus", "--backend", "mujocco"), "did you mean 'mujoco'"),
    ],
)
def test_what_cannot_be_swept_is_named(run, arguments, message):
    result = run("stimuli", "sweep", *arguments)
    assert result.status == 2
    assert message in result.err


def test_a_device_that_the_backend_does_not_have_is_refused_before_anything_is_made(run, tmp_path):
    result = run(
        "stimuli",
        "sweep",
        "thesis-low",
        "torus",
        "--out",
        str(tmp_path / "set"),
        "--device",
        "cuda",
        "--backend",
        "mujoco",
    )
    assert result.status == 2
    assert "'mujoco' does not run on 'cuda'" in result.err
    assert not (tmp_path / "set").exists()


def test_a_mesh_file_needs_its_unit(run, tmp_path):
    trimesh.creation.box().export(tmp_path / "cube.stl")
    assert "--unit" in run("stimuli", "sweep", "thesis-low", str(tmp_path / "cube.stl")).err
