import pytest
import torch

from brainbench.models.decoders import linear_decoder, mlp_decoder


@pytest.mark.parametrize(("make", "parameters"), [(linear_decoder, 60_021), (mlp_decoder, 1_110_133)])
def test_parameters_equal_the_published_counts(make, parameters):
    decoder = make(512)
    assert sum(parameter.numel() for parameter in decoder.parameters()) == parameters
    assert decoder(torch.randn(3, 7, 512)).shape == (3, 7, 117)


def test_the_number_of_classes_can_be_chosen():
    assert linear_decoder(8, 3)(torch.randn(2, 8)).shape == mlp_decoder(8, 3)(torch.randn(2, 8)).shape == (2, 3)
