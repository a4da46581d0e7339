"""The networks of the study, filled by the reference's rule, against what the authors' own code gave for them."""

import numpy as np
import pytest
import torch

from brainbench.models.activations import extract
from brainbench.models.encoders import S4Encoder
from brainbench.models.ops.state_space import StateSpace
from brainbench.models.published.files import Settings
from brainbench.models.published.importing import build_published
from brainbench.models.published.names import stored_readout
from brainbench.models.published.recognition import recognise
from brainbench.models.registry import load_model

QUICK = ("s4+gpt/linear-last", "resnet18/mlp3-all", "zhuang+mamba/linear-last")
_CELLS = ("", "-gru_ln", "-ugrnn", "-inter_ln", "-gru", "-lstm", "-ugrnn_ln", "-inter", "-lstm_ln")
REST = (
    *(f"zhuang{cell}/mlp3-last" for cell in _CELLS),
    *(f"{name}/linear-last" for name in ("zhuang", "zhuang+gpt", "zhuang-inter_ln+gpt", "s4+mamba")),
    *(f"resnet18+{attender}/linear-last" for attender in ("gpt", "mamba")),
)
ALL = [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in REST)]
CLOSE = 1e-5
"""Share of the largest value that single precision leaves open in the authors' own outputs."""
AMPLIFIED = 4e-5
"""The same after Mamba, which amplifies the last bits; in double precision we differ from theirs as much."""


def _network(published, name):
    settings = Settings(cell="intersection" if "inter" in name else "lstm")
    state = published.state(name)
    model, _ = build_published(state, recognise(state, settings))
    if isinstance(model.encoder, S4Encoder):
        _round_kernels_as_they_do(model.encoder, state)
    return model.eval()


def _round_kernels_as_they_do(encoder, state):
    """Kernels of length 22 from the stored C in single precision (Gu et al. 2022, algorithm 1), as the authors' code.

    Single precision costs it 2e-5 to 4e-5 of the largest value, which ours, in double, does not lose; what follows
    would be compared to that error.
    """
    for index, block in enumerate(encoder.blocks):
        begin = f"model.encoder.s4_layers.{index}.layer.kernel."
        entry = {name.removeprefix(begin): value for name, value in state.items() if name.startswith(begin)}
        p, b, c = (torch.view_as_complex(entry[name][0]) for name in "PBC")
        step = torch.exp(entry["inv_dt"])
        poles = torch.complex(-torch.exp(entry["A_real"]), -entry["A_imag"]) * step
        omega = torch.tensor(np.exp(-2j * np.pi / 22), dtype=torch.complex64) ** torch.arange(12)
        z = 2 * (1 - omega) / (1 + omega)

        def cauchy(v, z=z, poles=poles, step=step):
            every, at = torch.cat((v, v.conj()), 1), torch.cat((poles, poles.conj()), 1)
            return (every[..., None] / (z - at[..., None])).sum(1) * step

        spectrum = cauchy(b * c) - cauchy(p * c) * cauchy(b * p.conj()) / (1 + cauchy(p * p.conj()))
        kernel = torch.fft.irfft(spectrum * 2 / (1 + omega), n=22).double()
        _agrees(kernel, block.memory.kernel(22).numpy(), 5e-5)
        block.memory.kernel = lambda length, kernel=kernel: kernel


def _agrees(ours, theirs, share, largest=None):
    error = np.abs(np.asarray(ours) - theirs).max() / (largest or np.abs(theirs).max())
    assert error <= share, f"{error:.1e} of the largest value"


@pytest.mark.shared
@pytest.mark.parametrize("name", ALL)
@torch.no_grad()
def test_a_network_gives_the_authors_outputs(published, name):
    model, theirs = _network(published, name), published.outputs[name]
    share = AMPLIFIED if "mamba" in name else CLOSE
    _agrees(model(published.stimulus(2)), theirs["logits"], share)
    x = model.normaliser(published.stimulus(2))
    _agrees(model.encoder(x)[..., :16], theirs["encoder_out"], CLOSE)
    if "encoder_out_full_unroll" in theirs:
        _agrees(model.encoder(x, unroll="full")[..., :16], theirs["encoder_out_full_unroll"], CLOSE)
    six = published.stimulus(6)
    _agrees(model(six), theirs["logits6"], share)
    read = extract(model, six, readout="published")
    assert {f"scored/{layer}" for layer in read} == {what for what in theirs if what.startswith("scored/")}
    nodes = dict(model.encoder.activations(model.normaliser(six))) if name.startswith("zhuang") else {}
    for layer, values in read.items():
        within = share if layer.startswith(("att_mamba", "dec")) else CLOSE
        scored = values.mean(1)
        count, mean, spread = theirs[f"scored_stats/{layer}"]
        assert scored.shape == (6, count)
        _agrees(scored[:, :8], theirs[f"scored/{layer}"], within, np.abs(scored).max())
        assert scored.std() == pytest.approx(spread, rel=1e-4)
        assert scored.mean() == pytest.approx(mean, abs=within * float(np.abs(scored).max()))
        whole = nodes[layer].flatten(2).mean((0, 2)) if layer in nodes else values.mean()
        assert np.abs(np.asarray(whole) - theirs[f"mean/{layer}"]).max() <= within * np.abs(values).max()


@pytest.mark.shared
@pytest.mark.parametrize(("name", "share"), [("resnet18/mlp3-all", 1e-5), ("resnet18+mamba/linear-last", 3e-4)])
@torch.no_grad()
def test_batch_statistics_give_what_the_authors_activation_script_saw(published, name, share):
    # The last bit of the stimulus moves Mamba's answer by 1e-4 here.
    model = _network(published, name).train()
    _agrees(model(published.stimulus(6)), published.outputs[name]["logits6_train_mode"], share)


@torch.no_grad()
def test_the_stored_readout_is_undone():
    memory = StateSpace(6, pairs=4)
    stored = stored_readout(memory.transition(), memory.readout, 22, undo=False)
    assert not torch.allclose(stored.float(), memory.readout, atol=1e-2)
    again = stored_readout(memory.transition(), stored, 22, undo=True)
    torch.testing.assert_close(again.float(), memory.readout)


@torch.no_grad()
def test_the_transition_is_the_recurrences():
    memory = StateSpace(5, pairs=3).double()
    x, system = torch.randn(1, 5, 3, 2, dtype=torch.float64), memory.system()
    _, after = memory.step(torch.zeros(1, 5, dtype=torch.float64), x, system)
    state = torch.view_as_complex(x)[0]
    expected = (memory.transition() @ torch.cat((state, state.conj()), 1)[..., None])[:, :3, 0]
    torch.testing.assert_close(torch.view_as_complex(after)[0], expected)


@pytest.mark.parametrize("name", ["s4", "resnet18-small+mamba", "zhuang-lstm-ln-small+gpt"])
def test_every_entry_of_ours_has_a_name_of_its_own(name):
    from brainbench.models.published.names import published_names

    for decoder in ("linear", "mlp", "all-steps"):
        model = load_model(name, decoder=decoder)
        names = published_names(model)
        assert set(names) == {key for key in model.state_dict() if not key.startswith("normaliser.")}
        assert len(set(names.values())) == len(names)
