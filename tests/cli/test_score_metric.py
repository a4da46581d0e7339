import json

import pytest


@pytest.mark.parametrize("metric", ["ridge", "cka", "procrustes", "rsa-crossnobis", "rsa-partial", "decoding"])
def test_a_score_by_another_metric_has_record_and_report(run, files, metric):
    found = run(
        *("score", files["features"], "--recordings", files["recordings"], "--conditions", "trials:texture"),
        *("--metric", metric, "--out", files["out"], "--json"),
    )
    assert found.status == 0, found.err
    data = json.loads(found.out)
    assert data["record"]["score"]["provenance"]["settings"]["metric"] == metric
    assert data["record"]["animal_to_animal"]["metric"]


def test_the_text_names_the_metric_and_an_unknown_one_is_refused(run, files):
    arguments = ("score", files["features"], "--recordings", files["recordings"], "--conditions", "trials:texture")
    found = run(*arguments, "--metric", "ridge", "--out", files["out"])
    assert found.status == 0, found.err
    assert "ridge: share of explainable variance" in found.out
    wrong = run(*arguments, "--metric", "rigde", "--out", files["out"])
    assert wrong.status == 2
    assert "did you mean 'ridge'" in wrong.err


def test_decoding_and_partial_rsa_print_what_they_add_and_layers_have_p_in_json(run, files):
    arguments = ("score", files["features"], "--recordings", files["recordings"], "--conditions", "trials:texture")
    found = run(*arguments, "--metric", "decoding", "--out", files["out"])
    assert found.status == 0, found.err
    text = " ".join(found.out.split())
    assert "name no property" in text or "Decoding of stimuli left out" in text
    data = json.loads(run(*arguments, "--out", files["out"], "--json").out)
    score = data["record"]["score"]
    tests = {item["layer"]: item for item in score["provenance"]["statistics"]["layer_tests"]}
    assert set(tests) == {item["layer"] for item in score["layers"]}
    assert all(0 < item["p"] <= item["p_corrected"] <= 1 for item in tests.values())


def test_the_walk_from_the_published_estimator_is_printed_and_recorded(run, files):
    arguments = ("score", files["features"], "--recordings", files["recordings"], "--conditions", "trials:texture")
    found = run(*arguments, "--explain-estimator", "--out", files["out"])
    assert found.status == 0, found.err
    assert "From the published estimator to the default" in found.out
    data = json.loads(run(*arguments, "--explain-estimator", "--json", "--out", files["out"]).out)
    walk = data["record"]["score"]["provenance"]["statistics"]["estimator_walk"]
    assert walk[0]["change"].startswith("as published")
    refused = run(*arguments, "--explain-estimator", "--metric", "ridge", "--out", files["out"])
    assert refused.status == 2
    assert "none to explain" in refused.err


def test_stored_splits_are_walked_through(run, tmp_path):
    import numpy as np

    path = tmp_path / "splits.npz"
    np.savez(path, r_xy=np.full(100, 0.3), r_yy=np.linspace(-0.2, 0.8, 100))
    found = run("score", str(path), "--explain-estimator")
    assert found.status == 0, found.err
    assert "as published for the raw input" in found.out
    refused = run("score", str(path), "--explain-estimator", "--metric", "cka")
    assert refused.status == 2
    assert "leave out all options" in refused.err
    np.savez(path, r_xy=np.full(100, 0.3))
    assert "lacks the array 'r_yy'" in run("score", str(path), "--explain-estimator").err
