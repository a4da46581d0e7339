import json
import zipfile

import numpy as np
import pytest

from brainbench.datasets import WhiskingDataset
from brainbench.stimuli import load_stimuli
from tests.factories.published_files import sweep_data, write_run, write_sweep, write_tree


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    folder = write_tree(tmp_path_factory.mktemp("published") / "tree", (16, 4, 4), rate=110)
    write_sweep(folder / "train" / "mute.npz", label="?", rate=110)
    return folder


def test_a_converted_folder_gives_the_batches_of_the_folder_itself(run, tree, tmp_path):
    made = json.loads(run("stimuli", "convert", str(tree), str(tmp_path / "set"), "--json").out)
    assert (made["kind"], made["rate_hz"], made["sweeps"], made["left_out"]) == ("data set", 110, 24, 1)
    manifest = json.loads((tmp_path / "set" / "manifest.json").read_text())
    assert manifest["left_out"] == 1
    for split in ("train", "validation", "test"):
        theirs, ours = (WhiskingDataset(folder, split=split, batch_size=3) for folder in (tree, tmp_path / "set"))
        ours.verify()
        assert ours.classes == theirs.classes
        assert ours.objects.tolist() == theirs.objects.tolist()
        for (x, y), (again, label) in zip(theirs, ours, strict=True):
            np.testing.assert_array_equal(x.numpy(), again.numpy())
            assert y.tolist() == label.tolist()


@pytest.mark.shared
def test_the_reference_tree_converts_to_the_same_bytes_each_time(run, reference, tmp_path):
    zipfile.ZipFile(reference / "published" / "sweep_tree.zip").extractall(tmp_path / "tree")
    hashes = []
    for name in ("one", "two"):
        made = json.loads(run("stimuli", "convert", str(tmp_path / "tree"), str(tmp_path / name), "--json").out)
        assert {key: split["sweeps"] for key, split in made["splits"].items()} == dict.fromkeys(made["splits"], 2)
        assert made["faults"]["repeated"] == 36
        hashes.append(made["content_hash"])
    assert hashes[0] == hashes[1]


def test_networks_are_trained_and_classes_separated_on_the_folder_as_it_is(run, tree, tmp_path):
    options = ("--epochs", "1", "--batch-size", "8", "--device", "cpu", "--augmentation", "none")
    trained = run("train", "s4-small", "--data", str(tree), "--out", str(tmp_path / "run"), *options)
    assert trained.status == 0, trained.err
    assert "finished" in trained.out
    assert (tmp_path / "run" / "best").is_dir()
    for place, shape in enumerate(("03211117/a", "03211117/b", "04530566/c", "04530566/d") * 3):
        label = 0 if shape < "04" else 1
        write_sweep(tmp_path / "pair" / "train" / f"{place}.npz", place, shape=shape, label=label)
    data = ("stimuli", "separability", str(tmp_path / "pair"), "--counts", "2", "--json")
    (found,) = json.loads(run(*data).out)["results"]
    assert (found["choices"], found["objects"], found["sweeps"]) == ([["03211117", "04530566"]], 4, 12)


def test_a_run_becomes_a_set_and_a_run_again(run, tmp_path):
    dynamics = np.round(np.random.default_rng(0).normal(size=(110, 2, 6)), 4)
    dynamics[8, 1, 3] = np.nan
    write_run(tmp_path / "a", dynamics)
    made = json.loads(run("stimuli", "convert", str(tmp_path / "a"), str(tmp_path / "a.h5"), "--json").out)
    assert (made["stimuli"], made["unstable"], made["faults"]["a"]["missing"]) == (["a"], 1, 1)
    back = run("stimuli", "convert", str(tmp_path / "a.h5"), str(tmp_path / "back"))
    assert back.status == 0
    assert "mN" in back.out
    # A run of 110 rows is taken as one second, whatever its stimulus lasted.
    assert "with --rate 110\n" in back.out
    written = np.loadtxt(tmp_path / "back" / "dynamics" / "Mx.csv", delimiter=",")
    np.testing.assert_allclose(written, dynamics[:, :, 3], rtol=2e-7)
    assert (tmp_path / "back" / "whisker_ID.csv").read_text() == "RC1\nRC2\n"
    again = run("stimuli", "convert", str(tmp_path / "a.h5"), str(tmp_path / "back"))
    assert again.status == 2
    assert "back" in again.err
    assert run("stimuli", "show", str(tmp_path / "a.h5")).status == 0
    clean = ("stimuli", "convert", str(tmp_path / "a"), str(tmp_path / "clean.h5"), "--cleaning", "published")
    assert run(*clean).status == 0
    assert load_stimuli(tmp_path / "clean.h5").input[0, 1, 3 * 6 + 3, 2, 2] == 0.0
    assert run("stimuli", "plot", str(tmp_path / "clean.h5"), "--out", str(tmp_path / "a.png")).status == 0


def test_single_sweeps_become_stimuli_that_say_which_frames_were_filled(run, tmp_path):
    data = sweep_data(1)
    data[50, 16] = data[49, 16]
    write_sweep(tmp_path / "sweeps" / "one.npz", data=data)
    write_sweep(tmp_path / "sweeps" / "two.npz", seed=2)
    made = json.loads(run("stimuli", "convert", str(tmp_path / "sweeps"), str(tmp_path / "s.h5"), "--json").out)
    assert made["faults"] == {"one": {"repeated": 6}}
    stimuli = load_stimuli(tmp_path / "s.h5")
    assert stimuli.labels == ("one", "two")
    np.testing.assert_allclose(stimuli.input[0, 3, 2 * 6 + 1].reshape(-1), data[17, :, 1] * 1e-3, rtol=1e-6)
    assert stimuli.dataset["frame_status"].sel(stimulus="one", whisker="C2").values.nonzero()[0].tolist() == [50]
    assert run("stimuli", "convert", str(tmp_path / "sweeps" / "one.npz"), str(tmp_path / "1.h5")).status == 0


def _mixed(folder):
    write_sweep(folder / "a.npz")
    write_sweep(folder / "b.npz", rate=110)
    return folder, folder / "set.h5"


@pytest.mark.parametrize(
    ("make", "options", "culprit"),
    [
        (lambda f: (f / "none", f / "o.h5"), (), "none"),
        (lambda f: (f, f / "o.h5"), (), "nothing to convert"),
        (_mixed, (), "'110', '1000'"),
        (lambda f: (write_run(f / "a", np.zeros((110, 2, 6))), f / "o"), (), ".h5"),
        (lambda f: (write_run(f / "a", np.zeros((99, 2, 6))), f / "o.h5"), (), "--rate"),
        (lambda f: (write_run(f / "a", np.zeros((110, 2, 6))), f / "o.h5"), ("--stimulus", "a"), "--stimulus"),
        (lambda f: (write_tree(f / "t", (1, 1, 1)), f / "o.h5"), (), "o.h5"),
        (lambda f: (write_tree(f / "t", (1, 1, 1)), f / "o"), ("--rate", "9"), "--rate"),
        (lambda f: (write_tree(f / "t", (1, 1, 1)), f / "t"), (), "not empty"),
        (lambda f: (write_sweep(f / "a.npz", leave_out=("shape",)), f / "o.h5"), (), "a.npz"),
    ],
)
def test_what_cannot_be_converted_is_answered_in_one_line(run, tmp_path, make, options, culprit):
    source, out = make(tmp_path)
    outcome = run("stimuli", "convert", str(source), str(out), *options)
    assert outcome.status in (1, 2)
    assert culprit in outcome.err
    assert "Traceback" not in outcome.err
    assert out.suffix != ".h5" or not out.exists()
