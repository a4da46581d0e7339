import json


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
