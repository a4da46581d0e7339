import json
from pathlib import Path

import numpy as np
import pytest

from brainbench.models.features import write_features

LABELS = ("a", "b", "c", "d")


def _score(run, files: dict[str, str], model: str, *more: str):
    return run(
        "score",
        model,
        "--recordings",
        files["recordings"],
        "--conditions",
        "trials:texture",
        "--out",
        files["out"],
        *more,
    )


def test_score_prints_the_statistics_and_writes_record_and_report(run, files):
    result = _score(run, files, files["features"])
    assert result.status == 0, result.err
    for word in ("score", "status", "reliability", "permutation p", "noise ceiling", "animal to animal"):
        assert word in result.out
    record = next(Path(files["out"]).glob("*.json"))
    report = record.with_suffix(".html")
    assert str(record) in result.out
    assert str(report) in result.out
    assert "<html" in report.read_text().lower()


def test_json_is_one_document_on_stdout(run, files):
    result = _score(run, files, files["features"], "--json")
    data = json.loads(result.out)
    assert Path(data["record_path"]).is_file()
    assert json.loads(Path(data["record_path"]).read_text()) == data["record"]
    assert data["record"]["score"]["stimuli"] == list(LABELS)


def test_a_users_file_is_scored_on_a_users_arrays(run, files):
    result = _score(run, files, files["model"], "--stimuli", files["arrays"], "--json")
    assert result.status == 0, result.err
    record = json.loads(result.out)["record"]
    assert {item["layer"] for item in record["score"]["layers"]} == {"gru", "output"}
    assert set(record["baselines"]) == {"raw input", "random features"}


def test_labels_are_matched_by_a_file(run, files, tmp_path):
    other = write_features(
        tmp_path / "o.h5", ["w", "b", "c", "d"], {"fc": np.random.default_rng(1).normal(size=(4, 6))}
    )
    result = _score(run, files, str(other))
    assert result.status == 2
    assert "without a stimulus: 'a'" in result.err
    match = tmp_path / "match.csv"
    match.write_text("a,w\n")
    assert _score(run, files, str(other), "--match", str(match)).status == 0


def test_the_leaderboard_is_built_from_records(run, files, tmp_path):
    _score(run, files, files["features"])
    page = tmp_path / "board"
    broken = Path(files["out"]) / "broken.json"
    broken.write_text("{")
    result = run("leaderboard", "build", files["out"], "--out", str(page), "--json")
    data = json.loads(result.out)
    assert data["records"] == 1
    assert len(data["problems"]) == 1
    assert "features" in (page / "index.html").read_text()


def test_the_leaderboard_of_no_records_says_how_to_get_some(run, tmp_path):
    result = run("leaderboard", "build", str(tmp_path / "none"), "--out", str(tmp_path / "page"))
    assert result.status == 2
    assert not (tmp_path / "page").exists()
    assert "brainbench score" in result.err


def test_recordings_rdm_shows_reliability(run, files):
    result = run("recordings", "rdm", files["recordings"], "--conditions", "trials:texture", "--json")
    data = json.loads(result.out)
    assert data["labels"] == list(LABELS)
    assert [item["subject"] for item in data["animals"]] == ["x", "y"]
    assert all(len(item["rdm"]) == 6 and item["units"] == 12 for item in data["animals"])


def test_recordings_inspect_proposes_conditions(run, files):
    result = run("recordings", "inspect", str(Path(files["recordings"]) / "x.h5"))
    assert result.status == 0
    assert "trials:texture" in result.out


def test_models_are_listed_and_described(run):
    names = [item["name"] for item in json.loads(run("models", "list", "zhuang-intersection*", "--json").out)]
    assert "zhuang-intersection-ln" in names
    shown = json.loads(run("models", "show", "zhuang-intersection-ln", "--json").out)
    assert shown["parameters"] == 37_988_821
    assert "37,988,821" in run("models", "show", "zhuang-intersection-ln").out


def test_stimuli_are_listed(run):
    assert "rodgers" in run("stimuli", "list").out


def test_doctor_says_what_each_missing_part_would_enable(run, monkeypatch):
    from brainbench.cli import doctor

    found = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "pynwb" else found(name))
    result = run("doctor")
    assert result.status == 0
    line = next(line for line in result.out.splitlines() if line.startswith("pynwb"))
    assert "not installed" in line
    assert line.split("not installed")[1].split()[0] == "nwb"
    assert "pip install -c constraints.txt '.[EXTRA]'" in result.out
    data = json.loads(run("doctor", "--json").out)
    assert data["optional"]["pynwb"]["version"] is None
    assert data["required"]["torch"]
    # A package of several extras stands with the one that is about it.
    extras = {"onnx": "export", "tensordict": "policies", "pillow": "report", "scikit-fem": "tactile"}
    assert {name: data["optional"][name]["extra"] for name in extras} == extras


def test_doctor_says_what_each_extra_of_users_enables():
    from brainbench.cli.doctor import ENABLES
    from tests.factories.installations import EXTRAS

    # "rod" has no packages.
    assert {*ENABLES} == {*EXTRAS} - {"rod", "docs", "test", "dev"}


@pytest.mark.shared
def test_a_real_recording_goes_through_to_rdm_and_reliability(run, reference):
    path = str(reference / "nwb" / "pynapple_sub-4_ses-4_ecephys+image.nwb")
    inspected = run("recordings", "inspect", path)
    assert "encoding_table:stimCategory" in inspected.out
    result = run("recordings", "rdm", path, "--conditions", "encoding_table:stimCategory", "--json")
    data = json.loads(result.out)
    assert data["labels"] == ["0", "1", "2"]
    assert data["animals"][0]["units"] == 35
    assert data["animals"][0]["trials"] == 90
    assert -1 <= data["animals"][0]["reliability"] <= 1
    shown = run("recordings", "rdm", path, "--conditions", "encoding_table:stimCategory").out
    assert "unreliable: below 0.5" in shown


@pytest.mark.shared
@pytest.mark.parametrize("kind", ["LantyerEtAl2018_170328_AB_277_ST50_C", "FergusonEtAl2015_PYR5_rebound"])
def test_intracellular_files_are_refused_in_one_sentence(run, reference, kind: str):
    result = run("recordings", "rdm", str(reference / "nwb" / f"{kind}.nwb"))
    assert result.status == 1
    assert "has no units table" in result.err
    assert len(result.err.strip().splitlines()) == 1


def test_recipes_print_every_rule(run):
    assert "rodgers" in run("recordings", "recipe").out
    rules = run("recordings", "recipe", "rodgers").out
    for word in ("convex-close, convex-medium", "first-contact", "spoil", "nothing", "citation"):
        assert word in rules
    assert "did you mean 'rodgers'" in run("recordings", "recipe", "rogers").err
