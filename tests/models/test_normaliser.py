import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.normaliser import Normaliser


def test_the_physical_scale_makes_typical_forces_and_moments_one():
    x = torch.tensor(([1e-4] * 3 + [1e-6] * 3) * 5).view(1, 1, 30, 1, 1).expand(2, 3, 30, 5, 7)
    torch.testing.assert_close(Normaliser.physical()(x), torch.ones(2, 3, 30, 5, 7))


def test_offset_and_scale_belong_to_their_channel():
    y = Normaliser([2.0, 4.0], [1.0, -1.0])(torch.tensor([3.0, 3.0]).view(1, 2, 1, 1).expand(1, 2, 5, 7))
    assert y[0, :, 0, 0].tolist() == [1.0, 1.0]


def test_numbers_are_saved_but_not_trained():
    normaliser = Normaliser.physical()
    assert set(normaliser.state_dict()) == {"scale", "offset"}
    assert not list(normaliser.parameters())


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_a_scale_that_gives_no_numbers_is_refused(scale):
    with pytest.raises(UsageError, match="scale of a normaliser"):
        Normaliser([1.0, scale])
    with pytest.raises(UsageError, match="offset of a normaliser"):
        Normaliser([1.0], [float("inf")])
