"""Files appear whole, together or not at all; a full disk is said in one sentence."""

from __future__ import annotations

import resource
import sys
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from brainbench.core.errors import DataError
from leaderboards import build_leaderboard, write_record
from leaderboards.report.paper import write_paper
from tests.factories.sweep_batches import files_of


@contextmanager
def _files_of_at_most(size: int):
    """Let the system refuse larger files, as a full disk would."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("what", ["record", "site", "md", "html"])
def test_a_size_limit_is_one_sentence_and_the_old_files_stay(make_record, tmp_path, what):
    write = {
        "record": lambda record: write_record(record, tmp_path / "board"),
        "site": lambda record: build_leaderboard([record], tmp_path / "site"),
        "md": lambda record: write_paper([record], tmp_path / "report.md"),
        "html": lambda record: write_paper([record], tmp_path / "report.html"),
    }[what]
    write(make_record("old"))
    before = files_of(tmp_path)
    with _files_of_at_most(3000), pytest.raises(DataError) as caught:
        write(make_record("new", stimuli=tuple(f"{k}" * 400 for k in range(6))))
    assert "File too large" in str(caught.value)
    assert files_of(tmp_path) == before


@pytest.mark.parametrize("most", [1, 3000, 30_000])
@pytest.mark.parametrize("present", [False, True])
def test_a_first_site_that_has_no_room_leaves_nothing(make_record, tmp_path, most, present):
    if present:
        (tmp_path / "site" / "mine").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    with _files_of_at_most(most), pytest.raises(DataError, match="File too large"):
        build_leaderboard([make_record()], tmp_path / "site")
    assert sorted(tmp_path.rglob("*")) == before
    assert build_leaderboard([make_record()], tmp_path / "site").is_file()


def test_a_file_in_the_way_is_one_sentence(make_record, tmp_path):
    (tmp_path / "file").write_text("")
    for write in (
        lambda folder: write_record(make_record(), folder),
        lambda folder: build_leaderboard([make_record()], folder),
        lambda folder: write_paper([make_record()], folder / "report.md"),
    ):
        with pytest.raises(DataError) as caught:
            write(tmp_path / "file" / "x")
        assert "Not a directory" in str(caught.value)


def test_a_failing_engine_leaves_the_old_pdf_and_its_citations(make_record, tmp_path, monkeypatch):
    class Engine:
        def __init__(self, **_: object) -> None: ...

        def write_pdf(self) -> bytes:
            if failing:
                raise AssertionError("a font is missing")
            return b"%PDF whole"

    monkeypatch.setitem(sys.modules, "weasyprint", SimpleNamespace(HTML=Engine))
    failing = False
    write_paper([make_record("old")], tmp_path / "a.pdf")
    before = files_of(tmp_path)
    failing = True
    with pytest.raises(DataError) as caught:
        write_paper([make_record("new")], tmp_path / "a.pdf")
    assert "a font is missing" in str(caught.value)
    assert files_of(tmp_path) == before
