import json

import numpy as np


def test_power_says_how_often_and_how_many(run):
    found = run("power", "--stimuli", "6", "--animals", "5", "--effect", "0.7", "--simulations", "100", "--json")
    assert found.status == 0
    (result,) = json.loads(found.out)["results"]
    assert 0.7 < result["power"] <= 1
    assert result["needed"]["stimuli"] in (4, 5, 6)
    text = run("power", "--animals", "4", "--simulations", "50")
    assert text.status == 0
    assert "6 stimuli, 4 animals, consistency 0.8, reliability 0.8, 1 layer" in text.out
    assert "rate of false alarms" in text.out


def test_an_impossible_design_is_refused(run):
    found = run("power", "--effect", "0.99", "--consistency", "0.5")
    assert found.status == 2
    assert "bounds it by √consistency" in found.err
    # Without an effect those are shown that such animals allow.
    some = run("power", "--consistency", "0.4", "--animals", "3", "--simulations", "1", "--json")
    assert [row["design"]["effect"] for row in json.loads(some.out)["results"]] == [0, 0.3, 0.5]
    few = run("power", "--stimuli", "1")
    assert few.status == 2
    assert "--stimuli must be a whole number, at least 2; received 1." in few.err


def test_a_design_whose_scores_could_not_be_ok_is_said_to_be_one(run):
    for reliability, said in (("0.49", True), ("0.5", False)):
        text = run("power", "--animals", "2", "--effect", "0.3", "--simulations", "1", "--reliability", reliability)
        assert ("below 0.5 are unreliable, whatever their p" in text.out) is said


def test_dimensions_are_estimated_given_or_assumed(run, tmp_path):
    from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry, write_files

    features = np.random.default_rng(0).normal(size=(12, 2))
    geometry = ResponseGeometry.from_activations(features)
    write_files(tmp_path / "pilot", geometry, PopulationDesign(animals=2, units=80, emphasis=0.0), seed=1)
    common = ("power", "--animals", "4", "--effect", "0.5", "--simulations", "50", "--json")
    pilot = run(*common, "-r", str(tmp_path / "pilot"), "--conditions", "trials:stimulus")
    assert pilot.status == 0, pilot.err
    found = json.loads(pilot.out)
    assert found["dimensions"]["number"] in (1, 2, 3)
    assert found["results"][0]["design"]["dimensions"] == found["dimensions"]["number"]
    assert json.loads(run(*common, "--dimensions", "7").out)["dimensions"] == {"number": 7, "origin": "given"}
    assert "The pilot gives dimensions alone" in found["note"]
    assumed = json.loads(run(*common).out)
    assert assumed["dimensions"]["number"] == 10
    assert "pilot" not in assumed["note"]


def test_dimensions_that_are_no_number_are_refused(run):
    found = run("power", "--dimensions", "many")
    assert found.status == 2
    assert "'many'" in found.err
    both = run("power", "--dimensions", "3", "--model", "pixels")
    assert both.status == 2
    assert "--model" in both.err
    alone = run("power", "--conditions", "trials:stimulus")
    assert alone.status == 2
    assert "--recordings" in alone.err


def test_a_plan_is_sealed_and_a_score_that_deviates_is_marked(run, study, tmp_path):
    plan = str(tmp_path / "plan.json")
    design = ("--stimuli", "8", "--animals", "5", "--effect", "0.5", "--simulations", "20", "--dimensions", "4")
    sealed = run("power", *design, "--layer", "fc", "--plan", plan, "--json")
    assert sealed.status == 0, sealed.err
    mark = json.loads(sealed.out)["plan"]["hash"]
    score = (
        "score",
        study["features"],
        "-r",
        study["recordings"],
        "--conditions",
        "trials:texture",
        "--out",
        study["out"],
    )
    scored = run(*score, "--plan", plan)
    assert scored.status == 0, scored.err
    assert f"Plan: deviates from the sealed plan {mark}: 4 animals, planned 5." in " ".join(scored.out.split())
    record = json.loads(run(*score, "--plan", plan, "--json").out)["record"]
    assert f"deviates from its sealed plan {mark}" in record["score"]["reasons"]
    assert record["score"]["provenance"]["plan"]["animals"] == 5
    changed = json.loads((tmp_path / "plan.json").read_text()) | {"animals": 4}
    (tmp_path / "plan.json").write_text(json.dumps(changed))
    refused = run(*score, "--plan", plan)
    assert refused.status != 0
    assert "was changed after it was written" in refused.err


def test_a_layer_without_a_plan_is_refused(run):
    refused = run("power", "--layer", "fc")
    assert refused.status == 2
    assert "--plan" in refused.err
