import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.models.ops.packing import packed
from brainbench.models.registry import load_model


def _stream(model, sweep):
    state, outputs = model.init_state(1), []
    with torch.no_grad():
        for x in sweep:
            y, state = model.step(x[None], state)
            outputs.append(y)
    return torch.cat(outputs)


@pytest.mark.parametrize("name", ["zhuang-intersection-ln-small", "resnet18-small", "s4-small+gpt"])
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", 1e-5), ("bf16", 0.05)])
@pytest.mark.parametrize("ordered", [None, False], ids=["as-this-processor-can", "plain-order"])
def test_a_packed_network_streams_as_the_plain_one(name, precision, tolerance, ordered, monkeypatch):
    if ordered is not None:
        monkeypatch.setattr("brainbench.models.ops.layers._onednn_orders", lambda dtype: ordered)
    model = load_model(name, classes=5)
    sweep = torch.randn(8, 30, 5, 7, generator=torch.Generator().manual_seed(1)) * model.normaliser.scale
    plain, fast = _stream(model, sweep), _stream(packed(model, precision=precision), sweep)
    assert (fast - plain).abs().max() <= tolerance * plain.abs().max()
    assert precision == "float32" or not torch.equal(fast, plain)


def test_packing_leaves_the_network_and_larger_batches_as_they_were():
    model = load_model("zhuang-ugrnn-small", classes=5)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fast = packed(model, precision="bf16")
    x = torch.randn(3, 4, 30, 5, 7) * model.normaliser.scale
    with torch.no_grad():
        assert torch.equal(fast(x), model(x))
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert fast.state_dict().keys() == before.keys()


def test_an_unknown_precision_is_named():
    with pytest.raises(UsageError, match=r"int4.*bf16"):
        packed(load_model("s4-small"), precision="int4")
