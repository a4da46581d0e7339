"""Files of benchmarks: packed, unpacked within bounds, found by name, and every byte compared."""

from __future__ import annotations

import os
import stat
import zipfile
from pathlib import Path

import pytest

from brainbench.benchmarks import files
from brainbench.benchmarks.files import (
    DEFINITION,
    Benchmark,
    Ceilings,
    Recordings,
    add,
    check_inside,
    files_named_in,
    list_benchmarks,
    open_benchmark,
    pack,
)
from brainbench.core.errors import BrainbenchError, DataError, DataFileNotFoundError, UsageError
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


@pytest.fixture
def packed(lab: Path) -> Path:
    pack(lab / "lab.toml", lab / "lab.zip")
    return lab / "lab.zip"


def _rewrite(path: Path, change) -> None:
    """Write an archive again with its members changed: name → bytes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members = change(members)
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def test_a_packed_benchmark_opens_as_it_was_with_equal_bytes_each_time(lab, packed, laboratory):
    benchmark, folder = open_benchmark(packed)
    assert benchmark == laboratory[1]
    assert all((folder / name).read_bytes() == (lab / name).read_bytes() for name in benchmark.files)
    os.utime(lab / "eight.h5", (1, 1))
    pack(lab / "lab.toml", lab / "again.zip")
    assert (lab / "again.zip").read_bytes() == packed.read_bytes()


def test_a_damaged_file_in_the_cache_is_unpacked_again(packed):
    _, folder = open_benchmark(packed)
    (folder / "eight.h5").write_bytes(b"another")
    folder = open_benchmark(packed)[1]
    assert (folder / "eight.h5").stat().st_size > 100


def test_a_changed_byte_beside_the_toml_is_refused(lab):
    data = bytearray((lab / "data" / "w.h5").read_bytes())
    data[-1] ^= 1
    (lab / "data" / "w.h5").write_bytes(data)
    with pytest.raises(DataError, match=r"'data/w.h5' is not the file that the benchmark 'lab' lists"):
        open_benchmark(lab / "lab.toml")


def test_a_missing_file_says_where_to_get_it(lab):
    (lab / "eight.h5").unlink()
    with pytest.raises(DataFileNotFoundError, match=r"no file of the benchmark 'lab' .*eight.h5.* Get it from 10.1/2"):
        open_benchmark(lab / "lab.toml")


def test_a_link_out_of_the_folder_is_refused(lab, tmp_path):
    (lab / "eight.h5").rename(tmp_path / "eight.h5")
    (lab / "eight.h5").symlink_to(tmp_path / "eight.h5")
    with pytest.raises(DataError, match=r"is a link out of the folder of the benchmark"):
        open_benchmark(lab / "lab.toml")


def _changed_byte(members):
    data = bytearray(members["eight.h5"])
    data[100] ^= 1
    return members | {"eight.h5": bytes(data)}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (_changed_byte, "'eight.h5' is not the file that the benchmark 'lab' lists"),
        (lambda members: members | {"../out": b"x"}, r"holds '\.\./out', which it does not list"),
        (lambda members: members | {"more.h5": b"x"}, "holds 'more.h5', which it does not list"),
        (
            lambda members: {name.replace("eight", "eigth"): data for name, data in members.items()},
            "lacks 'eight.h5', which it lists; it holds 'eigth.h5' instead",
        ),
        (
            lambda members: {f"lab/{name}": data for name, data in members.items()},
            "holds no 'benchmark.toml'; its 'lab/benchmark.toml' stands elsewhere",
        ),
        (lambda members: {}, "holds no 'benchmark.toml': make one with brainbench benchmark pack"),
        (
            lambda members: members | {DEFINITION: members[DEFINITION].replace(b"seed = 1", b"seed = 2")},
            "was edited: it states the hash",
        ),
        (
            lambda members: members | {DEFINITION: members[DEFINITION].replace(b"data/w.h5", b"../w.h5")},
            r"'\.\./w.h5', which is no place in its own folder",
        ),
        (lambda members: members | {DEFINITION: b"\xff\xfe"}, "benchmark"),
    ],
)
def test_a_changed_archive_is_refused_in_one_sentence(packed, change, sentence):
    _rewrite(packed, change)
    with pytest.raises(DataError, match=sentence) as error:
        open_benchmark(packed)
    assert len(str(error.value)) < 400


def test_a_link_in_an_archive_is_refused(packed):
    entry = zipfile.ZipInfo("link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(packed, "a") as archive:
        archive.writestr(entry, "/etc/passwd")
    with pytest.raises(DataError, match=r"holds a link, 'link'"):
        open_benchmark(packed)


def test_a_member_that_stands_twice_is_refused(packed):
    with zipfile.ZipFile(packed, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("eight.h5", b"x")
    with pytest.raises(DataError, match=r"holds 'eight.h5' twice"):
        open_benchmark(packed)


def test_a_bomb_is_refused_before_anything_is_unpacked(packed):
    """An archive that declares far more than it stores."""
    with zipfile.ZipFile(packed, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb", b"")
    data = packed.read_bytes()
    place = data.rindex(b"PK\x01\x02")  # its entry in the directory, the last
    for offset in (20, 24):
        data = data[: place + offset] + (0xFFFFFFF0).to_bytes(4, "little") + data[place + offset + 4 :]
    packed.write_bytes(data)
    with pytest.raises(DataError, match=r"unpacks to 4,29.* bytes; it is damaged or no benchmark"):
        open_benchmark(packed)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"text"])
def test_what_is_no_archive_is_refused(tmp_path, content):
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(DataError, match=r"not a readable benchmark"):
        open_benchmark(tmp_path / "a.zip")


def test_names_come_from_packages_and_from_the_user(packed, monkeypatch):
    monkeypatch.setattr(files, "load_entry_points", lambda group, take: take("of-a-package", packed))
    monkeypatch.setattr(files, "added_folder", lambda: packed.parent / "settings")
    assert open_benchmark("of-a-package")[0].name == "lab"
    add(packed)
    assert [*list_benchmarks()] == ["of-a-package", "lab"]
    assert open_benchmark("lab")[0] == open_benchmark(packed)[0]
    with pytest.raises(UsageError, match=r"Unknown benchmark 'lba'; did you mean 'lab'"):
        open_benchmark("lba")


def test_another_benchmark_of_a_name_is_not_replaced(packed, lab, monkeypatch):
    monkeypatch.setattr(files, "added_folder", lambda: packed.parent / "settings")
    add(packed)
    add(packed)  # the same again changes nothing
    text = (lab / "lab.toml").read_text().partition("\n")[2].replace("Doe", "Roe")
    (lab / "lab.toml").write_text(text)
    with pytest.raises(UsageError, match=r"There is already a benchmark 'lab'"):
        add(lab / "lab.toml")


def test_a_file_of_another_kind_is_told_from_a_name(lab):
    with pytest.raises(BrainbenchError, match=r"Unknown benchmark .* give a file that ends in .toml or .zip"):
        open_benchmark(lab / "eight.h5")


def test_a_scene_brings_the_files_that_it_names(tmp_path):
    for name in ("a.csv", "b.csv", "shape.stl"):
        (tmp_path / name).touch()
    values = {"whisking": {"path": "{trial}.csv"}, "object": [{"mesh": {"path": "shape.stl"}}], "unit": "mm", "n": 3}
    names = [path.name for path in files_named_in(tmp_path / "scene.toml", values)]
    assert names == ["a.csv", "b.csv", "shape.stl"]
