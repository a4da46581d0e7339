import h5py
import numpy as np
import pytest
import rsatoolbox
from rsatoolbox.data import Dataset

from brainbench.core.errors import DataError
from brainbench.datasets import StoredRDMs, open_recordings, read_rdms, write_rdms


def stored(**changes):
    values = np.random.default_rng(0).uniform(size=(2, 6))
    values[1, 2] = np.nan
    more = {"measure": "correlation", "columns": {"reliability": [0.5, 0.75]}, "about": {"window": "start..stop"}}
    return StoredRDMs(values, tuple("abcd"), ("m1", "m2"), **(more | changes))


def test_rsatoolbox_reads_what_we_write_and_we_what_it_writes(tmp_path):
    ours = stored()
    theirs = rsatoolbox.rdm.load_rdm(str(write_rdms(tmp_path / "a.h5", ours)))
    np.testing.assert_array_equal(theirs.dissimilarities, ours.values)
    assert theirs.dissimilarity_measure == "correlation"
    assert [*theirs.pattern_descriptors["stimulus"]] == [*"abcd"]
    assert [*theirs.rdm_descriptors["subject"]] == ["m1", "m2"]
    theirs.save(str(tmp_path / "b.h5"))
    again = read_rdms(tmp_path / "b.h5")
    np.testing.assert_array_equal(again.values, ours.values)
    assert (again.stimuli, again.names, again.measure, dict(again.about)) == (
        ours.stimuli, ours.names, ours.measure, ours.about,
    )  # fmt: skip
    assert again.columns == ours.columns


@pytest.mark.parametrize(
    ("descriptors", "names", "note"),
    [
        ({"conds": ["x", "y", "z"]}, ("x", "y", "z"), ""),
        ({"conds": ["x", "y", "z"], "stimulus": ["p", "q", "r"]}, ("p", "q", "r"), ""),
        ({"conds": ["x", "y", "z"], "class": ["s", "s", "t"]}, ("x", "y", "z"), ""),
        ({"conds": ["x", "y", "z"], "name": ["p", "q", "r"]}, ("x", "y", "z"), "'conds' of 'conds', 'name'"),
        ({"angle": [0.5, 1.0, 90.0]}, ("0.5", "1", "90"), ""),
        ({}, ("1", "2", "3"), ""),
        ({"stimulus": ["x", "x", "z"]}, ("1", "2", "3"), "numbered, since 'stimulus' does not tell all of them apart"),
        ({"stimulus": ["x", "nan", "z"]}, ("1", "2", "3"), "numbered, since 'stimulus' does not tell"),
        ({"stimulus": ["x", "x", "z"], "name": ["p", "q", "r"]}, ("p", "q", "r"), "by 'name', since 'stimulus'"),
        ({"place": [[0, 1], [0, 2], [3, 4]], "name": ["p", "q", "r"]}, ("p", "q", "r"), ""),
    ],
)
def test_stimuli_have_the_names_of_the_descriptor_that_tells_them_apart(tmp_path, descriptors, names, note):
    values = np.random.default_rng(0).normal(size=(1, 3))
    rsatoolbox.rdm.RDMs(values, pattern_descriptors=descriptors).save(str(tmp_path / "a.h5"))
    rdms = read_rdms(tmp_path / "a.h5")
    assert rdms.stimuli == names
    assert note in rdms.note
    assert bool(note) == bool(rdms.note)
    assert rdms.names == ("1",)


def test_several_rdms_of_an_animal_keep_its_name(tmp_path):
    values = np.random.default_rng(0).normal(size=(3, 6))
    descriptors = {"subject": ["m1", "m2", "m1"], "session": [1, 1, 2]}
    rsatoolbox.rdm.RDMs(values, rdm_descriptors=descriptors).save(str(tmp_path / "a.h5"))
    rdms = read_rdms(tmp_path / "a.h5")
    assert rdms.names == ("m1 (1)", "m2 (1)", "m1 (2)")
    assert rdms.columns == {"session": [1, 1, 2]}


@pytest.mark.filterwarnings("ignore:invalid value encountered in cast")  # of rsatoolbox
@pytest.mark.parametrize("method", ["euclidean", "correlation", "mahalanobis", "crossnobis", "poisson"])
def test_every_dissimilarity_of_rsatoolbox_is_read_as_it_is_and_long_facts_are_cut(tmp_path, method):
    folds = {"stimulus": np.repeat([*"abcd"], 4), "run": np.tile(range(4), 4)}
    data = Dataset(np.random.default_rng(0).uniform(1, 2, size=(16, 5)), obs_descriptors=folds)
    more = {"cv_descriptor": "run", "noise": np.eye(5)} if method == "crossnobis" else {}
    theirs = rsatoolbox.rdm.calc_rdm(data, method=method, descriptor="stimulus", **more)
    theirs.save(str(tmp_path / "rdms.pkl"))  # the ending says nothing: it writes HDF5 by default
    ours = read_rdms(tmp_path / "rdms.pkl")
    np.testing.assert_array_equal(ours.values, theirs.dissimilarities)
    assert (ours.measure, ours.stimuli) == (theirs.dissimilarity_measure, (*"abcd",))
    assert all(len(text) < 80 for text in ours.about.values())


def replaced(place, values):
    def edit(file):
        del file[place]
        if values is None:
            file.create_group(place)
        else:
            file[place] = values

    return edit


BROKEN = {
    "five pairs": (replaced("dissimilarities", np.ones((2, 5))), "5 dissimilarities .* no pairs"),
    "squares": (replaced("dissimilarities", np.ones((2, 4, 4))), r"shape \[2, 4, 4\]"),
    "texts": (replaced("dissimilarities", np.array([[b"a"] * 6])), "shape"),
    "a group": (replaced("dissimilarities", None), "shape"),
    "infinite": (replaced("dissimilarities", np.full((2, 6), np.inf)), "infinite"),
    "names of three": (
        replaced("pattern_descriptors/stimulus", np.array([b"a", b"b", b"c"])),
        "3 values for 4 stimuli",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_sentence(tmp_path, name):
    edit, expected = BROKEN[name]
    with h5py.File(write_rdms(tmp_path / "a.h5", stored()), "a") as file:
        edit(file)
    with pytest.raises(DataError, match=expected):
        read_rdms(tmp_path / "a.h5")


def test_other_files_hold_no_rdms_and_rdms_are_no_recordings(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    assert read_rdms(tmp_path / "other.h5") is None
    write_rdms(tmp_path / "a.h5", stored())
    with pytest.raises(DataError, match="RDMs without trials, whose noise nobody can estimate"):
        open_recordings(tmp_path / "a.h5")
    with pytest.raises(DataError, match="'é' of 'stimulus' is no ASCII text"):
        write_rdms(tmp_path / "b.h5", StoredRDMs(np.ones((1, 3)), ("é", "b", "c"), ("m",)))
