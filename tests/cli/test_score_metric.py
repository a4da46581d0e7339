import json

import pytest

from tests.cli.test_commands import files  # noqa: F401


@pytest.mark.parametrize("metric", ["ridge", "cka", "procrustes", "rsa-crossnobis"])
def test_a_score_by_another_metric_has_record_and_report(run, files, metric):  # noqa: F811
    found = run(
        *("score", files["features"], "--recordings", files["recordings"], "--conditions", "trials:texture"),
        *("--metric", metric, "--out", files["out"], "--json"),
    )
    assert found.status == 0, found.err
    data = json.loads(found.out)
    assert data["record"]["score"]["provenance"]["settings"]["metric"] == metric
    assert data["record"]["animal_to_animal"]["metric"]


def test_the_text_names_the_metric_and_an_unknown_one_is_refused(run, files):  # noqa: F811
    arguments = ("score", files["features"], "--recordings", files["recordings"], "--conditions", "trials:texture")
    found = run(*arguments, "--metric", "ridge", "--out", files["out"])
    assert found.status == 0, found.err
    assert "ridge: share of explainable variance" in found.out
    wrong = run(*arguments, "--metric", "rigde", "--out", files["out"])
    assert wrong.status == 2
    assert "did you mean 'ridge'" in wrong.err
