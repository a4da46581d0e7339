import json
from pathlib import Path

import pytest

LABELS = ("a", "b", "c", "d")


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
