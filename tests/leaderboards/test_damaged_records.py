"""Whatever a stranger's record holds, it is refused in words or shown; it never ends a site or a report."""

from __future__ import annotations

import copy
import json
import math
import os
import random
from pathlib import Path
from typing import Any

import pytest

from brainbench.core.errors import BrainbenchError
from brainbench.core.records import ResultRecord, Score, record_identity
from leaderboards import build_leaderboard, read_records, write_record
from leaderboards.report.paper import write_paper
from tests.factories.reading_trials import HangError, time_limit

SECONDS = 10
ODD = (
    None, True, -1, 0, 2, 1.5, -0.5, 1e99, 1e308, 5e-324, -(2**62), 10**25, 10**400, math.nan, math.inf, "", "x" * 3000,
    "\ud800", "\x1b[2J", "../../x", "FILE.py:NAME", [], {}, [[]], [None] * 40, {"": {}}, "DEEP", "1e999", ["a", "a"],
)  # fmt: skip


def _deep(levels: int) -> list[Any]:
    return [_deep(levels - 1)] if levels else []


def _places(data: Any) -> list[tuple[Any, Any]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [found for key, value in items for found in [(data, key), *_places(value)]]


def damage(record: ResultRecord, draw: random.Random) -> bytes:
    """Return the file of a record with one to three odd values, fields or bytes."""
    data = json.loads(record.to_json())
    for _ in range(draw.randint(1, 3)):
        parent, key = draw.choice(_places(data))
        odd = copy.deepcopy(draw.choice(ODD))
        odd = _deep(draw.choice((20, 40, 400))) if odd == "DEEP" else odd
        match draw.randrange(5):
            case 0 if isinstance(parent, dict):
                del parent[key]
            case 1 if isinstance(parent, dict):
                parent[str(odd)[:200]] = copy.deepcopy(parent[key])
            case 2 if isinstance(parent, list):
                parent *= 2
            case 3 if isinstance(parent[key], float):
                parent[key] *= draw.choice((-1, 1e3, 1e120))
            case _:
                parent[key] = odd
    text = json.dumps(data).replace('"1e999"', "1e999").encode()
    if draw.random() < 0.2:  # bytes rather than values
        place = draw.randrange(len(text))
        text = draw.choice((text[:place], text[:place] + bytes([draw.randrange(256)]) + text[place + 1 :], text * 2))
    return text


def _named(text: bytes) -> str:
    """The name that fits the content, as a careful stranger would give; any other where nothing fits."""
    try:
        return f"x--{record_identity(json.loads(text))}.json"
    except (ValueError, RecursionError, AttributeError, TypeError):
        return "x--0123456789abcdef.json"


def _numbers(score: Score) -> list[tuple[str, float]]:
    """The numbers with the ranges that every score has."""
    kinds = {"p": score.p, "p_smallest": score.p_smallest, "-reliability": 1 - score.reliability}
    kinds |= {f"-reliability {one.subject}": 1 - one.reliability for one in score.subjects}
    kinds |= {f"units {one.subject}": one.units for one in score.subjects}
    return list(kinds.items())


def outcome(text: bytes, folder: Path, good: ResultRecord) -> str:
    """Return what becomes of a damaged file: ``refused``, ``shown``, or a fault of ours in words."""
    folder.mkdir()
    path = folder / _named(text)
    path.write_bytes(text)
    write_record(good, folder)
    try:
        with time_limit(SECONDS, 10 * SECONDS):
            stored = read_records(folder)
            page = build_leaderboard(stored, folder / "site")
            write_paper(stored, folder / "report.md")
            (found,) = [item for item in stored if item.path == path] or [None]
            if found is None or found.record is None:
                assert path.name in page.read_text() or found is None
                return "refused"
            write_record(found.record, folder / "board")
            silent = [name for name, number in _numbers(found.record.score) if number < -1e-5 or math.isinf(number)]
            everything = json.dumps(json.loads(found.record.to_json()), allow_nan=False)
            return f"silent: {silent}" if silent or "1e+120" in everything else "shown"
    except BrainbenchError as error:
        return f"the site ended: {error}"
    except HangError:
        return "hang"
    except AssertionError as error:
        return f"unlisted: {error}"
    except Exception as error:  # noqa: BLE001 - that is what is counted
        return f"traceback: {type(error).__name__}: {str(error)[:80]}"


def _faults(good: ResultRecord, folder: Path, cases: int, seed: int) -> dict[int, str]:
    draws = ((case, random.Random(f"{seed}-{case}")) for case in range(cases))
    found = {case: outcome(damage(good, draw), folder / str(case), good) for case, draw in draws}
    assert set(found.values()) >= {"refused", "shown"}
    return {case: what for case, what in found.items() if what not in ("refused", "shown")}


def test_damaged_records_are_refused_or_shown(make_record, tmp_path):
    assert _faults(make_record(), tmp_path, 30, seed=0) == {}


def test_a_board_whose_records_share_no_animal_is_built(make_record, tmp_path):
    good = make_record()
    assert outcome(damage(good, random.Random("1-244")), tmp_path / "board", good) == "shown"


@pytest.mark.slow
def test_many_damaged_records_are_refused_or_shown(make_record, tmp_path):
    assert _faults(make_record(), tmp_path, 500, seed=1) == {}


@pytest.mark.parametrize(
    ("change", "culprit"),
    [
        ({"p": 1e-9, "p_smallest": 0.01}, "p is 1e-09"),
        ({"p": 0.0, "p_smallest": math.nan, "p_method": ""}, "p is 0.0"),
        ({"reliability": 1.2}, "reliability"),
        ({"value": 1e200}, "1e+200"),
        ({"without_stimulus": (0.1,)}, "without_stimulus has 1 values"),
        ({"r": 1.5, "provenance": {"settings": {"metric": "rsa"}}}, "raw comparison"),
    ],
)
def test_numbers_that_no_score_can_have_are_refused(make_record, tmp_path, change, culprit):
    with pytest.raises(BrainbenchError) as caught:
        write_record(make_record(**change), tmp_path)
    assert culprit in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_pipes_devices_and_huge_files_are_problems_and_not_waited_for(make_record, tmp_path):
    write_record(make_record(), tmp_path)
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "zero.json").symlink_to("/dev/zero")
    (tmp_path / "folder.json").mkdir()
    with (tmp_path / "huge.json").open("wb") as stream:
        stream.truncate(1 << 32)  # sparse
    with time_limit(SECONDS, 10 * SECONDS):
        stored = read_records(tmp_path)
    assert sorted(item.path.name for item in stored if item.problem) == [
        "folder.json", "huge.json", "pipe.json", "zero.json"
    ]  # fmt: skip
    assert len(stored) == 5


def test_a_record_that_breaks_a_page_is_listed_and_the_others_are_shown(make_record, tmp_path, monkeypatch):
    from leaderboards.site import build

    def page(entry: Any) -> str:
        if entry.name == "odd":
            raise ZeroDivisionError("nobody foresaw it")
        return "fine"

    monkeypatch.setattr(build, "model_page", page)
    first = build_leaderboard([make_record("odd"), make_record("even")], tmp_path / "site")
    assert "ZeroDivisionError" in first.read_text()
    assert [path.name.partition("--")[0] for path in (first.parent / "models").iterdir()] == ["even"]
