"""A benchmark in place of the options of a score: what is the benchmark's, and what stays the caller's."""

from __future__ import annotations

import os
import re
import stat
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from brainbench.benchmarks import opening
from brainbench.benchmarks.opening import (
    DEFINITION,
    Benchmark,
    Ceilings,
    Recordings,
    add,
    check,
    check_inside,
    files_named_in,
    list_benchmarks,
    make,
    open_benchmark,
    open_for_score,
    options_of,
    pack,
)
from brainbench.core.errors import BrainbenchError, DataError, DataFileNotFoundError, UsageError
from brainbench.core.files import file_hash
from brainbench.core.reading.texts import parse_toml
from brainbench.scoring.options import ScoreOptions
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
        "held_out": Commitment("animals", 2, 4, "abc", DIGEST),
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


@pytest.mark.parametrize(
    "name",
    [
        "/a",
        "../a",
        "a/../b",
        "a//b",
        "c:\\a",
        "a\\b",
        "a\nb",
        "",
        "a/.",
        "~\u202ea",
        "a.",
        "a /b",
        "aux.nwb",
        "a" * 250,
    ],
)
def test_a_name_that_leaves_the_folder_is_refused(name):
    with pytest.raises(UsageError, match=r"no place in its own folder"):
        check_inside(name)


@pytest.mark.parametrize(
    "names",
    [("data/A.nwb", "data/a.nwb"), ("data/é", "data/e\u0301"), ("data", "data/a.nwb"), ("Benchmark.toml",)],
    ids=["capitals", "Unicode", "folder", "definition"],
)
def test_files_that_are_one_on_some_system_are_refused(names):
    with pytest.raises(UsageError, match=r"which is one with another of its files, or a folder of them") as error:
        _benchmark(files=dict.fromkeys(names, DIGEST))
    assert repr(names[0]) in str(error.value)


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
    with pytest.raises(DataError, match=r"holds 'link', which it does not list"):
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
    monkeypatch.setattr(opening, "load_entry_points", lambda group, take: take("of-a-package", packed))
    monkeypatch.setattr(opening, "added_folder", lambda: packed.parent / "settings")
    assert open_benchmark("of-a-package")[0].name == "lab"
    add(packed)
    assert [*list_benchmarks()] == ["of-a-package", "lab"]
    assert open_benchmark("lab")[0] == open_benchmark(packed)[0]
    with pytest.raises(UsageError, match=r"Unknown benchmark 'lba'; did you mean 'lab'"):
        open_benchmark("lba")


def test_another_benchmark_of_a_name_is_not_replaced(packed, lab, monkeypatch):
    monkeypatch.setattr(opening, "added_folder", lambda: packed.parent / "settings")
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


def test_the_benchmarks_options_take_the_place_of_the_callers(lab):
    given = ScoreOptions(benchmark=lab / "lab.toml", layer="fc", weights_seed=7, memory=1.0)
    options = open_for_score(given).options
    assert options == ScoreOptions(
        recordings=str(lab / "data"), conditions="trials:texture", stimuli=str(lab / "eight.h5"), seed=1,
        layer="fc", weights_seed=7, memory=1.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("options", "explicit", "sentence"),
    [
        ({"metric": "cka"}, (), "metric is a matter of the benchmark 'lab', which states 'rsa'; received 'cka'"),
        ({"recordings": "other"}, (), "recordings is a matter of the benchmark 'lab', which states 'data'"),
        ({"match": {"a": "b"}}, (), "match is a matter of the benchmark 'lab'"),
        ({"seed": 0}, ("seed",), "seed is a matter of the benchmark 'lab', which states 1; received 0"),
        ({"title": "x"}, (), "title is a matter"),
    ],
)
def test_options_that_contradict_it_are_refused(lab, options, explicit, sentence):
    with pytest.raises(UsageError, match=sentence):
        open_for_score(ScoreOptions(benchmark=lab / "lab.toml", **options), explicit)


def test_options_that_say_the_same_pass(lab):
    given = ScoreOptions(benchmark=lab / "lab.toml", conditions="trials:texture", metric="rsa")
    assert open_for_score(given, ("conditions", "metric")).options.seed == 1


def test_a_file_put_beside_the_recordings_is_refused(lab):
    (lab / "data" / "more.h5").write_bytes((lab / "data" / "w.h5").read_bytes())
    with pytest.raises(DataError, match=r"'data' holds or names 'more.h5', which the benchmark 'lab' does not list"):
        open_for_score(ScoreOptions(benchmark=lab / "lab.toml"))


def test_a_scene_that_names_a_file_elsewhere_is_refused(lab, laboratory, tmp_path):
    (tmp_path / "private.csv").write_text("1")
    (lab / "scene.toml").write_text(f'[whisking]\npath = "{tmp_path / "private.csv"}"\n')
    files = {**laboratory[1].files, "scene.toml": file_hash(lab / "scene.toml", length=64)}
    changed = replace(laboratory[1], options={"stimuli": "scene.toml"}, files=files)
    with pytest.raises(DataError, match=r"'scene.toml' holds or names 'private.csv', which the benchmark"):
        options_of(changed, lab)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"options": {"stimuli": "eigth.h5"}}, "stimuli of a benchmark 'eigth.h5'; did you mean 'eight.h5'"),
        ({"options": {"metric": "mine.py:Metric"}}, "A benchmark brings no code, and its metric is"),
        ({"options": {"metric": "rsaa"}}, "Unknown metric 'rsaa'; did you mean 'rsa'"),
        ({"options": {"conditions": 3}}, "conditions must be a text; received 3"),
        ({"options": {"whiskers": True}}, "whiskers must be a text"),
        ({"options": {"bin": "wide"}}, "bin"),
        ({"path": "rodger:data"}, "recording layout of a benchmark 'rodger'; did you mean 'rodgers'"),
        ({"path": "mine.py:data"}, "recording layout of a benchmark 'mine.py'"),
    ],
)
def test_what_is_not_installed_or_brings_code_is_refused(laboratory, change, sentence):
    folder, benchmark = laboratory
    path = change.pop("path", benchmark.recordings.path)
    changed = replace(benchmark, recordings=replace(benchmark.recordings, path=path), **change)
    with pytest.raises(UsageError, match=sentence):
        options_of(changed, folder)


def test_a_benchmark_states_what_is_not_the_default_and_the_hash_of_each_file(laboratory):
    folder, benchmark = laboratory
    assert benchmark.options == {"stimuli": "eight.h5", "conditions": "trials:texture", "seed": 1}
    assert {*benchmark.files} == {"eight.h5", *(f"data/{name}.h5" for name in "wxyz")}
    assert benchmark.files["eight.h5"] == file_hash(folder / "eight.h5", length=64)
    assert benchmark.ceiling is not None
    assert (benchmark.ceiling.animals, benchmark.ceiling.stimuli) == (4, 8)
    assert 0 < benchmark.ceiling.lower < benchmark.ceiling.upper <= 1


def test_check_names_what_others_will_miss_and_nothing_wrong(laboratory):
    findings = check(str(laboratory[0] / "lab.toml"))[1]
    assert {finding.severity for finding in findings} == {"note"}
    assert [finding.message.split()[0] for finding in findings] == [
        "contact",
        "recordings.source",
        "recordings.licence",
    ]


def test_check_finds_numbers_that_are_not_those_of_the_recordings(lab, laboratory):
    benchmark = laboratory[1]
    wrong = replace(benchmark, ceiling=replace(benchmark.ceiling, reliability=0.5))
    (lab / "lab.toml").write_text(wrong.to_toml())
    errors = [finding.message for finding in check(str(lab / "lab.toml"))[1] if finding.severity == "error"]
    assert len(errors) == 1
    assert re.match(r"reliability of the ceiling is 0\.9\d+ here, and 0\.5 is stated", errors[0])


@pytest.fixture
def unmeasured(monkeypatch):
    """No recordings are read."""
    monkeypatch.setattr(opening, "_measure", lambda options, progress: ("0123456789", None))


@pytest.mark.usefixtures("unmeasured")
def test_recordings_outside_the_folder_are_refused(lab):
    options = ScoreOptions(recordings=str(lab / "data"))
    with pytest.raises(UsageError, match=r"lies outside the folder .* of --out"):
        make(options, lab / "other" / "lab.toml", name="lab")


@pytest.mark.usefixtures("unmeasured")
def test_a_layout_stays_with_the_path_and_pairs_are_written_out(lab):
    (lab / "match.csv").write_text("a,b\nb,\n")
    options = ScoreOptions(recordings=f"rodgers:{lab / 'data'}", match=lab / "match.csv", title="Ours")
    benchmark = make(options, lab / "lab.toml", name="lab")
    assert benchmark.recordings.path == "rodgers:data"
    assert benchmark.match == {"a": "b", "b": ""}
    assert benchmark.options == {"title": "Ours"}


@pytest.mark.usefixtures("unmeasured")
def test_a_demo_needs_no_files():
    benchmark = make(ScoreOptions(stimuli="objects"), Path("demo.toml"), name="demo")
    assert (benchmark.recordings.path, benchmark.files) == ("demo", {})
