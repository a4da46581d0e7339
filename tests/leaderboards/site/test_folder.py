"""A build removes what a build made, and nothing else, whatever folder it is given."""

from __future__ import annotations

import json
import shutil

import pytest

from brainbench.core.errors import BrainbenchError, UsageError
from leaderboards import build_leaderboard, read_records
from leaderboards.site.folder import MANIFEST
from tests.factories.sweep_batches import files_of


@pytest.fixture
def site(make_record, tmp_path):
    return build_leaderboard([make_record("a"), make_record("b")], tmp_path / "site").parent


def _refused(make_record, site, culprit):
    before = files_of(site)
    with pytest.raises(BrainbenchError) as caught:
        build_leaderboard([make_record("c")], site)
    assert culprit in str(caught.value)
    assert files_of(site) == before


def test_the_manifest_lists_every_file_with_its_hash(site):
    listed = json.loads((site / MANIFEST).read_text())
    assert {*listed, MANIFEST} == set(map(str, files_of(site)))
    assert all(len(digest) == 64 for digests in listed.values() for digest in digests)


@pytest.mark.parametrize(
    "name", ["records/mine.json", "data/leaderboard.xlsx", "models/x--y.html", ".git/HEAD", "n.txt"]
)
def test_a_file_that_no_build_wrote_stops_the_build(make_record, site, name):
    (site / name).parent.mkdir(exist_ok=True)
    (site / name).write_text("precious")
    _refused(make_record, site, name)


def test_a_file_that_was_changed_since_stops_the_build(make_record, site):
    (site / "index.html").write_text("my own words")
    _refused(make_record, site, "index.html")


def test_links_are_neither_followed_nor_removed(make_record, site, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (site / "models" / "x").symlink_to(tmp_path / "elsewhere")
    _refused(make_record, site, "models/x")


def test_a_folder_of_records_is_no_site(make_record, tmp_path):
    from leaderboards import write_record

    path = write_record(make_record("a"), tmp_path / "records")
    (tmp_path / "data").mkdir()
    with pytest.raises(UsageError):
        build_leaderboard(read_records(tmp_path), tmp_path)
    assert [item.relative_to(tmp_path) for item in tmp_path.rglob("*.*")] == [path.relative_to(tmp_path)]


@pytest.mark.parametrize("text", ["{", "[1]", '{"index.html": 3}', "\x00"])
def test_without_a_whole_manifest_nothing_counts_as_built(make_record, site, text):
    (site / MANIFEST).write_text(text)
    _refused(make_record, site, MANIFEST)
    (site / MANIFEST).unlink()
    _refused(make_record, site, "no build")


def test_temporary_files_of_a_build_killed_elsewhere_do_not_stop_the_build(make_record, site, tmp_path):
    (site / "models" / ".x-0123456789abcdef.html").write_text("half")
    build_leaderboard([make_record("a")], site)
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / ".build-manifest-0123456789abcdef.json").write_text("half")
    build_leaderboard([make_record("a")], tmp_path / "new")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / ".mine-0123456789abcdef.json").write_text("half")
    with pytest.raises(UsageError, match="mine"):
        build_leaderboard([make_record("a")], tmp_path / "other")


def test_an_error_leaves_the_earlier_site(make_record, site, monkeypatch):
    from leaderboards.site import build

    before = files_of(site)
    monkeypatch.setattr(build, "to_json", lambda _: (_ for _ in ()).throw(MemoryError))
    with pytest.raises(MemoryError):
        build_leaderboard([make_record("c")], site)
    assert files_of(site) == before


def test_a_copy_of_a_site_can_be_built_again(make_record, site, tmp_path):
    shutil.copytree(site, tmp_path / "copy")
    build_leaderboard([make_record("c")], tmp_path / "copy")
    assert len(list((tmp_path / "copy" / "models").iterdir())) == 1
