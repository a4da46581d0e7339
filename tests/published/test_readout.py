import pytest
import torch
from torch import nn

from brainbench.core.errors import UsageError
from brainbench.models.activations import extract
from brainbench.models.registry import load_model
from brainbench.published.readout import published_activations, published_layers
from tests.factories.training_sweeps import random_sweeps


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
