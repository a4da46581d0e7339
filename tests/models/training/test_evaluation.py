from __future__ import annotations

import hashlib
import json
import logging
import math

import pytest
import torch
from torch import nn

from brainbench.core.errors import DataError, UsageError
from brainbench.core.statistics import wilson_interval
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.batches import BatchOptions
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.evaluation import (
    Evaluation,
    RawInput,
    baselines,
    checkpoint_info,
    collapse,
    describe_twin,
    draw_twin,
    evaluate,
    fit_probe,
    model_card,
    sweeps_hash,
    topk,
)
from brainbench.models.training.trainer import train
from tests.factories.training_sweeps import ArrayBatches, sweeps, tiny


class Fixed(nn.Module):
    """Answers with the first values of the stimulus."""

    def __init__(self, classes):
        super().__init__()
        self.classes = classes

    def forward(self, x):
        return x.flatten(1)[:, : self.classes]


def test_top_k_counts_labels_among_the_largest_and_ties_against_the_network():
    answers = torch.tensor([[3.0, 2.0, 1.0], [1.0, 2.0, 3.0], [1.0, 1.0, 1.0], [math.nan, 0.0, 0.0]])
    labels = torch.tensor([0, 1, 0, 0])
    assert [topk(answers, labels, k) for k in (1, 2)] == [1, 2]
    # An answer that is no number is ahead of none, and makes no other one right.
    assert topk(torch.tensor([[1.0, math.nan, math.nan]]), torch.tensor([0]), 1) == 0


def test_accuracy_is_counted_over_batches():
    x = torch.eye(6).view(6, 1, 6, 1, 1)
    labels = torch.tensor([0, 1, 2, 3, 4, 0])
    result = evaluate(Fixed(6), [(x[:4], labels[:4]), (x[4:], labels[4:])])
    assert (result.top1, result.count, result.predicted) == (pytest.approx(5 / 6), 6, 6)
    assert not result.collapsed
    assert math.isnan(result.spread)
    again = evaluate(Fixed(6), [(x[:4], labels[:4]), (x[4:], labels[4:])])
    assert again.data == result.data != evaluate(Fixed(6), [(x, labels.flip(0))]).data


def test_the_hash_of_sweeps_does_not_depend_on_their_batches():
    x, labels = torch.rand(1030, 4), torch.arange(1030) % 4
    parts = [(x[:1024], labels[:1024]), (x[1024:], labels[1024:])]
    # Records that exist were made of batches of 1,024.
    known = hashlib.sha256(b"".join(item.numpy().tobytes() for part in parts for item in part)).hexdigest()[:16]
    for size in (1024, 1030, 7, 500):
        batches = list(zip(x.split(size), labels.split(size), strict=True))
        assert evaluate(Fixed(4), batches).data == sweeps_hash(batches) == known


def test_a_network_that_always_gives_one_class_has_collapsed():
    x = torch.tensor([1.0, 0.0, 0.0]).view(1, 1, 3, 1, 1).expand(6, -1, -1, -1, -1)
    result = evaluate(Fixed(3), [(x, torch.tensor([0, 1, 2, 0, 1, 2]))])
    assert result.collapsed
    assert result.reason == "one class is predicted for every sweep"


def test_features_in_one_point_have_collapsed():
    model = load_model("zhuang-small", classes=3)
    x = 1e-4 * torch.randn(6, 5, 30, 5, 7)
    assert not evaluate(model, [(x, torch.arange(6) % 3)]).collapsed
    with torch.no_grad():
        model.encoder.node("fc8").operation.weight.zero_()
        model.encoder.node("fc8").operation.bias.fill_(1.0)
    assert evaluate(model, [(x, torch.arange(6) % 3)]).collapsed
    assert collapse(2, 3, 0.001).startswith("the features of all sweeps are nearly equal")
    assert collapse(2, 3, math.nan) == ""


def test_an_empty_data_set_is_refused():
    with pytest.raises(DataError, match="gave no batch"):
        evaluate(Fixed(3), [])


class _Frozen(nn.Module):
    """Passes its input on as features."""

    features = 3

    def __init__(self):
        super().__init__()
        self.decoder = nn.Linear(3, 2)

    def encode(self, x, *, last=False):
        return x


def _batches(scales):
    generator = torch.Generator().manual_seed(0)
    labels = torch.arange(200) % 2
    x = torch.randn(200, 3, generator=generator)
    x[:, 0] += 4.0 * labels
    return x * torch.tensor(scales), labels


def test_a_probe_reads_features_of_any_scale():
    x, labels = _batches((1e-3, 1e-3, 1e-3))
    layer = fit_probe(_Frozen(), [(x, labels)], classes=2, epochs=20)
    assert (layer(x).argmax(1) == labels).float().mean() > 0.95


def test_features_that_hardly_vary_leave_weights_that_half_precision_holds():
    x, labels = _batches((1.0, 1e-9, 0.0))
    layer = fit_probe(_Frozen(), [(x, labels)], classes=2, epochs=20)
    assert torch.isfinite(layer.weight.half()).all()
    assert (layer(x).argmax(1) == labels).float().mean() > 0.95


def test_a_probe_whose_features_do_not_fit_into_memory_reads_them_anew():
    x, labels = _batches((1.0, 1.0, 1.0))
    batches = [(x[start : start + 32], labels[start : start + 32]) for start in range(0, 200, 32)]
    held = fit_probe(_Frozen(), batches, classes=2, epochs=20)
    roomy = fit_probe(_Frozen(), batches, classes=2, epochs=20, memory=x.nbytes)
    assert torch.equal(roomy.weight, held.weight)
    narrow = fit_probe(_Frozen(), batches, classes=2, epochs=20, memory=x.nbytes // 3)
    assert not torch.equal(narrow.weight, held.weight)
    assert (narrow(x).argmax(1) == labels).float().mean() > 0.95
    assert torch.equal(fit_probe(_Frozen(), iter(batches), classes=2, epochs=20).weight, held.weight)
    with pytest.raises(UsageError, match="list_iterator"):
        fit_probe(_Frozen(), iter(batches), classes=2, epochs=20, memory=x.nbytes // 3)


def _toy(count, seed, *, mixed=False):
    x, labels = sweeps(count, seed, steps=2)
    if mixed:
        labels = labels[torch.randperm(count, generator=torch.Generator().manual_seed(seed))]
    return ArrayBatches(x, labels, BatchOptions(64, shuffle=seed == 0))


def _baselines(**changes):
    mixed = changes.pop("mixed", False)
    options = {"features": 96, "classes": 3, "epochs": 10} | changes
    return baselines(_toy(300, 0, mixed=mixed), _toy(300, 1, mixed=mixed), **options)


def test_baselines_read_what_the_input_shows_and_nothing_from_mixed_labels():
    found = _baselines()
    assert list(found) == ["raw-input", "random-features"]
    assert min(item.top1 for item in found.values()) > 0.95
    assert {item.data for item in found.values()} == {evaluate(Fixed(3), _toy(300, 1)).data}
    assert all(abs(item.top1 - 1 / 3) < 0.12 for item in _baselines(mixed=True).values())


def test_baselines_repeat_with_the_seed():
    first = _baselines(features=2)
    assert first == _baselines(features=2)
    assert first["random-features"] != _baselines(features=2, seed=1)["random-features"]


def test_the_raw_input_is_every_number_of_the_sweep_in_order():
    x, _ = sweeps(3, 0, steps=2)
    features = RawInput().encode(x, last=True)
    assert features.shape == (3, 2 * 30 * 5 * 7)
    assert features[1, 1050 + 3 * 35 + 8] == pytest.approx(float(x[1, 1, 3, 1, 1]) / 1e-6)


def test_baselines_of_batches_that_can_be_read_once_are_refused():
    with pytest.raises(UsageError, match="generator"):
        baselines((batch for batch in _toy(8, 0)), _toy(8, 1), features=2, classes=3, epochs=1)


DATA = {"hash": "0123abcd", "train": 3259, "validation": 405, "test": 407, "left_out": 921, "classes": 2}


def _found(correct, count=400):
    return Evaluation(correct / count, 0.9, wilson_interval(correct, count), count, 2, 0.8, False, "", "feed")


def _card(correct, twin=None, **changes):
    config = TrainingConfig.published("zhuang-small", "simclr", epochs=3)
    start = {"name": "zhuang-small", "seed": 0}
    known = {"epochs_done": 3, "best_epoch": 2, "evaluation": _found(correct), "twin": start}
    info = checkpoint_info(config, ("a", "b"), **known, **changes)
    if twin is not None:
        info["twin_evaluation"] = {
            "top1": twin / 400,
            "interval": {"low": wilson_interval(twin, 400).low, "high": wilson_interval(twin, 400).high},
        }
    return model_card(config, info | {"data": DATA})


def test_a_card_says_what_was_trained_on_what_and_for_how_long():
    text = _card(200)
    assert "3 (published: 100); best: 2" in text
    assert "0123abcd: 3,259 sweeps to train, 405 to validate, 407 of other objects to test; 921 left out" in text
    assert "0.500 [0.451, 0.549] on 400 sweeps (linear probe on the frozen network)" in text
    assert "gradients clipped to a norm of 1" in text


def test_a_card_says_that_objects_of_the_test_were_trained_on(monkeypatch):
    monkeypatch.setitem(DATA, "test_of_trained_objects", 12)
    text = _card(200)
    assert "407 to test, 12 of them of objects that were trained on; 921 left out" in text
    assert "other objects" not in text


@pytest.mark.parametrize(
    ("correct", "verdict"),
    [(240, "training helped"), (205, "less than these intervals can tell"), (150, "training made it worse")],
)
def test_a_card_does_not_hide_that_the_untrained_twin_is_as_good(correct, verdict):
    assert verdict in _card(correct, twin=200)


def test_a_card_compares_with_the_raw_input_and_random_features():
    controls = {"raw-input": _found(100), "random-features": _found(120), "untrained-twin": _found(180)}
    text = _card(200, controls=controls)
    assert "| raw input | linear probe: top-1 0.250 [0.210, 0.295] |" in text
    assert "| random features | linear probe: top-1 0.300" in text
    assert "zhuang-small, seed 0, linear probe: top-1 0.450" in text


def test_a_card_without_its_twin_claims_nothing():
    assert "| untrained twin | zhuang-small, seed 0 |" in _card(200)


MODEL = "s4-small"


def _train(out, **options):
    config = TrainingConfig.published(
        MODEL, epochs=2, batch_size=8, augmentation="none", probe_epochs=2, seed=5, precision="float32"
    )
    return train(config, tiny(), out=out, device="cpu", **options)


def test_a_checkpoint_says_how_to_get_the_network_that_its_training_started_from(tmp_path):
    folder = _train(tmp_path).folder
    stated = describe_model(f"local-dir:{folder}").trained
    model, told = draw_twin(stated["twin"], stated["options"])
    assert told == ""
    plain = load_model(stated["twin"]["name"], seed=stated["twin"]["seed"])
    assert torch.equal(plain.encoder.embed.bias, model.encoder.embed.bias)
    assert not torch.equal(load_model(f"local-dir:{folder}").encoder.embed.bias, model.encoder.embed.bias)


def test_the_hash_knows_names_shapes_and_every_bit():
    first = describe_twin(MODEL, 0, load_model(MODEL, classes=3))
    assert first == describe_twin(MODEL, 0, load_model(MODEL, classes=3))
    changed = load_model(MODEL, classes=3)
    with torch.no_grad():
        weight = changed.encoder.embed.weight
        weight[0, 0] = torch.nextafter(weight[0, 0], torch.tensor(1.0))
    others = (changed, load_model(MODEL, classes=3, seed=1), load_model(MODEL, classes=4))
    assert len({describe_twin(MODEL, 0, model)["state"] for model in others} | {first["state"]}) == 4


def test_a_twin_that_is_drawn_otherwise_elsewhere_is_noticed():
    here = describe_twin(MODEL, 0, load_model(MODEL, classes=3))
    _, told = draw_twin(here | {"state": "0" * 32, "torch": "1.0"}, {"classes": 3})
    assert "1.0" in told
    assert torch.__version__ in told


def test_a_resumed_run_keeps_the_twin_that_it_started_from(tmp_path, caplog):
    _train(tmp_path, stop_after=0.0)
    run = json.loads((tmp_path / "run.json").read_text())
    run["twin"] |= {"state": "0" * 32, "torch": "1.0"}
    (tmp_path / "run.json").write_text(json.dumps(run))
    with caplog.at_level(logging.WARNING):
        folder = _train(tmp_path).folder
    stated = json.loads((folder / "config.json").read_text())["twin"]
    assert stated["state"] == "0" * 32
    assert "without its untrained twin" in caplog.text
    controls = json.loads((tmp_path / "controls.json").read_text())["controls"]
    assert set(controls) == {"raw-input", "random-features"}
