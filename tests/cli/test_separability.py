import json

import pytest

from tests.factories.sweep_batches import small_set


@pytest.fixture(scope="module")
def folder():
    return small_set()


def test_accuracy_stands_beside_chance_and_its_interval(run, folder):
    result = run("stimuli", "separability", str(folder), "--counts", "2")
    assert result.status == 0
    for words in ("brick, cone: 10 objects, 40 sweeps", "accuracy", "95 % interval", "0.500", "chance"):
        assert words in result.out


def test_the_same_as_json(run, folder):
    data = json.loads(run("stimuli", "separability", str(folder), "--counts", "2", "--json").out)
    (item,) = data["results"]
    assert item["interval"]["low"] <= item["accuracy"] <= item["interval"]["high"]
    assert item["above_chance"] == (item["interval"]["low"] > 0.5)
    assert item["choices"] == [["brick", "cone"]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--counts", "two"), "--counts takes whole numbers"),
        (("--classes", "brick,cones", "--counts", "2"), "did you mean 'cone'"),
        (("--split", "tests"), "did you mean 'test'"),
    ],
)
def test_what_cannot_be_separated_is_named(run, folder, arguments, message):
    result = run("stimuli", "separability", str(folder), *arguments)
    assert result.status == 2
    assert message in result.err
