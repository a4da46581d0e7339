import json
from pathlib import Path

import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.labels import join_labels, read_match


def test_equal_labels_pair_in_the_order_of_the_recordings():
    assert list(join_labels(("b", "a"), ("a", "b"), None).items()) == [("b", "b"), ("a", "a")]


def test_unmatched_labels_list_both_sides():
    with pytest.raises(UsageError) as caught:
        join_labels(("a", "face"), ("a", "cube"), None)
    text = str(caught.value)
    assert "without a stimulus: 'face'" in text
    assert "without recordings: 'cube'" in text
    assert "equal on both sides: 1" in text
    assert "--match" in text


def test_a_match_pairs_drops_and_leaves_extra_stimuli_out():
    pairs = join_labels(("a", "face", "nothing"), ("a", "cube", "spare"), {"face": "cube", "nothing": None})
    assert pairs == {"a": "a", "face": "cube"}


@pytest.mark.parametrize(
    ("match", "message"),
    [
        ({"fcae": "cube"}, "'fcae', which is no label"),
        ({"face": "cubus"}, "'cubus', which is no stimulus"),
        ({"face": "a"}, "Two recording labels"),
    ],
)
def test_a_wrong_match_is_refused(match: dict[str, str], message: str):
    with pytest.raises(UsageError, match=message):
        join_labels(("a", "face"), ("a", "cube"), match)


def test_match_files_of_three_kinds_say_the_same(tmp_path: Path):
    expected = {"1": "face", "2": None}
    (tmp_path / "m.json").write_text(json.dumps(expected))
    (tmp_path / "m.csv").write_text("1,face\n2,\n")
    (tmp_path / "m.toml").write_text('1 = "face"\n2 = ""\n')
    assert (
        read_match(tmp_path / "m.json") == read_match(tmp_path / "m.csv") == read_match(tmp_path / "m.toml") == expected
    )


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.txt", "", "ends in .json, .toml or .csv"),
        ("m.csv", "a,b,c\n", "two columns"),
        ("m.json", "[1]", "holds a list"),
        ("m.csv", "a,x\nb,y\na,z\n", "'a' more than once"),
        ("m.json", '{"a": "x", "b": "y", "a": "z"}', "'a' twice"),
        ("m.toml", "= 3", "not valid TOML"),
    ],
)
def test_a_wrong_match_file_is_refused(tmp_path: Path, name: str, text: str, message: str):
    (tmp_path / name).write_text(text)
    with pytest.raises((UsageError, DataError), match=message):
        read_match(tmp_path / name)
    with pytest.raises(UsageError, match=r"/none\.json'"):
        read_match(tmp_path / "none.json")
