from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.published.conversion import SweepTable, convert_sweeps
from tests.factories.sweep_batches import files_of

ROOT = Path(__file__).parents[2]
CONDITIONS = ("speed", "height", "rotation", "distance", "size")


def forces(sweeps):
    """Forces that the number of a sweep determines."""
    return np.stack([np.random.default_rng(int(i)).normal(size=(10, 30, 6)) for i in sweeps]).astype(np.float32)


def make_table(read=forces, **changed):
    count = np.arange(14)
    table = SweepTable(
        label=count % 3,
        object=np.array([f"object-{i % 6}" for i in count]),
        split=np.array(["train"] * 8 + ["validation"] * 2 + ["test"] * 4),
        conditions={name: np.linspace(0, 1, 14) for name in CONDITIONS},
        classes=("a", "b", "c", "nobody"),
        times=0.001 + 0.009 * np.arange(10),
        source="made here",
        source_hash="0",
        read=read,
        notes={"left_out": 5},
    )
    return dataclasses.replace(table, **changed)


def test_the_files_hold_what_the_table_says(tmp_path):
    import xarray as xr

    table = make_table(shard_size=3)
    manifest = convert_sweeps(table, tmp_path)
    assert (manifest["sweeps"], manifest["left_out"], manifest["unstable"]) == (14, 5, 0)
    assert {name: split["sweeps"] for name, split in manifest["splits"].items()} == {
        "train": 8,
        "validation": 2,
        "test": 4,
    }
    assert manifest["objects"]["object-4"]["sweeps"] == {"train": 1, "test": 1}
    for shard in manifest["shards"]:
        with xr.open_dataset(tmp_path / shard["name"], engine="h5netcdf") as data:
            index = data["sweep"].values
            np.testing.assert_array_equal(data["wrench"].values, forces(index))
            np.testing.assert_array_equal(data["label"].values, table.label[index])
            np.testing.assert_array_equal(data["object"].values.astype(str)[data["owner"].values], table.object[index])
            np.testing.assert_array_equal(data["rotation"].values, table.conditions["rotation"][index])
            np.testing.assert_array_equal(data["time"].values, table.times)
            assert set(table.split[index]) == {shard["split"]}


def test_a_whisker_with_missing_values_is_unstable(tmp_path):
    def spoiled(sweeps):
        values = forces(sweeps)
        values[np.asarray(sweeps) == 9, 4:6, 2, 0] = np.nan
        return values

    manifest = convert_sweeps(make_table(spoiled), tmp_path)
    assert [shard["unstable"] for shard in manifest["shards"]] == [0, 1, 0]


CODE = """
import os, sys
from brainbench.published.conversion import convert_sweeps
from tests.published.test_conversion import make_table

def die(done, total, what):
    if done >= 6:
        os.kill(os.getpid(), 9)

convert_sweeps(make_table(shard_size=3), sys.argv[1], progress=die)
"""


def test_a_killed_conversion_goes_on_and_ends_with_the_same_bytes(tmp_path):
    convert_sweeps(make_table(shard_size=3), tmp_path / "unbroken")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", CODE, str(tmp_path / "set")]
    assert subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode == -9
    assert len(list((tmp_path / "set").glob("*.h5"))) == 2
    read: list[int] = []

    def noted(sweeps):
        read.extend(np.asarray(sweeps).tolist())
        return forces(sweeps)

    convert_sweeps(make_table(noted, shard_size=3), tmp_path / "set")
    assert read == list(range(6, 14))
    assert files_of(tmp_path / "set") == files_of(tmp_path / "unbroken")


def test_a_folder_of_another_source_is_not_continued(tmp_path):
    convert_sweeps(make_table(), tmp_path)
    with pytest.raises(UsageError, match="source"):
        convert_sweeps(make_table(source_hash="1"), tmp_path)


def test_an_object_has_one_label():
    with pytest.raises(DataError, match=r"'object-1' .*\[0, 1\]"):
        make_table(label=np.array([0, 1, 2] * 2 + [0, 0, 2] + [0, 1, 2, 0, 1]))
