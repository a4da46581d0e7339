"""Metrics beyond RSA: their definitions by brute force, the shared machinery, and a metric of one's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import orthogonal_procrustes

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.metrics import PatternMetric, compare, get_metric, list_metrics, rdm, register_metric
from brainbench.metrics.measures import patterns
from brainbench.metrics.measures.patterns import (
    PENALTIES,
    Procrustes,
    RidgeEncoding,
    _errors_without,
    _fits,
    _losses_without,
    centred_products,
    variance_partition,
)
from brainbench.metrics.reliability.subject_rdm import subject_rdm
from tests.factories.animals import STIMULI, make_block, make_latent, make_rdm

OTHERS = [name for name in ("cka", "procrustes", "ridge", "rsa", "rsa-crossnobis")]


def _make(metric, count=5, noise=1.0, seed=0):
    latent = make_latent(seed)
    blocks = [[make_block(latent, seed=i, units=40, repeats=12, noise=noise)] for i in range(count)]
    return latent, [metric.animal(f"m{i}", block, 6, stimuli=STIMULI) for i, block in enumerate(blocks)]


def _score(metric, features, animals, **options):
    return metric.score(features, animals, name="model", stimuli=STIMULI, **options)


def test_the_registry_lists_what_there_is():
    assert set(OTHERS) <= set(list_metrics())
    assert list_metrics()[0] == "rsa"
    with pytest.raises(UsageError, match=r"did you mean 'ridge'.*Your own: FILE\.py:CLASS"):
        get_metric("rigde")
    with pytest.raises(UsageError, match="exists already"):
        register_metric(get_metric("ridge"))


def test_ridge_without_a_stimulus_is_ridge_on_the_data_without_it(monkeypatch):
    """Also the predictions of the other stimuli change: the shares are those of data that never had it."""
    # A vanishing penalty is the same with a stimulus and without it; chosen among several it may be another one.
    monkeypatch.setattr(patterns, "PENALTIES", (1e-9,))
    metric, features = RidgeEncoding(), np.random.default_rng(0).normal(size=(8, 3))
    animals = [metric.animal(f"m{i}", [make_block(features, seed=i, repeats=12)], 8) for i in range(2)]
    values = metric.compare_without([features, features[::-1]], animals)[:, 0]
    factors = [metric.correction(animal, "default").value for animal in animals]
    for stimulus in range(8):
        rest = np.delete(np.arange(8), stimulus)
        others = [animal.take(rest) for animal in animals]
        alone = metric.compare_orders(features[rest], others, np.arange(7)[None])[0]
        scale = [metric.correction(animal, "default").value for animal in others]
        np.testing.assert_allclose(values[stimulus] * factors, alone * scale, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_the_shared_geometry_is_found_and_an_unrelated_model_is_not(name):
    metric = get_metric(name)
    latent, animals = _make(metric)
    rng = np.random.default_rng(1)
    features = {"luck": rng.normal(size=(6, 30)), "true": latent @ rng.normal(size=(4, 200))}
    found = _score(metric, features, animals)
    assert (found.status, found.layer) == ("ok", "true")
    assert found.p == pytest.approx(1 / 720)
    luck = _score(metric, {"luck": features["luck"]}, animals)
    assert luck.value < found.value
    assert luck.p > 0.05
    between = metric.score_animals(animals, stimuli=STIMULI)
    assert between.status == "ok"
    assert between.p == between.p_smallest <= 0.025
    assert found.scaled == pytest.approx(1, abs=0.15)
    assert abs(luck.scaled) < 0.5


@pytest.mark.parametrize("name", OTHERS)
def test_the_order_of_stimuli_and_animals_and_the_scale_of_features_are_irrelevant(name):
    metric = get_metric(name)
    latent = make_latent(2)
    rng = np.random.default_rng(3)
    features = latent @ rng.normal(size=(4, 50)) + rng.normal(size=(6, 50))
    order = rng.permutation(6)
    first, second = [], []
    for index in range(3):
        block = make_block(latent, seed=index)
        moved = Trials(block.responses, np.argsort(order)[block.labels], block.keys)
        first.append(metric.animal(f"m{index}", [block], 6))
        second.append(metric.animal(f"m{index}", [moved], 6))
    one = _score(metric, {"a": features}, first)
    two = _score(metric, {"a": 7.5 * features[order]}, second[::-1])
    np.testing.assert_allclose([two.value, two.p], [one.value, one.p], atol=1e-10)


def test_cka_is_linear_centred_kernel_alignment():
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(8, 20)), rng.normal(size=(8, 35))
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    expected = np.linalg.norm(x.T @ y) ** 2 / np.linalg.norm(x.T @ x) / np.linalg.norm(y.T @ y)
    found = compare(rdm(x, method="sqeuclidean"), rdm(y, method="sqeuclidean"), method="whitened-cosine")
    assert found == pytest.approx(expected)


def test_procrustes_is_scipys():
    rng = np.random.default_rng(5)
    x, y = rng.normal(size=(8, 20)), rng.normal(size=(8, 20))
    unit = [(z - z.mean(axis=0)) / np.linalg.norm(z - z.mean(axis=0)) for z in (x, y)]
    assert Procrustes().similarity(x, y) == pytest.approx(orthogonal_procrustes(*unit)[1])
    turned = 3 * x @ np.linalg.qr(rng.normal(size=(20, 20)))[0] + 1
    assert Procrustes().similarity(x, turned) == pytest.approx(1)


@pytest.mark.parametrize("count", [6, 13])
def test_ridge_is_nested_cross_validation_done_by_hand(count):
    rng = np.random.default_rng(6)
    x = rng.normal(size=(count, 9))
    labels = np.repeat(np.arange(count), 5)
    responses = (x @ rng.normal(size=(9, 7)))[labels] + rng.normal(size=(len(labels), 7))
    animal = subject_rdm("a", [Trials(responses, labels)], count)

    def predict(train, test, penalty, within):
        a, mean = x[train] - x[train].mean(axis=0), animal.patterns[train].mean(axis=0)
        # One penalty for all fits within a fold: relative to all its training stimuli.
        scale = penalty * ((x[within] - x[within].mean(axis=0)) ** 2).sum() / len(within)
        weight = np.linalg.solve(a.T @ a + scale * np.eye(9), a.T @ (animal.patterns[train] - mean))
        return (x[test] - x[train].mean(axis=0)) @ weight + mean

    folds = np.arange(count) % min(count, 10)
    error = base = 0.0
    for fold in np.unique(folds):
        test, train = np.flatnonzero(folds == fold), np.flatnonzero(folds != fold)
        inner = [
            sum(
                ((animal.patterns[[t]] - predict(np.setdiff1d(train, t), [t], penalty, train)) ** 2).sum()
                for t in train
            )
            for penalty in PENALTIES
        ]
        best = PENALTIES[int(np.argmin(inner))]
        error += ((animal.patterns[test] - predict(train, test, best, train)) ** 2).sum()
        base += ((animal.patterns[test] - animal.patterns[train].mean(axis=0)) ** 2).sum()
    noise = animal.noise.sum()
    factor = RidgeEncoding().correction(animal, "default").value
    found = RidgeEncoding().compare_orders(x, [animal], np.arange(count)[None])[0, 0]
    assert found * factor == pytest.approx(1 - (error - noise) / (base - noise), rel=1e-8)
    total = animal.patterns.var(axis=0).sum() * count
    assert factor == pytest.approx(total / (total - noise * (count - 1) / count), rel=1e-8)


def test_the_noise_of_the_means_is_that_of_trials():
    rng = np.random.default_rng(7)
    labels = np.repeat(np.arange(6), 400)
    block = Trials(rng.normal(size=(2400, 3)) * [1.0, 2.0, 3.0], labels)
    animal = subject_rdm("a", [block], 6)
    np.testing.assert_allclose(animal.noise.mean(axis=0), np.array([1, 4, 9]) / 400, rtol=0.1)
    expected = np.stack([block.responses[labels == k].var(axis=0, ddof=1) / 400 for k in range(6)])
    np.testing.assert_allclose(animal.noise, expected)


def test_a_perfect_encoder_of_noisy_trials_is_worth_one_and_raw_variance_is_not():
    rng = np.random.default_rng(8)
    latent = rng.normal(size=(20, 2))
    labels = np.repeat(np.arange(20), 6)
    metric, values, raw = RidgeEncoding(), [], []
    for _ in range(8):
        responses = (latent @ rng.normal(size=(2, 30)))[labels] + 2.5 * rng.normal(size=(120, 30))
        animal = subject_rdm("a", [Trials(responses, labels)], 20)
        raw.append(metric.compare_orders(latent, [animal], np.arange(20)[None])[0, 0])
        values.append(raw[-1] * metric.correction(animal, "default").value)
    assert np.mean(values) == pytest.approx(1, abs=0.15)
    assert np.mean(raw) < 0.75


def test_a_metric_of_ones_own_takes_one_file(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "import numpy as np\nfrom brainbench.metrics import PatternMetric\n\n\n"
        "class Mine(PatternMetric):\n    name = 'mine'\n    title = 'share of neighbours'\n\n"
        "    def similarity(self, model, brain):\n"
        "        d = [((x[:, None] - x) ** 2).sum(-1) + 1e9 * np.eye(len(x)) for x in (model, brain)]\n"
        "        return float((d[0].argmin(1) == d[1].argmin(1)).mean())\n"
    )
    metric = get_metric(f"{path}:Mine")
    latent, animals = _make(metric)
    found = _score(metric, {"a": latent, "b": make_latent(77)}, animals)
    assert found.metric == "mine: share of neighbours"
    assert found.value > 0.6
    assert found.p < 0.05
    assert 0 < found.chance < found.attainable <= 1
    with pytest.raises(UsageError, match="did you mean 'Mine'"):
        get_metric(f"{path}:Mina")
    with pytest.raises(DataFileNotFoundError, match="no Python file"):
        get_metric("nowhere.py:Mine")
    path.write_text("1 / 0")
    with pytest.raises(DataError, match="ZeroDivisionError"):
        get_metric(f"{path}:Mine")
    path.write_text("class Half:\n    name = 'x'\n")
    with pytest.raises(UsageError, match="lacks title, animal, score, score_animals"):
        get_metric(f"{path}:Half")


def test_a_metric_without_similarity_says_so():
    class Nothing(PatternMetric):
        name = "nothing"

    latent, animals = _make(Nothing())
    with pytest.raises(UsageError, match="'nothing' does not define"):
        _score(Nothing(), {"a": latent}, animals)


def test_what_cannot_be_scored_is_undefined_or_unreliable_in_words():
    metric = get_metric("ridge")
    latent, animals = _make(metric)
    flat = _score(metric, {"a": np.ones((6, 4)), "b": np.full((6, 4), np.nan)}, animals)
    assert (flat.status, flat.reasons[0]) == ("undefined", "activations of every layer are constant or not finite")
    lacking = metric.animal("z", [make_block(latent, gap=(2,))], 6, stimuli=STIMULI)
    found = _score(metric, {"a": latent, "b": np.ones((6, 4))}, [*animals, lacking])
    assert "animal z left out: no trials of 'convex-far'" in found.reasons
    assert [layer.status for layer in found.layers] == ["ok", "undefined"]
    alone = _score(metric, {"a": latent}, [lacking])
    assert alone.reasons[0] == "no animal can be used"
    labels = np.repeat(np.arange(6), 8)
    silent = [Trials(np.random.default_rng(i).normal(size=(48, 4)), labels) for i in range(3)]
    noise = [metric.animal(str(i), [block], 6) for i, block in enumerate(silent)]
    unreliable = _score(metric, {"a": latent}, noise)
    assert unreliable.status in ("unreliable", "undefined")
    with pytest.raises(UsageError, match=r"'thesis'.*'default'"):
        _score(metric, {"a": latent}, animals, estimator="thesis")
    with pytest.raises(UsageError, match="have 5 rows; 6 stimuli"):
        _score(metric, {"a": latent[:5]}, animals)
    with pytest.raises(UsageError, match="no animals"):
        _score(metric, {"a": latent}, [])


def test_many_stimuli_take_random_orders():
    rng = np.random.default_rng(9)
    latent = rng.normal(size=(12, 3))
    metric = get_metric("ridge")
    animals = [metric.animal(f"m{i}", [make_block(latent, seed=i)], 12) for i in range(3)]
    controls = {"raw input": rng.normal(size=(12, 3))}
    found = metric.score({"a": latent}, animals, name="x", stimuli=[str(k) for k in range(12)], controls=controls)
    assert found.p == pytest.approx(1 / 1000)
    assert "999 random orders" in found.p_method
    part = found.provenance.unique
    assert (part.status, part.layer, part.controls) == ("ok", "a", ("raw input",))
    assert part.low < part.unique < part.high


def _mixing(hidden, raw, share, *, count=4, noise=1.0, seed=0):
    """Animals that mix features of the input and hidden ones, of which they have a share."""
    rng, metric, animals = np.random.default_rng(seed), RidgeEncoding(), []
    labels = np.repeat(np.arange(len(raw)), 8)
    for index in range(count):
        parts = [part @ rng.normal(size=(part.shape[1], 20)) for part in (raw, hidden)]
        tuned = np.sqrt(1 - share) * parts[0] / parts[0].std() + np.sqrt(share) * parts[1] / parts[1].std()
        trials = tuned[labels] + noise * rng.normal(size=(len(labels), 20))
        keys = [f"{index}/{row}" for row in range(len(labels))]
        animals.append(metric.animal(f"m{index}", [Trials(trials, labels, keys)], len(raw), splits=20))
    return animals


def _unique(layers, raw, animals, **options):
    return RidgeEncoding().unique(layers, {"raw input": raw}, animals, np.ones(len(animals)), **options)


def test_the_unique_part_of_ridge_is_none_for_a_copy_and_nearly_all_for_the_hidden_network():
    rng = np.random.default_rng(0)
    raw, hidden = rng.normal(size=(2, 18, 4))
    animals = _mixing(hidden, raw, 1.0)
    copied = _unique({"copy": 3 * raw @ np.linalg.qr(rng.normal(size=(4, 4)))[0]}, raw, animals)
    assert copied.unique == pytest.approx(0, abs=1e-9)
    assert copied.shared == pytest.approx(copied.total, abs=1e-9)
    part = _unique({"luck": rng.normal(size=(18, 4)), "hidden": hidden}, raw, animals)
    assert (part.status, part.layer) == ("ok", "hidden")
    assert part.unique > 0.85
    assert part.low > 0.6
    assert part.total == pytest.approx(part.unique + part.shared + part.controls_alone)
    assert _unique({"luck": rng.normal(size=(18, 4)), "hidden": hidden}, raw, animals, committed="luck").unique < 0.1
    mixed = _unique({"hidden": hidden}, raw, _mixing(hidden, raw, 0.5))
    assert 0.3 < mixed.unique < 0.65
    assert 0.3 < mixed.controls_alone < 0.65


def test_networks_of_many_layers_that_know_nothing_have_no_unique_part_for_ridge():
    parts = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        raw, hidden = rng.normal(size=(2, 14, 4))
        layers = {f"layer {index}": rng.normal(size=(14, 6)) for index in range(4)}
        parts.append(_unique(layers, raw, _mixing(hidden, raw, 0.5, count=3, seed=seed)))
    assert np.mean([part.unique for part in parts]) < 0.05
    assert not any(part.low > 0 for part in parts)


def test_the_unique_part_of_ridge_says_what_it_lacks_and_does_not_depend_on_the_order_of_stimuli():
    rng = np.random.default_rng(1)
    raw, hidden = rng.normal(size=(2, 12, 4))
    animals = _mixing(hidden, raw, 0.5, count=2)
    assert "no control has differences" in _unique({"a": hidden}, np.ones((12, 2)), animals).reasons[0]
    assert "no layer has a value" in _unique({"a": np.full((12, 2), np.nan)}, raw, animals).reasons[0]
    few = [animal.take(np.arange(9)) for animal in animals]
    assert "9 stimuli are too few" in _unique({"a": hidden[:9]}, raw[:9], few).reasons[0]
    order = rng.permutation(12)
    first = _unique({"a": hidden}, raw, animals)
    second = _unique({"a": hidden[order]}, raw[order], [animal.take(order) for animal in animals])
    assert (second.unique, second.low) == pytest.approx((first.unique, first.low), abs=1e-9)


def test_errors_and_losses_without_a_stimulus_are_those_of_fits_that_never_had_it():
    rng = np.random.default_rng(2)
    features, responses = rng.normal(size=(12, 5)), rng.normal(size=(12, 3))
    train, test = np.arange(3, 12), np.arange(3)
    every, combinations = _fits((features @ features.T)[None], train, test)
    products = centred_products(responses)
    losses = _losses_without(every, products[None])[0]
    centred = features[train] - features[train].mean(axis=0)

    def error(rest, judged, penalty):
        x, y = (part[rest] - part[rest].mean(axis=0) for part in (features, responses))
        slope = np.linalg.solve(x.T @ x + penalty * np.eye(5), x.T @ y)
        predicted = (features[judged] - features[rest].mean(axis=0)) @ slope + responses[rest].mean(axis=0)
        return ((responses[judged] - predicted) ** 2).sum()

    for place in (2, 4):
        penalty = PENALTIES[place] * (centred**2).sum() / len(train)
        errors = _errors_without(every[place], combinations[place], products, test)
        for without in (None, 3, 7, 1):
            column = 0 if without is None else 1 + without
            rest, judged = (side[side != without] for side in (train, test))
            assert errors[column] == pytest.approx(error(rest, judged, penalty))
            expected = sum(error(np.setdiff1d(rest, t), np.array([t]), penalty) for t in rest)
            assert losses[place, column] == pytest.approx(expected)


def test_the_interval_of_ridge_repeats_the_choice_of_penalties_and_layers(monkeypatch):
    """Where a network knows little, most of the uncertainty is whether its penalty and its layer are chosen."""
    rng = np.random.default_rng(3)
    hidden, raw = rng.normal(size=(2, 14, 4))
    layers = {"hidden": hidden, **{str(index): rng.normal(size=(14, 4)) for index in range(3)}}
    widths = []
    for anew in (True, False):
        monkeypatch.setattr(RidgeEncoding, "chooses_anew", anew)
        score = get_metric("ridge").score(layers, _mixing(hidden, raw, 0.2), name="", stimuli=list(map(str, range(14))))
        widths.append(score.interval.high - score.interval.low)
    assert widths[0] > 1.2 * widths[1]


def _r2(y, *x):
    design = np.column_stack([np.ones(len(y)), *x])
    rest = y - design @ np.linalg.lstsq(design, y, rcond=None)[0]
    return 1 - rest @ rest / ((y - y.mean()) @ (y - y.mean()))


def test_the_parts_are_differences_of_r_squared_and_add_up():
    rng = np.random.default_rng(0)
    model, one, two = (make_rdm(rng) for _ in range(3))
    brain = np.stack([model + one + 0.3 * make_rdm(rng) for _ in range(3)])
    found = variance_partition(model, {"contacts": one, "licks": two}, brain)
    full = np.mean([_r2(y, model, one, two) for y in brain])
    nuisance = np.mean([_r2(y, one, two) for y in brain])
    alone = np.mean([_r2(y, model) for y in brain])
    assert found.total == pytest.approx(full)
    assert found.unique_model == pytest.approx(full - nuisance)
    assert found.unique_nuisance == pytest.approx(full - alone)
    assert found.unique_model + found.unique_nuisance + found.shared == pytest.approx(found.total)
    assert found.nuisances == ("contacts", "licks")


def test_a_model_that_is_only_the_nuisance_has_no_unique_share():
    rng = np.random.default_rng(1)
    contacts = make_rdm(rng)
    brain = np.stack([contacts + 0.1 * make_rdm(rng) for _ in range(4)])
    copied = variance_partition(contacts + 0.05 * make_rdm(rng), {"contacts": contacts}, brain)
    assert copied.unique_model < 0.1
    assert copied.p > 0.05
    assert copied.shared > 0.8
    geometry = make_rdm(rng)
    true = variance_partition(geometry, {"contacts": contacts}, brain + 2 * geometry)
    assert true.p <= 0.01
    assert true.partial_r > 0.9
    assert true.unique_model > true.chance


def test_p_values_of_unrelated_models_are_uniform():
    rng = np.random.default_rng(2)
    p = []
    for _ in range(200):
        nuisance, model = make_rdm(rng), make_rdm(rng)
        p.append(variance_partition(model, {"n": nuisance}, nuisance + make_rdm(rng)).p)
    assert 0.01 <= np.mean(np.array(p) <= 0.05) <= 0.1
    assert np.mean(p) == pytest.approx(0.5, abs=0.07)


def test_misuse_is_told_in_a_sentence():
    rng = np.random.default_rng(3)
    model = make_rdm(rng)
    with pytest.raises(UsageError, match="no nuisances"):
        variance_partition(model, {}, model)
    with pytest.raises(DataError, match="missing pairs"):
        variance_partition(model, {"a": np.full(15, np.nan)}, model)
    with pytest.raises(DataError, match="too few to fit 4 nuisances"):
        variance_partition(model[:6], {str(i): model[:6] for i in range(4)}, model[:6])
    with pytest.raises(UsageError, match="different numbers of stimuli"):
        variance_partition(model[:10], {"a": model}, model)
    few = variance_partition(model, {"a": model}, make_rdm(rng))
    assert np.isnan(few.p)
    assert "no more than the nuisances explain" in few.reason
