import json

import numpy as np
import pytest

from brainbench.core.identity import SealedPlan
from brainbench.models.features import write_features

QUICK = ("--animals", "4", "--units", "20", "--trials", "6-8", "--boards", "2", "--workers", "1")


@pytest.fixture
def networks(tmp_path):
    """Files of activations of two unrelated networks for 14 stimuli."""
    random = np.random.default_rng(0)
    names = [f"s{index}" for index in range(14)]
    paths = [tmp_path / "one.h5", tmp_path / "other.h5"]
    for path in paths:
        write_features(path, names, {"x": random.standard_normal((14, 5))})
    return [str(path) for path in paths]


def test_recovery_answers_first_and_writes_what_it_found(run, networks, tmp_path):
    out, file = tmp_path / "out", tmp_path / "plan.json"
    found = run("recovery", *networks, *QUICK, "--out", str(out), "--plan", str(file))
    assert found.status == 0
    assert found.out.split()[0] in ("Yes,", "No,", "Undecided")
    kept = json.loads((out / "recovery.json").read_text())
    assert kept["names"] == ["one", "other"]
    assert sum(map(sum, kept["firsts"])) == 4
    assert kept["provenance"]["settings"]["design"]["population"]["animals"] == 4
    plan = SealedPlan.read(file)
    assert plan.hash in found.out
    assert (plan.made_by, plan.stimuli, plan.animals, plan.units, plan.trials) == ("recovery", 14, 4, 20, 6)
    assert plan.names == tuple(f"s{index}" for index in range(14))
    assert set(plan.expected) == set(plan.models) == {"one", "other"}
    assert (out / "recovery.png").read_bytes()[:4] == b"\x89PNG"
    again = json.loads(run("recovery", *networks, *QUICK, "--json").out)
    assert again["boards"] == kept["boards"]


def test_stimuli_are_picked_from_a_pool(run, networks):
    found = run("recovery", *networks, *QUICK, "--pool", "unused", "--keep", "6", "--json")
    assert found.status == 0
    data = json.loads(found.out)
    assert len(data["selection"]["stimuli"]) == data["stimuli"] == 6
    assert set(data["selection"]["random"]) == {"6", "12"}


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (("--keep", "6"), "--pool"),
        (("--pool", "x", "--keep", "6", "--show", "5"), "--show"),
        (("--pool", "x", "--keep", "20"), "most 14; received 20"),
        (("--trials", "many"), "'many'"),
        (("--want", "2"), "received 2"),
        (("--show", "30"), "the pool has 14"),
        (("--metric", "rsaa"), "'rsa'"),
        (("--animals", "0"), "received 0"),
    ],
)
def test_what_cannot_be_asked_is_one_sentence(run, networks, arguments, culprit):
    found = run("recovery", *networks, *QUICK, *arguments)
    assert found.status == 2
    assert culprit in found.err
    assert found.err.count("\n") == 1


def test_one_network_is_too_few(run, networks):
    found = run("recovery", networks[0])
    assert (found.status, "at least 2" in found.err) == (2, True)
    found = run("recovery", "zhuang-smal.simclr", "zhuang-small.simclr")
    assert (found.status, "'zhuang-small" in found.err) == (2, True)
