import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.heads.self_supervised import AutoencoderHead, SimCLRHead, SimSiamHead


@pytest.mark.parametrize(
    ("head", "parameters"), [(SimCLRHead, 1_315_072), (SimSiamHead, 11_556_352), (AutoencoderHead, 289_665)]
)
def test_parameters_equal_the_published_counts(head, parameters):
    with torch.device("meta"):
        assert sum(parameter.numel() for parameter in head(512).parameters()) == parameters


def test_shapes():
    features = torch.randn(4, 96)
    assert SimCLRHead(96)(features).shape == (4, 128)
    assert [tuple(item.shape) for item in SimSiamHead(96)(features)] == [(4, 2048), (4, 2048)]
    assert AutoencoderHead(96)(features.view(2, 2, 96)).shape == (2, 2, 30, 5, 7)
    with pytest.raises(UsageError, match=r"channels .*received 1"):
        AutoencoderHead(96, channels=1)


def test_steps_are_reconstructed_each_from_its_own_features():
    head, features = AutoencoderHead(8), torch.randn(2, 3, 8)
    with torch.no_grad():
        every = head(features)
        torch.testing.assert_close(every[:, 1], head(features[:, 1:2])[:, 0])
