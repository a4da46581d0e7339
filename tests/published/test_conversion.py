from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.datasets.whisking.dataset import WhiskingDataset
from brainbench.published import conversion
from brainbench.published.conversion import CELLS, Listed, SweepTree, convert_sweeps, read_sweep
from tests.factories.published_files import sweep_data, write_sweep, write_tree
from tests.factories.sweep_batches import files_of

ROOT = Path(__file__).parents[2]


def forces(sweeps):
    """Forces that the number of a sweep determines."""
    return np.stack([np.random.default_rng(int(i)).normal(size=(110, 30, 6)) for i in sweeps]).astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class DrawnTree(SweepTree):
    """Sweeps that stand in no files."""

    read: Callable = forces

    def wrenches(self, sweeps):
        return self.read(sweeps)


def make_tree(read=forces, *, label=(0, 1, 2) * 4 + (0, 1), digest="0", **changed):
    count = np.arange(14)
    listed = Listed(
        path=np.array([f"{i}.npz" for i in count]),
        shape=np.array([f"object-{i % 6}" for i in count]),
        label=np.array(label),
        rate=np.full(14, 1000),
        conditions=np.linspace(0, 1, 14)[:, None].repeat(5, axis=1),
        faults=np.zeros((14, 4), dtype=int),
        digest=np.full(14, digest),
    )
    split = np.array(["train"] * 8 + ["validation"] * 2 + ["test"] * 4)
    return DrawnTree(Path("nowhere"), listed, split, ("a", "b", "c", "nobody"), left_out=5, read=read, **changed)


def test_the_files_hold_what_the_table_says(tmp_path):
    import xarray as xr

    tree = make_tree(shard_size=3)
    manifest = convert_sweeps(tree, tmp_path)
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
            np.testing.assert_array_equal(data["label"].values, tree.listed.label[index])
            np.testing.assert_array_equal(
                data["object"].values.astype(str)[data["owner"].values], tree.listed.shape[index]
            )
            np.testing.assert_array_equal(data["rotation"].values, tree.conditions()["rotation"][index])
            np.testing.assert_array_equal(data["time"].values, tree.times)
            assert set(tree.split[index]) == {shard["split"]}


def test_a_whisker_with_missing_values_is_unstable(tmp_path):
    def spoiled(sweeps):
        values = forces(sweeps)
        values[np.asarray(sweeps) == 9, 4:6, 2, 0] = np.nan
        return values

    manifest = convert_sweeps(make_tree(spoiled), tmp_path)
    assert [shard["unstable"] for shard in manifest["shards"]] == [0, 1, 0]


CODE = """
import os, sys
from brainbench.published.conversion import convert_sweeps
from tests.published.test_conversion import make_tree

def die(done, total, what):
    if done >= 6:
        os.kill(os.getpid(), 9)

convert_sweeps(make_tree(shard_size=3), sys.argv[1], progress=die)
"""


def test_a_killed_conversion_goes_on_and_ends_with_the_same_bytes(tmp_path):
    convert_sweeps(make_tree(shard_size=3), tmp_path / "unbroken")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", CODE, str(tmp_path / "set")]
    assert subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode == -9
    assert len(list((tmp_path / "set").glob("*.h5"))) == 2
    read: list[int] = []

    def noted(sweeps):
        read.extend(np.asarray(sweeps).tolist())
        return forces(sweeps)

    convert_sweeps(make_tree(noted, shard_size=3), tmp_path / "set")
    assert read == list(range(6, 14))
    assert files_of(tmp_path / "set") == files_of(tmp_path / "unbroken")


def test_a_folder_of_another_source_is_not_continued(tmp_path):
    convert_sweeps(make_tree(), tmp_path)
    with pytest.raises(UsageError, match="source"):
        convert_sweeps(make_tree(digest="1"), tmp_path)


def test_an_object_has_one_label(tmp_path):
    tree = make_tree(label=[0, 1, 2] * 2 + [0, 0, 2] + [0, 1, 2, 0, 1])
    with pytest.raises(DataError, match=r"'object-1' .*\[0, 1\]"):
        convert_sweeps(tree, tmp_path / "set")
    assert not (tmp_path / "set").exists()


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "rate", "conditions"),
    [
        ("sweep_example_1000hz.npz", 1000, (0.03, -0.005, math.radians(30), 0.008, 0.04)),
        ("sweep_example_110hz.npz", 110, (0.03, -0.003, math.radians(102), 0.005, 0.04)),
    ],
)
def test_published_sweeps_are_read_in_newtons(reference, name, rate, conditions):
    path = reference / "published" / name
    sweep = read_sweep(path)
    with np.load(path) as stored:
        data = stored["data"]
    kept = np.delete(data, [5, 6, 12, 13, 34], axis=1)
    np.testing.assert_array_equal(sweep.data, kept)
    np.testing.assert_allclose(sweep.wrench()[..., :3], kept[..., :3] / 1e3, rtol=1e-7)
    np.testing.assert_allclose(sweep.wrench()[..., 3:], kept[..., 3:] / 1e6, rtol=1e-7)
    assert (sweep.label, sweep.shape, sweep.rate) == (49, "04530566/eb00c722894c3d70c40386bdd72f9a0", rate)
    assert sweep.conditions == pytest.approx(conditions)


@pytest.mark.shared
def test_values_that_the_published_cleaning_replaced_are_found_where_the_raw_run_is_wrong(reference):
    where = read_sweep(reference / "published" / "sweep_example_110hz.npz").faulty()
    # Whisker 12 is wild in row 60 and whisker 25 infinite in Fy of row 70 (MANIFEST of the reference).
    expected = np.zeros((110, 30, 6), dtype=bool)
    expected[60, 12] = expected[70, 25, 1] = True
    np.testing.assert_array_equal(where["repeated"], expected)
    assert not any(where[name].any() for name in ("too large", "missing", "unwritten"))


def test_values_that_cannot_be_trusted_are_counted_and_missing(tmp_path):
    data = sweep_data(1, cells=30)
    data[7, 3, 1], data[9, 4, 5], data[20, 5, :2], data[0, 6, 0] = 1000.5, -math.inf, math.nan, 0.25
    data[30, 8] = data[29, 8]
    sweep = read_sweep(write_sweep(tmp_path / "a.npz", rate=110, data=data))
    counts = {name: int(where.sum()) for name, where in sweep.faulty().items()}
    assert counts == {"repeated": 6, "too large": 2, "missing": 2, "unwritten": 1}
    assert np.isnan(sweep.wrench()).sum() == 4
    assert sweep.conditions == pytest.approx((0.045, -0.003, math.radians(102), 0.005, 0.02))


def test_a_whisker_at_rest_is_no_fault(tmp_path):
    data = sweep_data(1)
    data[40:, 0] = data[40, 0]
    assert not read_sweep(write_sweep(tmp_path / "a.npz", data=data)).faulty()["repeated"].any()


@pytest.mark.parametrize(("label", "number"), [("?", None), ("7", 7), (3.0, 3), (-1, None), (math.nan, None)])
def test_a_label_is_a_number_or_nothing(tmp_path, label, number):
    assert read_sweep(write_sweep(tmp_path / "a.npz", label=label)).label == number
    assert read_sweep(write_sweep(tmp_path / "b.npz", leave_out=("label",))).label is None


@pytest.mark.parametrize(
    ("changed", "culprit"),
    [
        ({"data": np.zeros((100, 35, 6))}, r"\[100, 35, 6\]"),
        ({"data": np.zeros((110, 29, 6))}, r"\[110, 29, 6\]"),
        ({"data": np.full((110, 35, 6), "1")}, "<U1"),
        ({"data": np.ones((110, 35, 6))}, "5, 6, 12, 13, 34"),
        ({"data": np.array([None, 1])}, "Python objects"),
        ({"h": "low"}, "'low'"),
        ({"leave_out": ("data",)}, "shape, label, h, d, t"),
        ({"leave_out": ("d",)}, "data, shape, label, h, t"),
    ],
)
def test_what_is_no_sweep_is_named(tmp_path, changed, culprit):
    path = write_sweep(tmp_path / "odd.npz", **changed)
    with pytest.raises(DataError, match=culprit) as error:
        read_sweep(path)
    assert "odd.npz" in str(error.value)


def test_a_damaged_file_is_named(tmp_path):
    path = write_sweep(tmp_path / "short.npz")
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DataError, match=r"short\.npz"):
        read_sweep(path)
    (tmp_path / "text.npz").write_text("no archive")
    with pytest.raises(DataError, match=r"text\.npz"):
        read_sweep(tmp_path / "text.npz")
    np.save(tmp_path / "alone.npy", sweep_data(0))
    with pytest.raises(DataError, match=r"alone\.npy"):
        read_sweep(tmp_path / "alone.npy")
    flipped = bytearray(write_sweep(tmp_path / "flip.npz").read_bytes())
    flipped[2000] ^= 255
    (tmp_path / "flip.npz").write_bytes(flipped)
    with pytest.raises(DataError, match=r"flip\.npz"):
        read_sweep(tmp_path / "flip.npz")
    with pytest.raises(DataFileNotFoundError, match=r"none\.npz"):
        read_sweep(tmp_path / "none.npz")


def test_the_whiskers_are_those_of_the_mouse_in_the_order_of_the_array():
    from brainbench.stimuli import WhiskerArray

    assert CELLS.tolist() == [mount.row * 7 + mount.col for mount in WhiskerArray.mouse()]


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return write_tree(tmp_path_factory.mktemp("tree"))


@pytest.mark.shared
def test_the_reference_tree_gives_the_input_of_the_published_networks(reference, tmp_path):
    zipfile.ZipFile(reference / "published" / "sweep_tree.zip").extractall(tmp_path)
    (tmp_path / "categories.json").write_text((reference / "published" / "categories.json").read_text())
    names = {"train": "train", "validation": "validate", "test": "test"}
    for split, name in names.items():
        data = WhiskingDataset(tmp_path, split=split, batch_size=2, shuffle=False)
        (x, y) = next(iter(data))
        files = []
        for number in range(2):
            # A file left open is closed, with a warning, during whatever test comes then.
            with np.load(tmp_path / name / f"{number:08d}.npz") as stored:
                files.append(dict(stored))
        # Channel 6 · sub-step + component, five samples to a step, cells row by row; mN and µN·m.
        raw = np.stack([f["data"].reshape(22, 5, 5, 7, 6).transpose(0, 1, 4, 2, 3) for f in files])
        raw = raw * np.repeat([1e-3, 1e-6], 3)[:, None, None]
        np.testing.assert_allclose(x.numpy(), raw.reshape(2, 22, 30, 5, 7), rtol=1e-6)
        assert y.tolist() == [int(f["label"]) for f in files]
        assert [data.classes[label] for label in y.tolist()] == [str(f["shape"]).split("/")[0] for f in files]
    assert len(data.classes) == 117
    assert data.manifest["faults"]["repeated"] == 36


def test_sweeps_are_shuffled_and_batches_go_on_where_a_state_was_saved(tree):
    first, second = (WhiskingDataset(tree, batch_size=2, seed=3) for _ in range(2))
    kept = []
    for number, (x, y) in enumerate(first):
        if number == 0:
            state = json.loads(json.dumps(first.state_dict()))
        else:
            kept.append((x.clone(), y))
    assert first.order(0).tolist() != sorted(first.order(0).tolist())
    second.load_state_dict(state)
    for (x, y), (again, label) in zip(kept, second, strict=True):
        np.testing.assert_array_equal(x.numpy(), again.numpy())
        assert y.tolist() == label.tolist()


def test_a_damaged_list_in_the_cache_is_made_again(tree, monkeypatch, tmp_path, caplog):
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    conversion._open.cache_clear()
    classes = conversion.open_sweep_tree(tree).classes
    (kept,) = [path for path in (tmp_path / "sweep-files").iterdir() if path.suffix != ".seal"]
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2])
    conversion._open.cache_clear()
    assert conversion.open_sweep_tree(tree).classes == classes
    assert "made again" in caplog.text
    assert kept.read_bytes() == whole


def test_classes_keep_their_numbers_and_take_names_from_the_shapes(tree):
    assert WhiskingDataset(tree, batch_size=2).classes == ("03211117", "class-1", "04530566", "class-3", "03593526")
    assert WhiskingDataset(tree, split="all", batch_size=2).sweeps == 16


def test_names_come_from_the_categories_beside_the_sweeps(tmp_path):
    write_tree(tmp_path)
    (tmp_path / "categories.json").write_text(json.dumps({"02691156/plane": 1, "02691156/jet": 3, "0/x": 3, "9/y": 5}))
    names = WhiskingDataset(tmp_path, batch_size=2).classes
    assert names == ("03211117", "02691156/plane", "04530566", "class-3", "03593526", "9")


def test_sweeps_without_a_label_are_left_out_and_all_faults_are_said_once(tmp_path, caplog):
    write_tree(tmp_path, rate=110)
    write_sweep(tmp_path / "train" / "a.npz", label="?", rate=110)
    write_sweep(tmp_path / "train" / "b.npz", leave_out=("label",), rate=110)
    data = sweep_data(3, cells=30)
    data[4, 2, 0], data[5, 2, 0], data[0, 1, 1] = np.nan, 2e3, 1.0
    write_sweep(tmp_path / "train" / "c.npz", data=data, rate=110)
    sets = [WhiskingDataset(tmp_path, split=split, batch_size=2) for split in ("all", "train")]
    assert sets[0].manifest["left_out"] == 2
    assert sets[0].manifest["faults"] == {"repeated": 0, "too large": 1, "missing": 1, "unwritten": 1}
    assert (sets[1].sweeps, sets[1].skipped) == (8, 1)
    zeros = WhiskingDataset(tmp_path, batch_size=9, shuffle=False, unstable="zero", view="raw")
    assert np.isfinite(next(iter(zeros)).input.numpy()).all()
    assert len(caplog.records) == 1
    assert "2 sweeps have no label" in caplog.text


def test_a_file_that_changed_is_found(tmp_path):
    write_tree(tmp_path)
    data = WhiskingDataset(tmp_path, split="test", batch_size=2)
    data.verify()
    write_sweep(tmp_path / "test" / "00000001.npz", seed=77)
    with pytest.raises(DataError, match=r"00000001\.npz"):
        data.verify()
    assert WhiskingDataset(tmp_path, split="test", batch_size=2).state_dict() != data.state_dict()


def _mix(folder):
    write_sweep(folder / "test" / "z.npz", rate=110)


def _damage(folder):
    os.truncate(folder / "test" / "00000002.npz", 900)


def _relabel(folder):
    (folder / "categories.json").write_text('{"04530566/boat": 3}')


def _list_categories(folder):
    (folder / "categories.json").write_text('["04530566/boat"]')


def _number_wildly(folder):
    write_sweep(folder / "test" / "z.npz", label=10**9)


@pytest.mark.parametrize(
    ("spoil", "culprit"),
    [
        (_mix, "1000 Hz"),
        (_damage, r"00000002\.npz"),
        (_relabel, "04530566/boat"),
        (_list_categories, r"categories\.json"),
        (_number_wildly, "1000000000"),
    ],
)
def test_a_folder_that_cannot_be_used_is_refused_before_any_batch(tmp_path, spoil, culprit):
    spoil(write_tree(tmp_path))
    with pytest.raises(DataError, match=culprit):
        WhiskingDataset(tmp_path, batch_size=2)


def test_folders_without_sweeps_labels_or_splits_are_refused(tmp_path):
    (tmp_path / "empty" / "train").mkdir(parents=True)
    with pytest.raises(DataError, match="train"):
        WhiskingDataset(tmp_path / "empty")
    with pytest.raises(DataError, match="label"):
        WhiskingDataset(write_tree(tmp_path / "mute", leave_out=("label",)))
    write_sweep(tmp_path / "flat" / "0.npz")
    with pytest.raises(DataError, match="train, validate and test"):
        WhiskingDataset(tmp_path / "flat")
    with pytest.raises(DataError, match="'validation'"):
        WhiskingDataset(write_tree(tmp_path / "part", (4, 0, 2)), split="validation", batch_size=2)
