import json

import pytest


@pytest.mark.slow
def test_the_error_of_a_score_is_measured_against_its_time(run):
    found = run("tradeoff", "score", "--animals", "2", "--units", "10", "--trials", "12", "--repeats", "2", "--json")
    assert found.status == 0, found.err
    points = json.loads(found.out)["points"]
    assert {point["quantity"] for point in points} == {"splits", "permutations"}
