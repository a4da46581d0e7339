import torch
from torch import nn

from brainbench.models.training.probe import fit_probe


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
