from __future__ import annotations

import json
import os
import re
import shutil
import stat
import subprocess
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from brainbench.core.errors import DataError
from brainbench.core.files import to_json
from brainbench.core.records import ModelCard, ResultRecord
from brainbench.datasets import open_recordings
from leaderboards.held_out import DATA, SALT, Commitment
from leaderboards.store import read_record, write_record
from tests.factories.records import make_record

LABELS = tuple("abcdefgh")
PARTS = ("--conditions", "trials:texture")


def _hold_out(run, study, *what):
    return run("leaderboard", "hold-out", study["recordings"], *what, *PARTS, "--out", study["board"], "--secret",
               study["secret"], "--json")  # fmt: skip


@pytest.mark.parametrize(("what", "held"), [("animals", 2), ("stimuli", 4)])
def test_both_parts_together_are_the_recordings_and_the_hash_opens(run, study, what, held):
    result = _hold_out(run, study, f"--{what}", str(held))
    assert result.status == 0, result.err
    public, kept = open_recordings(Path(study["board"]) / "public.h5"), open_recordings(Path(study["secret"]) / DATA)
    name = {"animals": "subject", "stimuli": "stimulus"}[what]
    parts = [set(map(str, part[name].values)) for part in (public, kept)]
    assert parts[0] | parts[1] == set({"animals": "wxyz", "stimuli": LABELS}[what])
    assert not parts[0] & parts[1]
    assert len(parts[1]) == held
    assert public.attrs["content_hash"] != kept.attrs["content_hash"]
    told = Commitment.read(Path(study["board"]) / "held-out.json")
    assert (told.kind, told.held) == (what, held)
    assert told.open(study["secret"]) == Path(study["secret"]) / DATA
    published = "".join(path.read_text(errors="ignore") for path in Path(study["board"]).glob("*.json"))
    assert (Path(study["secret"]) / SALT).read_text().strip() not in published


def test_nobody_else_can_read_what_is_held_back(run, study):
    before = os.umask(0)
    try:
        assert _hold_out(run, study, "--animals", "2").status == 0
    finally:
        os.umask(before)
    secret = Path(study["secret"])
    assert stat.S_IMODE(secret.stat().st_mode) == 0o700
    assert {path.name: oct(stat.S_IMODE(path.stat().st_mode)) for path in secret.iterdir()} == {
        DATA: "0o600", SALT: "0o600"
    }  # fmt: skip


def test_another_file_or_salt_does_not_open_the_commitment(run, study):
    _hold_out(run, study, "--animals", "2")
    told = Commitment.read(Path(study["board"]) / "held-out.json")
    salt = Path(study["secret"]) / SALT
    right = salt.read_text()
    salt.write_text("0" * 64)
    with pytest.raises(DataError, match="commits"):
        told.open(study["secret"])
    salt.write_text(right)
    (Path(study["secret"]) / DATA).write_bytes(b"others")
    with pytest.raises(DataError, match="commits"):
        told.open(study["secret"])
    with pytest.raises(DataError, match="lacks"):
        told.open(study["out"])


@pytest.mark.parametrize(
    "what", [(), ("--animals", "1"), ("--animals", "3"), ("--stimuli", "6"), ("--animals", "2", "--stimuli", "3")]
)
def test_parts_too_small_to_score_are_refused(run, study, what):
    assert _hold_out(run, study, *what).status == 2
    assert not Path(study["secret"]).exists()


def test_an_earlier_secret_is_not_overwritten(run, study):
    _hold_out(run, study, "--animals", "2")
    again = _hold_out(run, study, "--animals", "2")
    assert again.status == 2
    assert study["secret"] in again.err


def test_the_public_part_does_not_take_the_place_of_the_recordings(run, study):
    _hold_out(run, study, "--animals", "2")
    public = Path(study["board"]) / "public.h5"
    before = public.read_bytes()
    for source in (public, public.parent):
        again = _hold_out(run, study | {"recordings": str(source), "secret": study["secret"] + "2"}, "--animals", "2")
        assert (again.status, public.read_bytes()) == (2, before)
        assert "would take the place" in again.err


@pytest.mark.parametrize(("what", "held"), [("animals", 2), ("stimuli", 4)])
def test_a_submission_is_scored_on_what_is_held_out(run, study, what, held):
    _hold_out(run, study, f"--{what}", str(held))
    public = str(Path(study["board"]) / "public.h5")
    given = ("--recordings", public, "--match", str(Path(study["board"]) / "match.json"))
    scored = run("score", study["features"], *given, "--out", study["out"], "--json")
    assert scored.status == 0, scored.err
    path = json.loads(scored.out)["record_path"]
    check = ("leaderboard", "verify", path, "--held-out", str(Path(study["board"]) / "held-out.json"), "--secret",
             study["secret"], "--recordings", public, "--json")  # fmt: skip
    (result,) = json.loads(run(*check, "--trust-code").out)
    assert result["verdict"] == "confirmed"
    assert result["held_out"] == f"{held} {what}"
    for name in ("on_public", "on_held_out"):
        assert result[name]["standing"]
        score = result[name]["score"]
        assert score is None or score == round(score, 2)
    untrusted = run(*check)
    assert untrusted.status == 1
    (result,) = json.loads(untrusted.out)
    assert result["verdict"] == "not repeated"
    assert "on_held_out" not in result


def test_code_that_a_record_names_is_not_run(run, tmp_path):
    spy = tmp_path / "spy.py"
    spy.write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\n\n\ndef make():\n    return None\n")
    for settings in ({"model": f"{spy}:make", "metric": "rsa"}, {"model": "s4-small", "metric": f"{spy}:make"}):
        record = make_record("spy")
        origin = {**record.score.provenance, "settings": settings, "recordings": {"source": "demo"}}
        record = replace(record, score=replace(record.score, provenance=origin), card=ModelCard("spy", family="s4"))
        path = write_record(record, tmp_path / "records")
        assert read_record(path)
        result = run("leaderboard", "verify", str(path))
        assert result.status == 1
        assert "--trust-code" in result.out
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "odd", [{"seed": "x"}, {"layers": 3}, {"time": 4}, {"bin": -1}, {"units_reliability": [2]}, {"metric": ["rsa"]}]
)
def test_settings_of_other_kinds_are_named_and_not_repeated(run, tmp_path, odd):
    record = make_record("s4-small")
    settings = {"model": "s4-small", "metric": "rsa", **odd}
    origin = {**record.score.provenance, "settings": settings, "recordings": {"source": "demo"}}
    path = write_record(replace(record, score=replace(record.score, provenance=origin)), tmp_path)
    (result,) = json.loads(run("leaderboard", "verify", str(path), "--json").out)
    assert result["verdict"] == "not repeated"
    assert re.search(rf"\b{next(iter(odd))}'?(:| must be| of)", result["problem"])


def test_a_record_is_added_known_and_confirmed_by_scoring_again(run, scored, tmp_path):
    path, where = scored
    board = tmp_path / "board"
    board.mkdir()
    (board / f".{path.name}").write_text("{")  # of an addition that was killed at its first record
    first = json.loads(run("leaderboard", "add", str(path), "--to", str(board), "--json").out)
    assert [item["state"] for item in first["results"]] == ["added"]
    again = json.loads(run("leaderboard", "add", str(path), "--to", str(board), "--json").out)
    assert [item["state"] for item in again["results"]] == ["known"]
    result = run("leaderboard", "verify", str(board), "--recordings", where, "--trust-code")
    assert result.status == 0, result.err
    assert "confirmed: scored again with the same result" in result.out


def _forge(path: Path) -> Path:
    """Raise the value, lower its p and give the file the name that fits it, as a careful cheat would."""
    data = json.loads(path.read_text())
    data["score"]["value"] += 0.2
    data["score"] |= {"p": 1e-6, "p_smallest": 1e-6, "p_method": "of labels, 999,999 random orders"}
    forged = path.parent / "forged" / ResultRecord.from_json(data).file_name
    forged.parent.mkdir(exist_ok=True)
    forged.write_text(json.dumps(data))
    assert read_record(forged)
    return forged


def test_an_edited_record_is_refused_and_a_renamed_forgery_does_not_repeat(run, scored, tmp_path):
    path, where = scored
    board = tmp_path / "board"
    run("leaderboard", "add", str(path), "--to", str(board))
    forged = _forge(path)
    refused = run("leaderboard", "add", str(forged), "--to", str(board))
    assert refused.status == 1
    assert "the same computation gave" in refused.out
    assert len(list(board.iterdir())) == 1
    checked = run("leaderboard", "verify", str(forged), "--recordings", where, "--trust-code")
    assert checked.status == 1
    assert "differs: scored again with another result" in checked.out
    assert "score.value" in checked.out
    assert "score.p " in checked.out
    edited = shutil.copy(forged, tmp_path / path.name)
    refused = run("leaderboard", "add", str(edited), "--to", str(board))
    assert refused.status == 1
    assert "was edited or renamed" in refused.out
    assert run("leaderboard", "add", str(forged), "--to", str(board), "--keep-both").status == 0
    assert "conflict:" in run("leaderboard", "verify", str(board), "--no-score").out


def test_recordings_elsewhere_must_be_given_to_repeat_a_score(run, scored):
    path, _ = scored
    result = run("leaderboard", "verify", str(path), "--trust-code")
    assert result.status == 1
    assert "give them with --recordings PATH" in result.out


RESULTS = "leaderboards/results"
WORKFLOW = Path(__file__).parents[3] / ".github" / "workflows" / "submission.yml"


def _git(*words: str) -> None:
    settings = ("-c", "user.name=x", "-c", "user.email=x@example.org", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *settings, *words], check=True, capture_output=True)


@pytest.fixture
def board(tmp_path, monkeypatch) -> Path:
    """The folder of records in a repository with two of them, on a branch for a submission."""
    root = tmp_path / "repository"
    root.mkdir()
    monkeypatch.chdir(root)
    _git("init", "-q", "-b", "main")
    for name in ("first", "second"):
        write_record(make_record(name), root / RESULTS)
    (root / "README.md").write_text("a board")
    _git("add", ".")
    _git("commit", "-qm", "base")
    _git("checkout", "-qb", "pull")
    return root / RESULTS


def _add(board: Path) -> None:
    write_record(make_record("third"), board)


def _rename(board: Path) -> None:
    path = next(board.glob("first*"))
    path.rename(board / "renamed.json")


def _rename_and_edit(board: Path) -> None:
    path = next(board.glob("first*"))
    (board / "renamed.json").write_text(path.read_text().replace("0.523", "0.99"))
    path.unlink()


def _edit(board: Path) -> None:
    path = next(board.glob("first*"))
    path.write_text(path.read_text().replace("0.523", "0.99"))


def _delete(board: Path) -> None:
    next(board.glob("first*")).unlink()


def _become_a_link(board: Path) -> None:
    path = next(board.glob("first*"))
    path.unlink()
    path.symlink_to("/etc/passwd")


def _add_a_link(board: Path) -> None:
    (board / "link--0123456789abcdef.json").symlink_to(next(board.glob("first*")).name)


def _add_two_of_one_name(board: Path) -> None:
    record = make_record("third")
    for folder in ("a", "z"):
        write_record(record, board / folder)


def _copy_into_a_folder(board: Path) -> None:
    (board / "deep").mkdir()
    shutil.copy(next(board.glob("first*")), board / "deep")


def _add_a_look_alike(board: Path) -> None:
    path = next(board.glob("first*"))
    shutil.copy(path, board / path.name.replace("--", "\u2010-"))


def _add_a_name_that_acts(board: Path) -> None:
    (board / "x\n::error::y.json").write_text("{}")


def _add_an_executable(board: Path) -> None:
    path = write_record(make_record("third"), board)
    path.chmod(0o755)


def _add_another_file(board: Path) -> None:
    (board / "notes.txt").write_text("x")


def _change_a_file_outside(board: Path) -> None:
    (board.parents[1] / "README.md").write_text("edited")


def _add_a_hidden_file(board: Path) -> None:
    shutil.copy(next(board.glob("first*")), board / ".hidden.json")


def _add_another_repository(board: Path) -> None:
    inner = board / "inner"
    inner.mkdir()
    subprocess.run(["git", "init", "-q", inner], check=True)
    (inner / "x").write_text("x")
    _git("-C", str(inner), "add", ".")
    _git("-C", str(inner), "commit", "-qm", "inner")


def _submitted(run, board: Path, *changes, score: bool = False):
    for change in changes:
        change(board)
    _git("add", "-A", ".")
    _git("commit", "-qm", "submission")
    return run("leaderboard", "check-submission", "main", "pull", *([] if score else ["--no-score"]))


def test_a_new_record_is_checked_and_named(run, board):
    result = _submitted(run, board, _add)
    assert result.status == 0, result.out + result.err
    assert "third--" in result.out
    assert "intact" in result.out


REFUSED = {
    _rename: "is deleted", _rename_and_edit: "is deleted", _edit: "is changed", _delete: "is deleted",
    _become_a_link: "another type", _add_a_link: "is a link", _add_two_of_one_name: "the name of another record",
    _copy_into_a_folder: "the name of another record", _add_a_look_alike: "other characters",
    _add_a_name_that_acts: "other characters", _add_an_executable: "is executable",
    _add_another_file: "is no record file", _change_a_file_outside: "is outside of",
    _add_a_hidden_file: "no record file",    _add_another_repository: "is another repository",
}  # fmt: skip


@pytest.mark.parametrize(("change", "words"), REFUSED.items(), ids=lambda value: getattr(value, "__name__", None))
def test_all_else_is_refused_also_beside_a_good_record(run, board, change, words):
    result = _submitted(run, board, change, *([_add] if "third" not in change.__code__.co_consts else []))
    assert result.status == 1
    assert words in result.out
    assert not any(line.startswith("::") for line in result.out.splitlines())


def test_an_edited_record_under_a_new_name_is_refused_by_its_hash(run, board):
    result = _submitted(run, board, _rename_and_edit)
    assert "renamed.json\n  refused: " in result.out


def test_what_a_record_names_is_not_opened(run, board, tmp_path):
    private = tmp_path / "private.toml"
    private.write_text("PRIVATE_LINE")
    record = make_record("zhuang-small")
    stated = dict(record.score.provenance)
    stated["settings"] = {"model": "zhuang-small", "metric": "rsa", "stimuli": os.fspath(private)}
    write_record(replace(record, score=replace(record.score, provenance=stated)), board)
    result = _submitted(run, board, score=True)
    assert result.status == 1
    assert "not repeated" in result.out
    assert "--stimuli" in result.out
    assert "PRIVATE_LINE" not in result.out + result.err


def test_commits_that_are_not_there_or_options_are_one_sentence(run, board):
    for name in ("no-such", "--output=/tmp/x"):
        result = run("leaderboard", "check-submission", "--", "main", name)
        assert (result.status, "There is no commit" in result.err) == (2, True)


def test_a_submission_without_changes_has_no_new_record(run, board):
    result = run("leaderboard", "check-submission", "main", "pull")
    assert (result.status, result.out.strip()) == (0, "no new record")


def test_too_many_records_are_refused_at_once(run, board, monkeypatch):
    monkeypatch.setattr("brainbench.cli.leaderboard.verify.MOST_RECORDS", 1)
    assert "at most 1 at once" in _submitted(run, board, _add, _add_another_file).out


@pytest.mark.parametrize("path", sorted(WORKFLOW.parent.glob("*.y*ml")), ids=lambda path: path.stem)
def test_workflows_pin_every_action_by_its_commit(path):
    lines = [line for line in path.read_text().splitlines() if "uses:" in line]
    assert lines
    pinned = re.compile(r"\s*(- )?uses: [\w./-]+@[0-9a-f]{40}  # v\d+\.\d+\.\d+")
    assert [line for line in lines if not pinned.fullmatch(line)] == []


def test_the_workflow_is_this_command(tmp_path):
    text = WORKFLOW.read_text()
    workflow = yaml.safe_load(text)
    (job,) = workflow["jobs"].values()
    runs = [step["run"] for step in job["steps"] if "run" in step]
    assert runs[-1].startswith("brainbench leaderboard check-submission HEAD FETCH_HEAD")
    assert not any("git diff" in run or "git show" in run for run in runs)
    assert [step["with"]["persist-credentials"] for step in job["steps"] if "checkout" in step.get("uses", "")] == [
        False
    ]
    # Packages are those of the list, each by its hash, in the tested version; the package itself brings none along.
    hashes = WORKFLOW.parents[1] / "submission.txt"
    assert [run for run in runs if "pip" in run] == [
        f"pip install --require-hashes --only-binary :all: -r {hashes.relative_to(WORKFLOW.parents[2])}",
        "pip install --no-deps --no-build-isolation .",
    ]
    pins = dict(
        re.findall(r"^([\w.-]+)==([\w.]+)(?:\+cpu)? --hash=sha256:[0-9a-f]{64}$", hashes.read_text(), re.MULTILINE)
    )
    tested = (WORKFLOW.parents[2] / "constraints.txt").read_text().splitlines()
    names = {line.partition("==")[0]: line.partition("==")[2] for line in tested}
    assert {name: names[name] for name in pins if name in names and names[name] != pins[name]} == {}
    needed = tomllib.loads((WORKFLOW.parents[2] / "pyproject.toml").read_text())["project"]["dependencies"]
    needed = {re.match(r"[\w-]+", need)[0].lower() for need in needed}
    assert needed | {"setuptools"} <= {name.lower() for name in pins}
    # Nothing of the pull request stands inside a shell command.
    assert "${{" not in "".join(runs)
    # The secret is fetched before anything of the submission is there.
    names = [step.get("name", "") for step in job["steps"]]
    assert names.index("Fetch the submission") > [bool("HELD_OUT_URL" in str(step)) for step in job["steps"]].index(
        True
    )
    assert workflow["permissions"] == {"contents": "read"}
    assert to_json(workflow["jobs"]).count("secrets.HELD_OUT_URL }}") == 1
