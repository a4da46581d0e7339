"""Planted effects are found, reversed ones refuted, absent ones left undecided."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.factories.benchmark_programs import benchmark_program
from tests.factories.campaigns import draw_campaign

CAMPAIGN, CLAIMS, MEASURES = (benchmark_program(f"reproduction.{name}") for name in ("campaign", "claims", "measures"))
NetworkKey, join_campaign = CAMPAIGN.NetworkKey, CAMPAIGN.join_campaign
judge_accuracy, judge_fit = CLAIMS.judge_accuracy, CLAIMS.judge_fit
published, published_accuracy = MEASURES.published, MEASURES.published_accuracy

ACCURACY = {
    "best-accuracy", "convrnn-resnet-accuracy", "convrnn-s4-accuracy", "layer-norm-accuracy", "gpt-accuracy",
    "gpt-mamba-accuracy", "supervised-simclr-accuracy", "trained-accuracy", "tactile-image-accuracy", "raw-accuracy",
    "random-accuracy",
}  # fmt: skip
FIT = {
    "best-fit", "raw-fit", "trained-fit", "convrnn-resnet-fit", "convrnn-s4-fit", "gpt-fit", "gpt-mamba-fit",
    "simclr-simsiam-fit", "simclr-ae-fit", "tactile-image-fit", "masking-fit", "layer-order", "gpt-layer-order",
}  # fmt: skip
EQUAL = {"masking-accuracy", "simclr-supervised-fit"}


@pytest.fixture(scope="module", params=[1, -1, 0])
def judged(request):
    campaign = draw_campaign(request.param)
    found = {item.claim.key: item for item in [*judge_accuracy(campaign), *judge_fit(campaign, 0)]}
    return request.param, campaign, found


def test_verdicts_follow_the_planted_truth(judged):
    sign, _, found = judged
    expected = {1: "holds", -1: "does not hold", 0: "undecided"}[sign]
    directed = (ACCURACY | FIT) - ({"layer-order", "gpt-layer-order"} if sign == 0 else set())
    assert {key: found[key].verdict for key in directed} == dict.fromkeys(directed, expected)
    assert {found[key].verdict for key in EQUAL} == {"holds"}
    # 0 of 6 trainings: enough alone and among claims of which many are decided.
    assert found["s4-diverges"].verdict == ("does not hold" if sign else "undecided")
    # More accurate networks fit better whichever sign the effects have, as long as there are any.
    assert (found["accuracy-fit"].verdict == "holds") is bool(sign)
    assert found["saturation"].verdict == "does not hold"


def _measured(values):
    """Networks of one seed without noise: name → accuracy."""
    keys = {NetworkKey(*name.split("+")): value for name, value in values.items()}
    observed = {
        key: benchmark_program("reproduction.contrasts").Observed(
            key.name, {0: value, 1: value + 1e-4}, "supervised", 0
        )
        for key, value in keys.items()
    }
    return MEASURES.Measured(observed)


def _claim(key):
    (claim,) = (claim for claim in CLAIMS.published_claims() if claim.key == key)
    return claim


def test_a_verdict_that_rests_on_one_network_is_undecided():
    cells = ["zhuang", "zhuang-gru", "zhuang-lstm", "zhuang-ugrnn"]
    alike = {f"{name}+{attender}": 0.88 for name in cells for attender in ("none", "gpt", "mamba")}
    alike |= {f"zhuang-intersection-ln+{attender}": 0.88 for attender in ("none", "gpt", "mamba")}
    lower = {name: value - 0.1 * (not name.startswith("zhuang-intersection")) for name, value in alike.items()}
    one = alike | {f"zhuang-ugrnn+{attender}": 0.6 for attender in ("none", "gpt", "mamba")}
    claim = _claim("intersection-accuracy")
    verdicts = {}
    for name, values in {"lower": lower, "one": one, "alike": alike}.items():
        test = CLAIMS.TestedClaim(claim, claim.compare, _measured(values))
        verdicts[name] = CLAIMS.judged(test, CLAIMS.ERROR)
    assert verdicts["lower"].verdict == "holds"
    assert verdicts["alike"].verdict == "undecided"
    assert "without zhuang-ugrnn" in verdicts["one"].effect.detail


def test_networks_of_few_comparisons_are_a_sample_of_such_networks():
    values = {"zhuang-intersection-ln": 0.9, "zhuang": 0.89, "zhuang-gru": 0.88, "zhuang-lstm": 0.5}
    effect = _claim("intersection-accuracy").compare(_measured(values))
    assert effect.interval.low < 0 < effect.value


def test_a_correlation_is_taken_within_families():
    # Within each kind of encoder larger networks are better; the larger kind is worse.
    values, sizes = {}, {}
    for stem, size, level in (("zhuang", 6.0, 0.9), ("resnet18", 8.0, 0.3)):
        for place in range(6):
            name = f"{stem}-{place}"
            values[name], sizes[NetworkKey(name)] = level + 0.01 * place, size + 0.05 * place
    effect = CLAIMS._correlate(sizes, _measured(values), "supervised", 0.05)
    assert effect.value == pytest.approx(1.0)
    assert "of all 12 networks together" in effect.detail
    assert "−0.9" in effect.detail


def test_chance_decides_few_of_many_claims():
    rng = np.random.default_rng(0)
    claim = _claim("gpt-accuracy")
    tests = []
    for _ in range(60):
        values = {f"zhuang-{place}+{kind}": 0.5 + rng.normal(0, 0.02) for place in range(6) for kind in ("none", "gpt")}
        tests.append(CLAIMS.TestedClaim(claim, claim.compare, _measured(values)))
    assert sum(test.verdict(CLAIMS.ERROR) != "undecided" for test in tests) > 0
    error = CLAIMS.allowed_error(tests)
    assert sum(test.verdict(error) != "undecided" for test in tests) <= 1


def test_seeds_agree_where_networks_differ(judged):
    sign, campaign, _ = judged
    ((first, second, networks, tau),) = CLAIMS.seed_agreement(MEASURES.accuracies(campaign))
    assert (first, second, networks) == (0, 1, 16)
    assert (tau >= 0.8) is bool(sign)


def test_a_claim_on_animals_is_not_tested_on_synthetic_ones():
    found = judge_fit(draw_campaign(1, synthetic=True), 0)
    assert {item.verdict for item in found} == {"cannot be tested here"}
    assert {item.claim.key for item in found if item.rule == "holds"} >= FIT
    assert all("synthetic" in item.reason for item in found)


def test_a_partial_campaign_is_judged_as_far_as_it_goes():
    whole = draw_campaign(1)
    some = [line for line in whole.trainings if line.objective == "supervised" and "s4" not in line.model]
    found = {item.claim.key: item.verdict for item in judge_accuracy(join_campaign(some, []))}
    assert found["convrnn-resnet-accuracy"] == found["best-accuracy"] == "holds"
    missing = ("convrnn-s4-accuracy", "s4-diverges", "trained-accuracy", "tactile-image-accuracy", "raw-accuracy")
    assert {found[key] for key in missing} == {"not trained yet"}
    once = join_campaign([line for line in some if line.seed == 0], [])
    (best,) = (item for item in judge_accuracy(once) if item.claim.key == "best-accuracy")
    assert best.verdict == "undecided"
    assert best.effect.interval is None


def test_diverged_trainings_count_as_such_alone():
    whole = draw_campaign(1)
    lost = [replace(line, status="diverged") if line.model.startswith("s4") else line for line in whole.trainings]
    found = {item.claim.key: item for item in judge_accuracy(join_campaign(lost, []))}
    assert found["s4-diverges"].verdict == "holds"
    assert found["convrnn-s4-accuracy"].verdict == "not trained yet"


def test_a_board_of_six_stimuli_decides_nothing():
    campaign = draw_campaign(1)
    (board,) = campaign.boards
    few = replace(campaign, boards=(replace(board, lacks="at least 10 stimuli (here 6)"),))
    found = [item for item in judge_fit(few, 0) if item.effect]
    assert {item.rule for item in found} == {"undecided"}
    assert all("10 stimuli" in item.reason for item in found)


def test_every_claim_of_the_file_has_its_comparison():
    claims = CLAIMS.published_claims()
    assert {claim.key for claim in claims if claim.measure in ("accuracy", "fit")} == set(CLAIMS.COMPARISONS)
    assert len({claim.key for claim in claims}) == len(claims)
    assert all(claim.source for claim in claims)
    assert all(claim.reason for claim in claims if claim.measure == "none")
    assert all((claim.direction == 0) == (claim.margin > 0) for claim in claims)


def test_the_published_effects_are_made_of_the_published_accuracies():
    found = {item.claim.key: item.published_effect for item in judge_accuracy(join_campaign([], []))}
    theirs = published_accuracy().networks
    gpt = [
        theirs[key].value - theirs[key._replace(attender="none")].value
        for key in (NetworkKey(name, "gpt") for name in ("zhuang", "zhuang-ugrnn", "zhuang-gru", "zhuang-lstm"))
    ]
    gpt += [0.6808 - 0.6155, 0.4419 - 0.4922]
    assert found["gpt-accuracy"].value == pytest.approx(sum(gpt) / 6, abs=1e-4)
    assert found["best-accuracy"].value == pytest.approx(0.6953 - 0.6808, abs=1e-4)


@pytest.mark.shared
def test_the_published_numbers_are_those_of_the_released_files(reference):
    folder = reference / "published"
    accuracy = json.loads((folder / "all_test_results.json").read_text())
    sizes = json.loads((folder / "model_total_params.json").read_text())
    runs = [run for run in published()["runs"] if run["run"]]
    assert len([run for run in published()["runs"] if run["objective"] != "untrained"]) == 56
    for run in runs:
        name = f"tactile1000hz_{run['run']}"
        assert run["top1"] == pytest.approx(accuracy["test_acc_top1"][name], abs=6e-5)
        assert run["top5"] == pytest.approx(accuracy["test_acc_top5"][name], abs=6e-5)
        assert run["parameters"] == sizes.get(name)
    text = (reference / "thesis.txt").read_text()
    for number in ("correlation of 0.46", "r = 0.59", "0.175 with a s.e.m. of 0.161"):
        assert number in text
