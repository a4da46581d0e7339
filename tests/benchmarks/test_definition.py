"""What the file of a benchmark states: written and read back, hashed, and refused in one sentence."""

from __future__ import annotations

import pytest

from brainbench.benchmarks.definition import Benchmark, Ceilings, Recordings, check_inside
from brainbench.core.errors import DataError, UsageError
from brainbench.core.reading.texts import parse_toml
from leaderboards.held_out import Commitment

DIGEST = "0" * 64


def _benchmark(**changes) -> Benchmark:
    stated = {
        "name": "lab",
        "recordings": Recordings("data", "0123456789abcdef", doi="10.1/2"),
        "options": {"conditions": "trials:texture", "bin": 0.5, "seed": 3},
        "match": {'the "left" one': "concave", "dröpped": ""},
        "files": {"data/a b.h5": DIGEST},
        "ceiling": Ceilings(4, 8, 0.9, None, 0.5, 0.7),
        "held_out": Commitment("animals", 2, 4, "abc", "def"),
        "citation": "Doé J. (2026)",
    }
    return Benchmark(**(stated | changes))


def test_a_file_read_back_is_the_benchmark_that_was_written():
    benchmark = _benchmark()
    again = Benchmark.stated_by(parse_toml(benchmark.to_toml(), "x"), "x", sealed=True)
    assert again == benchmark
    assert again.identity == benchmark.identity
    assert type(again.options["seed"]) is int
    assert type(again.options["bin"]) is float


@pytest.mark.parametrize("change", [{"citation": "Roe"}, {"options": {}}, {"files": {}}, {"match": {}}])
def test_every_statement_counts_in_the_hash(change):
    assert _benchmark(**change).identity != _benchmark().identity


def test_an_edited_file_is_refused_until_its_hash_is_taken_out():
    text = _benchmark().to_toml().replace("Doé", "Roe")
    with pytest.raises(DataError, match=r"was edited: it states the hash .* take out the line 'hash'"):
        Benchmark.stated_by(parse_toml(text, "x"), "x", sealed=False)
    unsealed = text.partition("\n")[2]
    assert Benchmark.stated_by(parse_toml(unsealed, "x"), "x", sealed=False).citation == "Roe J. (2026)"
    with pytest.raises(DataError, match=r"states the hash None"):
        Benchmark.stated_by(parse_toml(unsealed, "x"), "x", sealed=True)


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        ("conditions =", "condition =", "option of a benchmark 'condition'; did you mean 'conditions'"),
        ("content_hash =", "contenthash =", "entry of recordings 'contenthash'; did you mean 'content_hash'"),
        ("citation =", "citaton =", "entry of a benchmark 'citaton'; did you mean 'citation'"),
        ("animals = 4", 'animals = "4"', "ceiling.animals is '4'; expected an integer"),
        ("animals = 4", "animals = 0", "ceiling.animals is 0; expected an integer >= 1|at least 1"),
        (f'"data/a b.h5" = "{DIGEST}"', '"data/a b.h5" = "00"', "an entry of files is wrong"),
        ('name = "lab"', 'name = "../lab"', "name of a benchmark has letters"),
        ('path = "data"', 'path = "/data"', "'/data', which is no place in its own folder"),
        ('kind = "animals"', 'kind = "units"', "held_out.kind is 'units'; expected one of 'animals', 'stimuli'"),
        ("schema = 1", "schema = 2", "schema is 2; expected one of 1"),
        ("seed = 3", "seed = [3]", "options"),
    ],
)
def test_a_wrong_entry_is_one_sentence(before, after, sentence):
    text = _benchmark().to_toml().partition("\n")[2]
    assert before in text
    with pytest.raises(DataError, match=f"^the file.*{sentence}") as error:
        Benchmark.stated_by(parse_toml(text.replace(before, after), "x"), "the file", sealed=False)
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("name", ["/a", "../a", "a/../b", "a//b", "c:\\a", "a\\b", "a\nb", "", "a/.", "~\u202ea"])
def test_a_name_that_leaves_the_folder_is_refused(name):
    with pytest.raises(UsageError, match=r"no place in its own folder"):
        check_inside(name)


def test_names_within_the_folder_pass():
    for name in ("a.h5", "data/a b.nwb", "data/*.nwb", "größe.nwb", ".hidden/..x"):
        check_inside(name)


def test_a_record_states_what_is_not_empty():
    stated = _benchmark().stated
    assert stated == {"name": "lab", "hash": _benchmark().identity, "citation": "Doé J. (2026)", "doi": "10.1/2"}
