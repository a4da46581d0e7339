import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from brainbench.core.errors import DataError, UsageError
from brainbench.core.runs.folder import mark
from brainbench.core.runs.log import read_log
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training import trainer
from brainbench.models.training.batches import BatchOptions
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.evaluation import evaluate, fit_probe
from brainbench.models.training.objectives import Learner, make_learner
from brainbench.models.training.trainer import train
from brainbench.scoring.model_responses import resolve_model
from tests.factories.training_sweeps import CLASSES, sweeps, tiny

MODEL = "zhuang-small"


def _config(objective="supervised", **changes):
    options = {
        "epochs": 2,
        "batch_size": 8,
        "optimizer": "adamw",
        "learning_rate": 1e-3,
        "schedule": "constant",
        "augmentation": "none",
        "probe_epochs": 3,
        "precision": "float32",
    }
    return TrainingConfig.published(changes.pop("model", MODEL), objective, **(options | changes))


def _weights(folder):
    return load_file(Path(folder) / "best" / "model.safetensors")


def _equal(first, second):
    return first.keys() == second.keys() and all(torch.equal(value, second[name]) for name, value in first.items())


def test_a_run_learns_what_can_be_learned_and_leaves_a_model_to_load(tmp_path):
    result = train(_config(epochs=5), tiny(), out=tmp_path, device="cpu")
    assert result.status == "finished"
    assert (result.steps, result.epochs) == (15, 5)
    assert result.evaluation.top1 > 0.8
    assert not result.evaluation.collapsed
    model = load_model(f"local-dir:{result.folder}")
    x, labels = sweeps(9, 2)
    with torch.no_grad():
        assert (model(x).argmax(1) == labels).float().mean() == pytest.approx(result.evaluation.top1)
    known = describe_model(f"local-dir:{result.folder}")
    assert known.trained["classes"] == list(CLASSES)
    assert known.trained["evaluation"]["top1"] == pytest.approx(result.evaluation.top1)
    assert (known.trained["twin"]["name"], known.trained["twin"]["seed"]) == (MODEL, 0)
    card = (result.folder / "README.md").read_text()
    assert f"{MODEL}.supervised" in card
    assert "5 (published: 100)" in card
    losses = [line["loss"] for line in read_log(tmp_path, "epoch")]
    assert losses[-1] < losses[0]


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_accuracy_on_sweeps_that_chose_the_weights_is_told(tmp_path, caplog, split):
    data = tiny(validation=9 * (split != "train"), test=9 * (split == "test"))
    result = train(_config(epochs=1, probe_epochs=0), data, out=tmp_path, device="cpu")
    told = [text for text in (caplog.text, (result.folder / "README.md").read_text()) if f"{split} sweeps" in text]
    assert len(told) == (0 if split == "test" else 2)
    stated = resolve_model(f"local-dir:{result.folder}").card.training
    assert stated.get("evaluated_split") == (None if split == "test" else split)


def test_on_the_cpu_precision_is_single_unless_asked_otherwise(tmp_path):
    train(_config(precision="auto", epochs=1), tiny(), out=tmp_path, device="cpu")
    assert json.loads((tmp_path / "run.json").read_text())["run"]["precision"] == "float32"


def test_an_epoch_may_end_with_a_single_sweep(tmp_path):
    config = _config("simsiam", model="s4-small", epochs=1, augmentation="physical", probe_epochs=0)
    result = train(config, tiny(train=9), out=tmp_path, device="cpu")
    assert (result.status, result.steps) == ("finished", 2)
    assert result.evaluation is None  # no probe, no accuracy
    assert "top-1" not in (result.folder / "README.md").read_text()


@pytest.mark.parametrize("objective", ["simclr", "simsiam"])
def test_a_sweep_alone_has_nothing_to_be_compared_with(tmp_path, objective):
    """Its loss is 0 by definition: it lowered the mean of an epoch, and made a validation of one sweep the best."""
    config = _config(objective, epochs=1, augmentation="physical", probe_epochs=0)
    with pytest.raises(DataError, match=f"No batch of the training sweeps has two of them, which {objective} compares"):
        train(config, tiny(train=1), out=tmp_path / "one", device="cpu")
    train(config, tiny(train=8, validation=1), out=tmp_path / "whole", device="cpu")
    train(config, tiny(train=9, validation=1), out=tmp_path / "rest", device="cpu")
    for name in ("whole", "rest"):
        assert not read_log(tmp_path / name, "validation")
        assert read_log(tmp_path / name, "epoch")[0]["loss"] != pytest.approx(0.0, abs=1e-9)


def test_every_sweep_counts_alike_in_a_validation_whose_last_batch_is_short(tmp_path, monkeypatch):
    class Mean(Learner):
        def forward(self, views, labels):
            return 1e4 * views[0].mean() + 0 * sum(parameter.sum() for parameter in self.parameters())

    monkeypatch.setattr(trainer, "make_learner", lambda objective, model: Mean(model))
    data = tiny(validation=9)
    train(_config("ae", epochs=1, probe_epochs=0), data, out=tmp_path, device="cpu")
    expected = 1e4 * float(data.splits["validation"][0].mean())
    assert read_log(tmp_path, "validation")[0]["loss"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("model", ["zhuang-small.simclr", "zhuang-small.ae"])
def test_training_starts_from_no_trained_weights_which_would_be_its_untrained_twin(tmp_path, model):
    for begin in (
        lambda: _config(model=model),
        lambda: train(TrainingConfig(model, epochs=1), tiny(), out=tmp_path / "run", device="cpu"),
    ):
        with pytest.raises(UsageError, match=rf"Training starts from new weights, .*'{model}'.*: train 'zhuang-small'"):
            begin()


def test_an_autoencoder_is_validated_on_every_sweep(tmp_path):
    config = _config("ae", epochs=1, probe_epochs=0)
    train(config, tiny(validation=1), out=tmp_path, device="cpu")
    assert read_log(tmp_path, "validation")[0]["loss"] > 0


@pytest.mark.parametrize("objective", ["simclr", pytest.param("simsiam", marks=pytest.mark.slow), "ae"])
def test_self_supervised_runs_end_with_a_linear_probe(objective, tmp_path):
    result = train(_config(objective, augmentation="physical"), tiny(), out=tmp_path, device="cpu")
    assert result.status == "finished"
    assert result.evaluation.count == 9
    trained, fresh = load_model(f"local-dir:{result.folder}"), load_model(MODEL, classes=3)
    assert trained.decoder.weight.shape == (3, 96)
    assert not torch.equal(trained.encoder.node("fc8").operation.weight, fresh.encoder.node("fc8").operation.weight)
    assert {line["kind"] for line in _lines(tmp_path)} == {"epoch", "validation", "test"}


def _lines(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("objective", ["supervised", pytest.param("simclr", marks=pytest.mark.slow)])
def test_a_run_stopped_after_every_step_ends_as_an_unbroken_one(objective, tmp_path):
    config = _config(objective, model="resnet18-small+gpt", augmentation="physical", optimizer="sgd", masking=0.25)
    train(config, tiny(), out=tmp_path / "whole", device="cpu")
    for _ in range(7):
        result = train(config, tiny(), out=tmp_path / "broken", device="cpu", stop_after=0.0)
        if result.status == "finished":
            break
    assert result.status == "finished"
    assert _equal(_weights(tmp_path / "whole"), _weights(tmp_path / "broken"))
    clock = ("seconds", "sweeps_per_second")
    logs = [
        [{key: value for key, value in line.items() if key not in clock} for line in _lines(tmp_path / name)]
        for name in ("whole", "broken")
    ]
    assert logs[0] == logs[1]


def test_the_log_says_how_fast_every_epoch_was(tmp_path):
    train(_config(epochs=2), tiny(), out=tmp_path, device="cpu")
    epochs = [line for line in _lines(tmp_path) if line["kind"] == "epoch"]
    assert len(epochs) == 2
    # 0.001 s is what the log rounds to.
    sweeps = [line["seconds"] * line["sweeps_per_second"] for line in epochs]
    assert sweeps == pytest.approx([24, 24], rel=0.05)


def test_equal_seeds_give_equal_weights_and_others_do_not(tmp_path):
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        train(_config(epochs=1, seed=seed), tiny(test=0), out=tmp_path / name, device="cpu")
    assert _equal(_weights(tmp_path / "a"), _weights(tmp_path / "b"))
    assert not _equal(_weights(tmp_path / "a"), _weights(tmp_path / "c"))


@pytest.mark.parametrize(
    ("model", "objective"),
    [
        ("zhuang-small", "supervised"),
        ("zhuang-intersection-ln-small", "simclr"),
        ("s4-small+gpt", "supervised"),
        ("resnet18-small+gpt", "ae"),
        pytest.param("zhuang-feedforward-small", "supervised", marks=pytest.mark.slow),  # decoder of all steps
        pytest.param("zhuang-gru-ln-small+mamba", "simsiam", marks=pytest.mark.slow),
    ],
)
def test_training_starts_from_the_model_of_that_name_and_seed(model, objective, tmp_path, monkeypatch):
    starts = []

    def remember(objective, model):
        starts.append({name: value.clone() for name, value in model.state_dict().items()})
        return make_learner(objective, model)

    monkeypatch.setattr("brainbench.models.training.trainer.make_learner", remember)
    config = _config(objective, model=model, seed=3, epochs=1)
    for _ in range(2):  # begun, and gone on with
        train(config, tiny(), out=tmp_path, device="cpu", stop_after=0.0)
    same = load_model(model, seed=3, classes=3, decoder=config.decoder).state_dict()
    features = {name: value for name, value in load_model(model, seed=3).state_dict().items() if "decoder." not in name}
    assert len(features) > 5
    for start in starts:
        assert _equal(start, same)
        assert _equal({name: start[name] for name in features}, features)


def test_a_finished_run_is_not_repeated(tmp_path):
    first = train(_config(epochs=1), tiny(), out=tmp_path, device="cpu")
    again = train(_config(epochs=1), tiny(), out=tmp_path, device="cpu")
    assert again.evaluation == first.evaluation
    assert len(_lines(tmp_path)) == 3


def test_a_run_killed_before_it_is_marked_as_finished_logs_its_test_once(tmp_path, monkeypatch):
    def killed(document, **values):
        if values.get("status") == "finished":
            raise KeyboardInterrupt
        mark(document, **values)

    with monkeypatch.context() as patch:
        patch.setattr("brainbench.models.training.trainer.folder.mark", killed)
        with pytest.raises(KeyboardInterrupt):
            train(_config(epochs=1), tiny(), out=tmp_path, device="cpu")
    result = train(_config(epochs=1), tiny(), out=tmp_path, device="cpu")
    assert [line["top1"] for line in read_log(tmp_path, "test")] == [result.evaluation.top1]


@pytest.mark.slow
def test_a_run_is_compared_with_raw_input_random_features_and_its_twin_once(tmp_path, monkeypatch):
    shared = tmp_path / "search"
    first = train(_config(epochs=1), tiny(), out=shared / "a", controls=shared, device="cpu")
    assert set(first.controls) == {"raw-input", "random-features", "untrained-twin"}
    assert {item.data for item in first.controls.values()} == {first.evaluation.data}
    stated = json.loads((first.folder / "config.json").read_text())
    assert stated["baselines"]["raw-input"]["top1"] == first.controls["raw-input"].top1
    assert stated["twin_evaluation"]["top1"] == first.controls["untrained-twin"].top1
    model = load_model(MODEL, classes=3)
    fit_probe(model, tiny().batches("train", BatchOptions(8)), classes=3, epochs=3)
    assert evaluate(model, tiny().batches("test", BatchOptions(8, shuffle=False))) == first.controls["untrained-twin"]

    computed = []
    monkeypatch.setattr("brainbench.models.training.trainer.baselines", lambda *args, **kw: computed.append(1) or {})
    other = train(_config(epochs=1, learning_rate=1e-2), tiny(), out=shared / "b", controls=shared, device="cpu")
    again = train(_config(epochs=1), tiny(), out=shared / "a", controls=shared, device="cpu")
    assert first.controls == other.controls == again.controls
    # The second one found them in a file, whose order is another one.
    assert list(other.controls) == list(first.controls)
    assert not computed
    train(_config(epochs=1, batch_size=6), tiny(), out=shared / "h", controls=shared, device="cpu")
    assert computed.pop()  # the probes see the sweeps in another order
    train(_config(epochs=1), tiny(test=6), out=shared / "c", controls=shared, device="cpu")
    assert computed.pop()  # other sweeps
    train(_config(epochs=1), tiny(train=21, test=6), out=shared / "d", controls=shared, device="cpu")
    assert computed.pop()  # other training sweeps, the same test
    told = tiny(train=21, test=6)
    told.summary = {"hash": "a", "classes": 3, "left_out": 0, "train": 21, "validation": 9, "test": 6}
    train(_config(epochs=1), told, out=shared / "e", controls=shared, device="cpu")
    computed.clear()
    train(_config(epochs=1), told, out=shared / "f", controls=shared, device="cpu")
    assert not computed
    told.summary = told.summary | {"hash": "b"}
    train(_config(epochs=1), told, out=shared / "g", controls=shared, device="cpu")
    assert computed


@pytest.mark.parametrize("changes", [{"decoder": "lineer"}, {"model": "zhuangg-small"}])
def test_a_run_that_cannot_begin_takes_no_folder(tmp_path, changes):
    wrong = replace(_config(epochs=1), **changes)
    with pytest.raises(UsageError, match=next(iter(changes.values()))):
        train(wrong, tiny(), out=tmp_path, device="cpu")
    assert train(_config(epochs=1), tiny(), out=tmp_path, device="cpu").status == "finished"


def test_the_random_state_of_others_is_left_alone(tmp_path):
    torch.manual_seed(11)
    expected = torch.rand(2)
    torch.manual_seed(11)
    train(_config(epochs=1), tiny(), out=tmp_path, device="cpu")
    assert torch.equal(torch.rand(2), expected)


def test_a_loss_that_is_not_finite_ends_the_run_and_keeps_the_last_good_model(tmp_path):
    data = tiny()
    train(_config(epochs=1), data, out=tmp_path, device="cpu")
    good = _weights(tmp_path)
    (tmp_path / "run.json").unlink()
    x, labels = data.splits["train"]
    data.splits["train"] = (x.clone(), labels)
    data.splits["train"][0][3] = torch.nan
    result = train(_config(epochs=3), data, out=tmp_path, device="cpu")
    assert result.status == "diverged"
    assert "the loss was nan" in result.reason
    assert f"{x[3].numel():,} values of this batch are not finite (NaN or infinite)" in result.reason
    assert _equal(_weights(tmp_path), good)
    failed = load_file(tmp_path / "failed-batch.safetensors")
    assert torch.isnan(failed["view0"]).any()
    assert len(failed["labels"]) == 8


def test_a_folder_of_another_run_is_refused(tmp_path):
    train(_config(epochs=1), tiny(), out=tmp_path, device="cpu")
    with pytest.raises(UsageError, match=r"learning_rate 0\.001 \(now 0\.01"):
        train(_config(epochs=1, learning_rate=0.01), tiny(), out=tmp_path, device="cpu")


def test_a_damaged_state_is_named(tmp_path):
    train(_config(), tiny(), out=tmp_path, device="cpu", stop_after=0.0)
    (tmp_path / "state.safetensors").write_bytes(b"nothing")
    with pytest.raises(DataError, match=r"/state\.safetensors' "):
        train(_config(), tiny(), out=tmp_path, device="cpu")


def test_missing_data_and_devices_are_named(tmp_path):
    with pytest.raises(UsageError, match=r"stop_after must be a finite number, at least 0; received nan"):
        train(_config(), tiny(), out=tmp_path, device="cpu", stop_after=float("nan"))
    with pytest.raises(DataError, match="no split 'train'"):
        train(_config(), tiny(train=0), out=tmp_path, device="cpu")
    with pytest.raises(UsageError, match=r"'tpuu' .*cuda:N"):
        train(_config(), tiny(), out=tmp_path, device="tpuu")


def test_mixed_precision_trains_and_half_precision_weights_are_evaluated_as_shipped(tmp_path):
    config = _config(epochs=1, precision="bf16", weights_dtype="float16")
    result = train(config, tiny(), out=tmp_path, device="cpu")
    assert {str(value.dtype) for name, value in _weights(tmp_path).items() if "scale" not in name} >= {"torch.float16"}
    x, labels = sweeps(9, 2)
    with torch.no_grad():
        again = (load_model(f"local-dir:{result.folder}")(x).argmax(1) == labels).float().mean()
    assert again == pytest.approx(result.evaluation.top1)


def test_the_probe_of_half_precision_weights_is_evaluated_as_shipped(tmp_path, monkeypatch):
    data, probes = tiny(), []
    monkeypatch.setattr(
        trainer, "evaluate", lambda model, *given, **how: probes.append(model) or evaluate(model, *given, **how)
    )
    result = train(_config("ae", epochs=1, weights_dtype="bfloat16"), data, out=tmp_path, device="cpu")
    shipped = load_model(f"local-dir:{result.folder}").decoder.state_dict()
    assert all(torch.equal(value, shipped[name]) for name, value in probes[0].decoder.state_dict().items())


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "stored"), [("bf16", torch.bfloat16), ("float32", torch.float32)])
def test_weights_are_stored_as_they_were_trained(precision, stored, tmp_path):
    result = train(_config(epochs=1, precision=precision), tiny(), out=tmp_path, device="cpu")
    assert {value.dtype for name, value in _weights(tmp_path).items() if not name.startswith("normaliser")} == {stored}
    model = load_model(f"local-dir:{result.folder}")
    assert {value.dtype for value in model.parameters()} == {torch.float32}


@pytest.mark.parametrize(("seconds", "saves"), [(0.0, 2), (1e-9, 6)])
def test_no_seconds_between_saved_states_leave_those_of_epochs(seconds, saves, tmp_path, monkeypatch):
    steps, save = [], trainer._Run._save
    monkeypatch.setattr(trainer._Run, "_save", lambda run: steps.append(run.at.step) or save(run))
    train(_config(epochs=2, batch_size=3, checkpoint_seconds=seconds), tiny(train=9), out=tmp_path, device="cpu")
    assert len(steps) == saves


SCRIPT = """
import sys
import torch
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.trainer import train
from brainbench.scoring.model_responses import resolve_model
from tests.factories.training_sweeps import tiny

torch.set_num_threads(1)
config = TrainingConfig.published(
    "s4-small+gpt", "supervised", epochs=3, batch_size=8, optimizer="adamw", learning_rate=1e-3,
    checkpoint_seconds=1e-9, probe_epochs=2, augmentation="physical", precision="float32",
)
if __name__ == "__main__":
    train(config, tiny(), out=sys.argv[1], device="cpu")
"""


def _run_here(out, monkeypatch):
    """Run the script in this process, which has loaded what it imports."""
    threads = torch.get_num_threads()
    monkeypatch.setattr(sys, "argv", ["script.py", str(out)])
    try:
        exec(compile(SCRIPT, "script.py", "exec"), {"__name__": "__main__"})
    finally:
        torch.set_num_threads(threads)


def _start(script, out, *prefix):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, *prefix, str(script), str(out)], env=environment, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [1, 5])
def test_a_run_killed_at_any_moment_ends_with_the_weights_of_an_unbroken_one(kills, tmp_path, monkeypatch):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    _run_here(tmp_path / "whole", monkeypatch)
    state = tmp_path / "killed" / "state.safetensors"
    for _ in range(kills):
        before = state.stat().st_mtime_ns if state.exists() else 0
        process = _start(script, tmp_path / "killed")
        deadline = time.monotonic() + 60
        # At least one step further each time, then dead without a word.
        while time.monotonic() < deadline and process.poll() is None:
            if state.exists() and state.stat().st_mtime_ns != before:
                break
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        # Only the last of several may have come to its end.
        assert process.wait() == -signal.SIGKILL or kills > 1
    _run_here(tmp_path / "killed", monkeypatch)
    assert _equal(_weights(tmp_path / "whole"), _weights(tmp_path / "killed"))
    assert _equal(load_file(tmp_path / "whole" / "state.safetensors"), load_file(state))


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.replace("s4-small+gpt", "zhuang-ugrnn-small"))
    assert _start(script, tmp_path / "one").wait() == 0
    # The second time it has ended already.
    for _ in range(2):
        two = _start(script, tmp_path / "two", "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
        assert two.wait() == 0
    first, second = _weights(tmp_path / "one"), _weights(tmp_path / "two")
    for name, value in first.items():
        torch.testing.assert_close(second[name], value, atol=2e-5, rtol=1e-3, msg=name)


# PyTorch's compiler uses a part of PyTorch that PyTorch has deprecated.
@pytest.mark.filterwarnings("ignore:.*torch.jit.script_method.*:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor:UserWarning")
@pytest.mark.slow
@pytest.mark.parametrize("how", ["parts", "default", "graphs"])
def test_a_compiled_run_learns_too(how, tmp_path):
    result = train(_config(epochs=4, compile=how, model="zhuang-small"), tiny(), out=tmp_path, device="cpu")
    assert result.status == "finished"
    assert result.evaluation.top1 > 0.5


NORMALISED = ("zhuang-intersection-ln-small", "zhuang-gru-ln-small", "s4-small+gpt")


def _late_touch(silent=14, loud=8):
    """Sweeps of nothing at first, as before an object arrives."""
    x, labels = sweeps(4, 0, steps=silent + loud)
    x[:, :silent] = 0.0
    return x, labels


def _gradient_norm(model):
    x, labels = _late_touch()
    loss = make_learner("supervised", model.train())((x,), labels)
    loss.backward()
    return torch.stack([p.grad.norm() for p in model.parameters() if p.grad is not None]).norm()


@pytest.mark.parametrize("name", NORMALISED)
def test_silence_before_touch_explodes_the_gradient_of_layer_norm_unless_biases_are_drawn(name, monkeypatch):
    assert _gradient_norm(load_model(name, classes=3)) < 1e3
    monkeypatch.setattr("brainbench.models.ops.layers.draw_silent_biases", lambda part: None)
    assert not _gradient_norm(load_model(name, classes=3)) < 1e6


def test_a_run_of_a_layer_normalised_network_on_late_touch_trains(tmp_path):
    from tests.factories.training_sweeps import ArrayData

    data = ArrayData(("front", "middle", "back"), train=_late_touch())
    config = _config(model="zhuang-intersection-ln-small", epochs=1, batch_size=4)
    result = train(config, data, out=tmp_path, device="cpu")
    assert result.status == "finished", result.reason


class _Changed:
    """The sweeps of ``tiny``, each batch changed."""

    classes, summary = CLASSES, {}

    def __init__(self, change):
        self.change = change

    def batches(self, split, options):
        batches = tiny().batches(split, options)
        original = batches.__iter__
        changed = type("Changed", (type(batches),), {"__iter__": lambda _: (self.change(*pair) for pair in original())})
        batches.__class__ = changed
        return batches


@pytest.mark.parametrize("objective", ["supervised", "simclr"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x, y: (x, y + 1), "labels from 0 to 2, one for each class; received 3"),
        (lambda x, y: (x, y - 1), "labels from 0 to 2, one for each class; received -1"),
        (lambda x, y: (x, y.float()), r"whole numbers as labels; received torch.float32 and torch.float32"),
        (lambda x, y: (x.int(), y), r"real sweeps and whole numbers as labels; received torch.int32"),
        (lambda x, y: (x, y[:-1]), r"a label for each sweep; received shapes .* and \[7\]"),
        (lambda x, y: (x, y[:, None]), r"a label for each sweep; received shapes .* and \[8, 1\]"),
        (lambda x, y: (x[:0], y[:0]), r"a label for each sweep; received shapes \[0, "),
        (lambda x, y: (x.numpy(), y), "two tensors; received ndarray, Tensor"),
        (lambda x, y: x, "two tensors; received Tensor"),
        (lambda x, y: (x[:, 0], y), r"expects \[batch, time, 30, 5, 7\]"),
        (lambda x, y: (x * float("nan"), y), "not finite"),
    ],
)
def test_data_that_cannot_be_trained_on_end_in_a_sentence_and_leave_no_folder(tmp_path, objective, change, message):
    with pytest.raises((DataError, UsageError), match=message):
        train(_config(objective, augmentation="physical"), _Changed(change), out=tmp_path / "a" / "run", device="cpu")
    assert not list(tmp_path.iterdir())


def test_what_is_no_data_set_is_named(tmp_path):
    with pytest.raises(UsageError, match=r"classes, a summary and batches.*received \[1, 2\]"):
        train(_config(), [1, 2], out=tmp_path / "run", device="cpu")


def test_sweeps_in_double_precision_and_short_labels_train_as_others(tmp_path):
    changed = _Changed(lambda x, y: (x.double(), y.to(torch.int16)))
    train(_config(), changed, out=tmp_path / "changed", device="cpu")
    train(_config(), tiny(), out=tmp_path / "plain", device="cpu")
    assert _equal(_weights(tmp_path / "changed"), _weights(tmp_path / "plain"))
