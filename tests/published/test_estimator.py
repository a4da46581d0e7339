"""The published estimator on the authors' arrays, against their procedure written out split by split."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
import torch
from scipy.stats import pearsonr
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.metrics import noise_corrected
from brainbench.metrics.measures.rsa import score_rdms
from brainbench.models.activations import extract
from brainbench.models.registry import load_model
from brainbench.published.estimator import (
    CORRECTED,
    FIRST_SEED,
    POOL,
    PUBLISHED,
    PUBLISHED_INPUT,
    Switches,
    concatenate,
    corrected_value,
    explain_score,
    explain_splits,
    first_half,
    make_targets,
    published_activations,
    published_layers,
    score_published,
    score_published_animals,
)
from tests.factories.animals import STIMULI as LABELS
from tests.factories.animals import make_rdm, make_subject
from tests.factories.published_files import make_zero_filled
from tests.factories.training_sweeps import random_sweeps

SPLITS = 60
STIMULI = [str(number) for number in range(6)]


def _rdm(patterns):
    with np.errstate(invalid="ignore"):
        return (1 - np.corrcoef(patterns))[np.triu_indices(6, 1)]


def _r(first, second):
    """Pearson's r of two RDMs; NaN where a slot that no trial of a half showed leaves one without correlations."""
    return pearsonr(first, second)[0] if np.isfinite([first, second]).all() else np.nan


def _halves(array, split):
    """Both halves' means as the published code makes them: a shuffled list of trials, cut in the middle."""
    order = list(range(len(array)))
    np.random.RandomState(FIRST_SEED + split).shuffle(order)
    return [np.nanmean(array[part], axis=0) for part in (order[: len(array) // 2], order[len(array) // 2 :])]


def _halves_r(array, splits=SPLITS):
    return np.array([_r(*map(_rdm, _halves(array, split))) for split in range(splits)])


def _score(source, target, r_yy, r_xx=1.0):
    """Mean corrected score over the splits that count, of features [6, F] or of an array [R, 6, U]."""
    whole = source if source.ndim == 2 else np.nanmean(source, axis=0)
    r_xy = _r(_rdm(whole), _rdm(np.nanmean(target, axis=0)))
    reliable = 2 * r_xx / (1 + r_xx) * 2 * r_yy / (1 + r_yy)
    return (r_xy / np.sqrt(reliable[(r_yy >= 0.5) & (r_xx >= 0.5)])).mean()


@pytest.fixture(scope="module")
def arrays():
    found = {f"m{seed}": make_zero_filled([60, 48], units=8, seed=seed)[0] for seed in range(3)}
    # A trial without a rate in its slot, as a window of no length leaves it.
    found["m1"][5, found["m1"][5].sum(axis=1).argmax()] = np.nan
    return found


@pytest.fixture(scope="module")
def features():
    rng = np.random.default_rng(5)
    return {f"layer{number}": rng.normal(size=(6, 20)) for number in range(4)}


def test_a_score_is_the_best_layer_and_target_of_their_procedure(arrays, features):
    score = score_published(features, make_targets(arrays, splits=SPLITS), name="m", stimuli=STIMULI)
    targets = {**arrays, POOL: concatenate(list(arrays.values()))}
    r_yy = {name: _halves_r(array) for name, array in targets.items()}
    expected = {
        (layer, name): _score(values, array, r_yy[name])
        for layer, values in features.items()
        for name, array in targets.items()
    }
    assert score.value == pytest.approx(max(expected.values()), abs=1e-12)
    assert score.layer == max(expected, key=expected.get)[0]
    for part in score.subjects:
        assert part.value == pytest.approx(max(expected[layer, part.subject] for layer in features), abs=1e-12)
    assert score.status == "unreliable"
    assert any("maximum over 4 layers and 4 targets" in reason for reason in score.reasons)


@pytest.mark.slow
@pytest.mark.shared
def test_the_example_file_scores_as_their_procedure_does(reference, features):
    with np.load(reference / "published" / "rodgers6_example.npz", allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files if stored[name].ndim}
    # One slot of this animal was shown once, so one half never has it and the RDM of no split exists.
    lost = arrays.pop("sub-228CR")
    score = score_published(features, make_targets(arrays), name="m", stimuli=STIMULI)
    targets = {**arrays, POOL: concatenate(list(arrays.values()))}
    r_yy = {name: _halves_r(array, 1000) for name, array in targets.items()}
    expected = [_score(item, array, r_yy[name]) for item in features.values() for name, array in targets.items()]
    assert score.value == pytest.approx(max(expected), abs=1e-12)
    assert score_published(features, make_targets({"lost": lost}), name="m", stimuli=STIMULI).status == "undefined"


def test_animals_are_scored_against_the_units_of_the_others(arrays):
    score = score_published_animals(arrays, stimuli=STIMULI, splits=SPLITS)
    expected = []
    for name, array in arrays.items():
        others = concatenate([other for label, other in arrays.items() if label != name])
        expected.append(_score(others, array, _halves_r(array), _halves_r(others)))
    np.testing.assert_allclose([part.value for part in score.subjects], expected, rtol=1e-9)
    assert score.value == pytest.approx(np.mean(expected))
    assert score_published_animals({"m0": arrays["m0"]}, stimuli=STIMULI, splits=2).status == "undefined"


def test_the_bar_of_the_raw_input_is_the_median_for_the_pool(arrays, features):
    layer = {"input": features["layer0"]}
    targets = make_targets(arrays, splits=SPLITS)
    score = score_published(layer, targets, name="input", stimuli=STIMULI, estimator="thesis-input")
    pool = concatenate(list(arrays.values()))
    r_yy = _halves_r(pool)
    r_xy = _r(_rdm(layer["input"]), _rdm(np.nanmean(pool, axis=0)))
    ratio = r_xy / np.sqrt((2 * r_yy / (1 + r_yy))[r_yy > 0])
    assert score.value == pytest.approx(np.median(ratio))
    assert [part.subject for part in score.subjects] == [POOL]


def test_p_takes_the_maximum_again_under_every_order(arrays, features):
    targets = make_targets(arrays, splits=SPLITS)
    rng = np.random.default_rng(0)
    found = [
        score_published({name: rng.normal(size=(6, 20)) for name in features}, targets, name="m", stimuli=STIMULI).p
        for _ in range(60)
    ]
    # Unrelated models: p is uniform, so its mean lies near .5 (standard error .037).
    assert abs(np.mean(found) - 0.5) < 0.15


def test_halves_are_disjoint_and_the_first_is_the_smaller():
    assert first_half(7, 0).sum() == 3
    assert (first_half(40, 1) != first_half(40, 2)).any()


def test_a_half_without_a_session_loses_its_split():
    array, _ = make_zero_filled([60, 12], units=5)
    array[1:, :, 5:] = np.nan
    # A session of one trial is missing in one half of every split.
    assert np.isnan(make_targets({"m": array}, splits=10)[0].split_half_r).all()


def _both(name, **options):
    model, x = load_model(name, **options), random_sweeps(3, 22)
    with torch.no_grad():
        return model, model(x), published_activations(model, x), model.activations(x)


def test_a_node_is_read_from_the_step_in_its_name():
    _, y, read, ours = _both("zhuang-ugrnn-small", decoder="mlp")
    assert tuple(read) == (*(f"conv{n}" for n in range(1, 7)), "fc7", "fc8", "dec_mlp_l0", "dec_mlp_l1", "dec_mlp_l2")
    for first, name in enumerate(tuple(read)[:8]):
        torch.testing.assert_close(read[name], ours[f"encoder.{name}"][:, first:].flatten(2))
    torch.testing.assert_close(read["dec_mlp_l2"][:, 0], y)
    assert read["dec_mlp_l0"].shape == (3, 1, 1024)
    assert (read["dec_mlp_l0"] >= 0).all()


def test_the_blocks_of_s4_keep_time_and_average_channels():
    _, _, read, ours = _both("s4-small+gpt")
    assert read["enc_s4_l2"].shape == (3, 96, 22)
    torch.testing.assert_close(read["enc_s4_l2"], ours["encoder.block3"].transpose(1, 2))
    torch.testing.assert_close(read["enc_s4_dec"], ours["encoder.fc"])
    # Ours are the answers at the action tokens, theirs the mean of all tokens.
    assert read["att_gpt_b7"].shape == (3, 44, 96)
    torch.testing.assert_close(read["att_gpt_b7"][:, 1::2], ours["attender.block8"])
    torch.testing.assert_close(read["att_gpt_lm_head"][:, 1::2], ours["attender.lm_head"])


def test_the_blocks_of_mamba_are_read_without_the_stream():
    _, y, read, ours = _both("resnet18-small+mamba", decoder="all-steps")
    torch.testing.assert_close(read["layer1.1"], ours["encoder.layer1"].flatten(2))
    torch.testing.assert_close(read["fc"], ours["encoder.fc"])
    added = sum(read[f"att_mamba_l{index}"] for index in range(4))
    torch.testing.assert_close(read["fc"] + added, ours["attender.block4"], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(read["att_mamba_norm"], ours["attender.norm"])
    torch.testing.assert_close(read["dec_mlp_l2"][:, 0], y, atol=1e-5, rtol=1e-4)


def test_layers_are_chosen_by_their_published_names():
    model = load_model("zhuang-small")
    assert tuple(extract(model, random_sweeps(2, 9), readout="published", layers=["fc8", "conv2"])) == ("conv2", "fc8")
    with pytest.raises(UsageError, match=r"'encoder\.fc8'.*'fc8'"):
        extract(model, random_sweeps(2, 9), readout="published", layers=["encoder.fc8"])
    with pytest.raises(UsageError, match=r"'publish'.*'published'"):
        extract(model, random_sweeps(2, 9), readout="publish")


def test_other_networks_are_refused():
    with pytest.raises(UsageError, match="received Linear"):
        published_layers(nn.Linear(2, 2))


@pytest.mark.shared
def test_the_stored_splits_walk_from_the_published_bar_to_no_trustworthy_number(reference):
    with np.load(reference / "rsa" / "thesis_model_input_rsa_plain.npz") as stored:
        steps = explain_splits(stored["r_xy"], stored["r_yy"], r_xx=stored["r_xx"])
        published = stored["r_xy_n_sb"]
    values = [step.value for step in steps]
    assert values == pytest.approx([0.45774, 0.59880, 0.32945, 0.59880, 0.57052, 0.57052], abs=5e-6)
    assert values[0] == pytest.approx(np.nanmedian(published), abs=1e-12)
    assert "286 with negative reliability" in steps[0].detail
    assert steps[2].detail == "75 of 1,000 splits"
    assert steps[-1].status == "unreliable"
    assert "no correction of these data is trustworthy" in steps[-1].detail


def test_the_ends_of_the_walk_are_the_estimators():
    rng = np.random.default_rng(0)
    halves = rng.uniform(-0.2, 0.9, 200)
    for switches, estimator in ((PUBLISHED, "thesis"), (PUBLISHED_INPUT, "thesis-input"), (CORRECTED, "default")):
        expected = noise_corrected(0.4, halves, estimator=estimator)
        assert corrected_value(0.4, halves, switches) == pytest.approx((expected.value, expected.splits))


def test_two_negative_reliabilities_pass_only_as_published():
    splits = [-0.5, 0.6, -0.3]
    assert corrected_value(0.4, splits, Switches(drop_splits=False), r_xx=splits)[1] == 3
    assert corrected_value(0.4, splits, Switches(drop_splits=False, negative_pairs=False), r_xx=splits)[1] == 1


def test_each_step_of_a_score_changes_one_switch_and_the_last_is_the_score():
    rng = np.random.default_rng(1)
    shared = make_rdm(rng)
    animals = [make_subject(f"m{i}", shared + 0.1 * rng.normal(size=15), seed=i, splits=60) for i in range(6)]
    animals.append(make_subject("noisy", make_rdm(rng), reliability=0.3, splits=60))
    layers = {str(i): make_rdm(rng) for i in range(8)} | {"true": shared}
    steps = explain_score(layers, animals)
    score = score_rdms(layers, animals, name="x", stimuli=LABELS)
    assert steps[-1].value == pytest.approx(score.value)
    assert steps[-1].switches == CORRECTED
    assert steps[0].switches == PUBLISHED
    changed = [
        sum(getattr(a.switches, f.name) != getattr(b.switches, f.name) for f in dataclasses.fields(Switches))
        for a, b in itertools.pairwise(steps)
    ]
    assert changed == [1] * 6
    assert steps[0].value >= steps[1].value


def test_the_maximum_over_targets_and_layers_makes_a_score_of_nothing():
    rng = np.random.default_rng(2)
    first, last = [], []
    for _ in range(40):
        animals = [make_subject(f"m{i}", make_rdm(rng), seed=i, reliability=0.8) for i in range(11)]
        steps = explain_score({str(i): make_rdm(rng) for i in range(12)}, animals)
        first.append(steps[0].value)
        last.append(steps[-1].value)
    assert np.mean(first) > 0.6
    assert abs(np.mean(last)) < 0.15


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="no split halves"):
        explain_splits(0.3, [np.nan])
    with pytest.raises(UsageError, match="nothing to explain"):
        explain_score({"a": np.ones(15)}, [make_subject("a", make_rdm(np.random.default_rng(0)))])
