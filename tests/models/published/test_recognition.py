import pytest
import torch

from brainbench.core.errors import DataError, UsageError
from brainbench.models.architecture import Architecture
from brainbench.models.published.files import Settings
from brainbench.models.published.importing import matched_entries
from brainbench.models.published.names import published_names
from brainbench.models.published.recognition import recognise
from brainbench.models.zoo import build

READ_OUTS = {"linear-last": "linear", "mlp3-last": "mlp", "mlp3-all": "all-steps"}
OTHERS = ("loss.", "attn.bias", "l_kernel")


def _entries(names):
    return {name: torch.empty(shape, device="meta") for name, shape, _ in names}


@pytest.mark.shared
def test_every_network_of_the_study_is_recognised_and_every_entry_accounted_for(published):
    assert len(published.networks) == 74
    for name, network in published.networks.items():
        own, _, last = name.partition("/")
        cell = "intersection" if "inter" in own else "lstm"
        state = _entries(network["state_dict"])
        found = recognise(state, Settings(cell))
        assert found.architecture == own.replace("inter", "intersection").replace("_ln", "-ln")
        assert found.decoder == READ_OUTS.get(last)
        assert found.objective == (last if last not in READ_OUTS else "supervised" if "mlp3" in last else None)
        with torch.device("meta"):
            model = build(Architecture.parse(found.architecture), decoder=found.decoder or "linear")
        used = matched_entries(state, model, found)
        assert all(any(mark in left for mark in OTHERS) for left in set(state) - set(used))
        buffers = {theirs for ours, theirs in published_names(model).items() if ours in dict(model.named_buffers())}
        count = sum(value.numel() for entry, value in used.items() if entry not in buffers)
        assert count == network["model_parameters"]
        # SimSiam stores its head twice, under loss. and loss.neck.; running averages are no parameters.
        averages = ("running_mean", "running_var", "num_batches_tracked")
        head = {left for left in state if left.startswith("loss.") and not left.endswith(averages)}
        head = {left for left in head if left.replace("loss.neck.", "loss.") not in head - {left}}
        assert sum(state[left].numel() for left in head) == network["loss_parameters"]


@pytest.mark.shared
def test_an_lstm_and_an_intersection_rnn_without_norm_need_a_word(published):
    state = _entries(published.networks["zhuang-lstm+gpt/linear-last"]["state_dict"])
    with pytest.raises(UsageError, match="--config"):
        recognise(state)
    assert recognise(state, architecture="zhuang-lstm+gpt.simclr").architecture == "zhuang-lstm+gpt"
    assert recognise(state, Settings("intersection")).architecture == "zhuang-intersection+gpt"


def test_other_networks_are_refused():
    with pytest.raises(DataError, match=r"layer1\.0\.conv1\.weight"):
        recognise({"layer1.0.conv1.weight": torch.zeros(1)})
    with pytest.raises(DataError, match=r"model\.attender\.s4_layers"):
        recognise({"model.encoder.s4_layers.0.D": torch.zeros(1), "model.attender.s4_layers.0.D": torch.zeros(1)})
