"""Contract over networks of others: a layer is what each stimulus gives alone in a fresh model, or is named."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional
from torch.nn.utils import parametrizations

from brainbench.models.activations import extract
from brainbench.models.proof import first_tensor

FEATURES, CHANNELS = 36, 6
NETWORKS: dict[str, type[Network]] = {}
"""Networks by name."""


class Network(nn.Module):
    """A small network of a structure that others build: it maps stimuli [B, T, 6, 2, 3] to something.

    A subclass is entered by its name. ``LOST`` names the layers that are no response to a stimulus, ``TIMED`` those
    with a time axis.
    """

    LOST: tuple[str, ...] = ()
    TIMED: tuple[str, ...] = ()

    def __init_subclass__(cls) -> None:
        NETWORKS[cls.__name__] = cls

    def parts(self, steps: int) -> dict[str, nn.Module]:
        """Return the parts, made for a number of time steps."""
        raise NotImplementedError

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps
        for name, part in self.parts(steps).items():
            setattr(self, name, part)


def make_network(name: str, steps: int) -> Network:
    """Return a network with weights from seed 0, ready to be scored."""
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of the old weight norm, which networks still use
        return NETWORKS[name](steps).eval()


def frames(x):
    """Return [B·T, 6, 2, 3]."""
    return x.flatten(0, 1)


def tokens(x):
    """Return a token [B, T, 36] of each step."""
    return x.flatten(2)


def channel_tokens(x):
    """Return a token [B, 6, T·6] of each channel."""
    return x.transpose(1, 2).flatten(2)


class Plain(Network):
    TIMED = ("a", "act", "b")

    def parts(self, steps):
        return {"a": nn.Linear(36, 8), "act": nn.GELU(), "b": nn.Linear(8, 4)}

    def forward(self, x):
        return self.b(self.act(self.a(tokens(x)))).mean(1)


class Flattened(Network):
    def parts(self, steps):
        return {"flat": nn.Flatten(), "a": nn.Linear(36 * steps, 6), "act": nn.Tanh()}

    def forward(self, x):
        return self.act(self.a(self.flat(x)))


class ImageNet(Network):
    """Frames in the batch, as image networks are used on films."""

    TIMED = ("stem", "norm", "pool", "head")

    def parts(self, steps):
        parts = {"stem": nn.Conv2d(6, 6, 3, padding=1), "norm": nn.BatchNorm2d(6)}
        return {**parts, "pool": nn.AdaptiveAvgPool2d(1), "head": nn.Linear(6, 5)}

    def forward(self, x):
        y = self.pool(self.norm(self.stem(frames(x))).relu()).flatten(1)
        return self.head(y).unflatten(0, x.shape[:2]).mean(1)


class Residual(Network):
    """One rectifier at two depths of a residual block."""

    TIMED = ("a", "b", "skip", "act[0]", "act[1]", "output")

    def parts(self, steps):
        return {
            "a": nn.Conv2d(6, 6, 3, padding=1), "b": nn.Conv2d(6, 6, 3, padding=1), "skip": nn.Conv2d(6, 6, 1),
            "act": nn.ReLU(inplace=True),
        }  # fmt: skip

    def forward(self, x):
        y = frames(x)
        return self.act(self.b(self.act(self.a(y))) + self.skip(y)).unflatten(0, x.shape[:2])


class SqueezeExcite(Network):
    TIMED = ("conv", "gate", "output")

    def parts(self, steps):
        return {"conv": nn.Conv2d(6, 6, 1), "gate": nn.Conv2d(6, 6, 1)}

    def forward(self, x):
        y = self.conv(frames(x))
        return (y * self.gate(y.mean((2, 3), keepdim=True)).sigmoid()).unflatten(0, x.shape[:2])


class Depthwise(Network):
    TIMED = ("expand", "depth", "project")

    def parts(self, steps):
        return {"expand": nn.Conv2d(6, 12, 1), "depth": nn.Conv2d(12, 12, 3, padding=1, groups=12),
                "project": nn.Conv2d(12, 4, 1)}  # fmt: skip

    def forward(self, x):
        return self.project(self.depth(self.expand(frames(x)))).unflatten(0, x.shape[:2]).mean((1, 3, 4))


class Dense(Network):
    TIMED = ("a", "b")

    def parts(self, steps):
        return {"a": nn.Linear(36, 6), "b": nn.Linear(42, 6)}

    def forward(self, x):
        y = tokens(x)
        return self.b(torch.cat([y, self.a(y)], -1)).flatten(1)


class Shuffle(Network):
    TIMED = ("a", "shuffle", "output")

    def parts(self, steps):
        return {"a": nn.Conv2d(6, 6, 1, groups=2), "shuffle": nn.ChannelShuffle(2)}

    def forward(self, x):
        return self.shuffle(self.a(frames(x))).unflatten(0, x.shape[:2])


class ChannelsLast(Network):
    """Norms over the last axis between convolutions."""

    TIMED = ("depth", "norm", "wide", "output")

    def parts(self, steps):
        return {"depth": nn.Conv2d(6, 6, 3, padding=1, groups=6), "norm": nn.LayerNorm(6), "wide": nn.Linear(6, 6)}

    def forward(self, x):
        return self.wide(self.norm(self.depth(frames(x)).permute(0, 2, 3, 1))).unflatten(0, x.shape[:2])


class Film(Network):
    """Convolution over space and time."""

    TIMED = ("a", "norm", "b")

    def parts(self, steps):
        return {"a": nn.Conv3d(6, 6, 3, padding=1), "norm": nn.BatchNorm3d(6), "b": nn.Conv3d(6, 4, 1)}

    def forward(self, x):
        return self.b(self.norm(self.a(x.transpose(1, 2)))).mean((2, 3, 4))


class Factored(Network):
    """Space in one convolution, time in another."""

    TIMED = ("space", "time")

    def parts(self, steps):
        return {
            "space": nn.Conv3d(6, 4, (1, 3, 3), padding=(0, 1, 1)),
            "time": nn.Conv3d(4, 4, (3, 1, 1), padding=(1, 0, 0)),
        }

    def forward(self, x):
        return self.time(self.space(x.transpose(1, 2))).mean((2, 3, 4))


class TemporalShift(Network):
    """Moves features of frames in the batch by a step."""

    TIMED = ("a", "b", "output")

    def parts(self, steps):
        return {"a": nn.Conv2d(6, 6, 1), "b": nn.Conv2d(6, 6, 1)}

    def forward(self, x):
        y = self.a(frames(x)).unflatten(0, x.shape[:2])
        y = torch.cat([functional.pad(y[:, :-1, :3], (0, 0, 0, 0, 0, 0, 1, 0)), y[:, :, 3:]], 2)
        return self.b(y.flatten(0, 1)).unflatten(0, x.shape[:2])


class Causal(Network):
    """Dilated convolutions that are cut at the end, with old weight norm."""

    TIMED = ("output",)  # before the cut they have more steps than the stimuli

    def parts(self, steps):
        old = torch.nn.utils.weight_norm
        return {"a": old(nn.Conv1d(36, 6, 2, padding=1)), "b": old(nn.Conv1d(6, 6, 2, padding=2, dilation=2))}

    def forward(self, x):
        y = self.a(tokens(x).transpose(1, 2))[..., :-1]
        return self.b(y.relu())[..., :-2].transpose(1, 2)


class WeightNormed(Network):
    TIMED = ("conv",)

    def parts(self, steps):
        return {"conv": parametrizations.weight_norm(nn.Conv1d(36, 6, 3, padding=1))}

    def forward(self, x):
        return self.conv(tokens(x).transpose(1, 2)).mean(-1)


class SpectralNormed(Network):
    TIMED = ("a", "output")

    def parts(self, steps):
        return {"a": parametrizations.spectral_norm(nn.Linear(36, 6))}

    def forward(self, x):
        return self.a(tokens(x))


class TimeFirst(Network):
    TIMED = ("lstm", "head")

    def parts(self, steps):
        return {"lstm": nn.LSTM(36, 6), "head": nn.Linear(6, 6)}

    def forward(self, x):
        return self.head(self.lstm(tokens(x).transpose(0, 1))[0])[-1]


class BothWays(Network):
    TIMED = ("gru", "output")

    def parts(self, steps):
        return {"gru": nn.GRU(36, 5, batch_first=True, bidirectional=True)}

    def forward(self, x):
        return self.gru(tokens(x))


class Cells(Network):
    """A loop over time through two cells."""

    TIMED = ("one", "two")

    def parts(self, steps):
        return {"one": nn.GRUCell(36, 6), "two": nn.LSTMCell(6, 5), "head": nn.Linear(5, 3)}

    def forward(self, x):
        a, b = x.new_zeros(len(x), 6), (x.new_zeros(len(x), 5), x.new_zeros(len(x), 5))
        for step in tokens(x).unbind(1):
            a = self.one(step, a)
            b = self.two(a, b)
        return self.head(b[0])


class SharedInLoop(Network):
    """One rectifier twice in each step."""

    TIMED = ("a", "b", "act[0]", "act[1]")

    def parts(self, steps):
        return {"a": nn.Linear(36, 6), "b": nn.Linear(6, 6), "act": nn.LeakyReLU()}

    def forward(self, x):
        state = 0
        for step in tokens(x).unbind(1):
            state = 0.5 * state + self.act(self.b(self.act(self.a(step))))
        return state


class StateFirst(Network):
    """A read-out of the state before each step, the first of which no stimulus moves."""

    TIMED = ("cell", "read", "output")

    def parts(self, steps):
        return {"cell": nn.RNNCell(36, 6), "read": nn.Linear(6, 3)}

    def forward(self, x):
        state, reads = x.new_zeros(len(x), 6), []
        for step in tokens(x).unbind(1):
            reads.append(self.read(state))
            state = self.cell(step, state)
        return torch.stack(reads, 1)


class Depths(Network):
    """One block at as many depths as the stimuli have steps."""

    def parts(self, steps):
        return {"read": nn.Linear(36, 6), "block": nn.Linear(6, 6)}

    def forward(self, x):
        y = self.read(tokens(x).mean(1))
        for _ in range(self.steps):
            y = self.block(y).tanh() + y
        return y


class Reservoir(Network):
    """Keeps its state in the module, and begins anew in forward."""

    TIMED = ("read", "output")

    def parts(self, steps):
        return {"read": nn.Linear(36, 8)}

    def forward(self, x):
        self.state, states = x.new_zeros(len(x), 8), []
        for step in self.read(tokens(x)).unbind(1):
            self.state = (0.9 * self.state + step).tanh()
            states.append(self.state)
        return torch.stack(states, 1)


class Spiking(Network):
    TIMED = ("fire", "read")

    def parts(self, steps):
        return {"read": nn.Linear(36, 12), "fire": nn.Threshold(0.1, 0.0)}

    def forward(self, x):
        voltage, spikes = 0, 0
        for step in self.read(tokens(x)).unbind(1):
            fired = self.fire(voltage := 0.9 * voltage + step)
            voltage, spikes = voltage - fired, spikes + fired
        return spikes


class ConvolutionalLoop(Network):
    TIMED = ("gates",)

    def parts(self, steps):
        return {"gates": nn.Conv2d(10, 8, 3, padding=1)}

    def forward(self, x):
        state = x.new_zeros(len(x), 4, 2, 3)
        for step in x.unbind(1):
            gate, value = self.gates(torch.cat([step, state], 1)).chunk(2, 1)
            state = state + gate.sigmoid() * (value.tanh() - state)
        return state.flatten(1)


class Runge(Network):
    """Four calls in each step of an integrator."""

    TIMED = ("flow[0]", "flow[1]", "flow[2]", "flow[3]")

    def parts(self, steps):
        return {"flow": nn.Linear(42, 6)}

    def forward(self, x):
        y = x.new_zeros(len(x), 6)
        for step in tokens(x).unbind(1):
            slope = 0
            for part in (0.0, 0.5, 0.5, 1.0):
                slope = self.flow(torch.cat([step, y + 0.1 * part * slope], 1)).tanh()
            y = y + 0.1 * slope
        return y


class StateSpace(Network):
    """A long convolution by Fourier transform."""

    TIMED = ("lift", "out")

    def parts(self, steps):
        return {"lift": nn.Linear(36, 6), "out": nn.Linear(6, 6)}

    def forward(self, x):
        y, count = self.lift(tokens(x)), x.shape[1]
        kernel = 0.7 ** torch.arange(count, device=x.device)[:, None]
        spectrum = torch.fft.rfft(y, 2 * count, dim=1) * torch.fft.rfft(kernel, 2 * count, dim=0)
        return self.out(torch.fft.irfft(spectrum, 2 * count, dim=1)[:, :count])[:, -1]


class Attention(Network):
    """Learned code of the step, attention, norms: an encoder of all steps.

    Its answers before the sum are nearly alike at all steps, and follow the code of the step more than the stimulus.
    """

    TIMED = ("embed", "norm", "output")
    LOST = ("place",)

    def parts(self, steps):
        return {
            "embed": nn.Linear(36, 8), "place": nn.Embedding(steps, 8),
            "attend": nn.MultiheadAttention(8, 2, batch_first=True), "norm": nn.LayerNorm(8),
        }  # fmt: skip

    def forward(self, x):
        y = self.embed(tokens(x)) + self.place(torch.arange(x.shape[1]))
        return self.norm(y + self.attend(y, y, y)[0])


class Encoder(Network):
    """The encoder of PyTorch, time first."""

    TIMED = ("embed", "blocks.layers.0.norm1", "blocks.layers.0.norm2", "blocks.layers.0.self_attn",
             "blocks.layers.0.linear1", "blocks.layers.0.linear2", "blocks.layers.0.dropout",
             "blocks.layers.0.dropout1", "blocks.layers.0.dropout2")  # fmt: skip

    def parts(self, steps):
        block = nn.TransformerEncoderLayer(8, 2, 12)
        return {"embed": nn.Linear(36, 8), "blocks": nn.TransformerEncoder(block, 1, enable_nested_tensor=False)}

    def forward(self, x):
        return self.blocks(self.embed(tokens(x).transpose(0, 1))).mean(0)


class CausalAttention(Network):
    TIMED = ("embed", "attend", "output")
    LOST = ("wpe",)

    def parts(self, steps):
        return {
            "embed": nn.Linear(36, 8),
            "wpe": nn.Embedding(64, 8),
            "attend": nn.MultiheadAttention(8, 2, batch_first=True),
        }

    def forward(self, x):
        count = x.shape[1]
        y = self.embed(tokens(x)) + self.wpe(torch.arange(count)[None])
        mask = torch.ones(count, count).triu(1).bool()
        return {"last_hidden_state": self.attend(y, y, y, attn_mask=mask)[0], "past": None}


class Patches(Network):
    """Image tokens of each frame with a class token: [B·T, 1 + N, F]."""

    TIMED = ("patch", "norm", "head")

    def parts(self, steps):
        self.token = nn.Parameter(torch.randn(1, 1, 8))
        return {"patch": nn.Conv2d(6, 8, (2, 1), (2, 1)), "norm": nn.LayerNorm(8), "head": nn.Linear(8, 4)}

    def forward(self, x):
        y = self.patch(frames(x)).flatten(2).transpose(1, 2)
        y = self.norm(torch.cat([self.token.expand(len(y), -1, -1), y], 1))
        return self.head(y.mean(1)).unflatten(0, x.shape[:2]).flatten(1)


class DividedAttention(Network):
    """Attention over steps at each place [B·N, T, F], then over places at each step [B·T, N, F]."""

    TIMED = ("embed", "time", "space", "output")

    def parts(self, steps):
        attend = lambda: nn.MultiheadAttention(6, 2, batch_first=True)  # noqa: E731
        return {"embed": nn.Linear(6, 6), "time": attend(), "space": attend()}

    def forward(self, x):
        y = self.embed(x.flatten(3).permute(0, 3, 1, 2))
        shape = y.shape
        y = y.flatten(0, 1)
        y = (y + self.time(y, y, y)[0]).unflatten(0, shape[:2]).transpose(1, 2).flatten(0, 1)
        return (y + self.space(y, y, y)[0]).unflatten(0, (shape[0], shape[2]))


class Windows(Network):
    """Attention in windows of the grid: [B·windows, tokens, F]."""

    TIMED = ("norm", "attend")

    def parts(self, steps):
        return {"norm": nn.LayerNorm(6), "attend": nn.MultiheadAttention(6, 2, batch_first=True)}

    def forward(self, x):
        y = frames(x).roll(1, -1).permute(0, 3, 2, 1).flatten(0, 1)
        y = self.norm(y)
        return self.attend(y, y, y)[0].unflatten(0, (len(x), -1)).mean((1, 2))


class Mixer(Network):
    """Mixes the steps by weights, which leaves no time axis."""

    TIMED = ("embed",)

    def parts(self, steps):
        return {"embed": nn.Linear(36, 6), "mix": nn.Linear(steps, steps), "wide": nn.Linear(6, 6)}

    def forward(self, x):
        return self.wide(self.mix(self.embed(tokens(x)).transpose(1, 2)).relu().transpose(1, 2)).mean(1)


class Pooled(Network):
    TIMED = ("pool", "norm", "output")

    def parts(self, steps):
        return {"pool": nn.AvgPool2d(3, 1, 1), "norm": nn.GroupNorm(1, 6)}

    def forward(self, x):
        y = frames(x)
        return self.norm(y + self.pool(y) - y.mean() * 0).unflatten(0, x.shape[:2])


class ChannelTokens(Network):
    """A token for each channel, as many as steps and stimuli."""

    def parts(self, steps):
        return {"embed": nn.Linear(6 * steps, 6), "attend": nn.MultiheadAttention(6, 2, batch_first=True)}

    def forward(self, x):
        y = self.embed(channel_tokens(x))
        return self.attend(y, y, y)[0].mean(1)


class ChannelSequences(Network):
    """Every channel a sequence of its own: [B·C, patches, F]."""

    def parts(self, steps):
        return {"patch": nn.Linear(steps, 6), "norm": nn.LayerNorm(6), "mix": nn.Linear(6, 6)}

    def forward(self, x):
        y = x.flatten(3).permute(0, 2, 3, 1).flatten(0, 1)
        return self.mix(self.norm(self.patch(y))).unflatten(0, (len(x), -1)).mean((1, 2))


class TokensFirst(Network):
    def parts(self, steps):
        return {"read": nn.Linear(36 * steps, 36), "norm": nn.LayerNorm(6)}

    def forward(self, x):
        return self.norm(self.read(x.flatten(1)).unflatten(1, (6, 6)).transpose(0, 1)).mean(0)


class Latents(Network):
    """Learned queries, the same for every stimulus, attend to the steps."""

    TIMED = ("embed",)
    LOST = ("queries",)

    def parts(self, steps):
        return {"embed": nn.Linear(36, 6), "queries": nn.Embedding(6, 6), "attend": nn.MultiheadAttention(6, 2)}

    def forward(self, x):
        keys = self.embed(tokens(x).transpose(0, 1))
        queries = self.queries(torch.arange(6))[:, None].expand(-1, len(x), -1)
        return self.attend(queries, keys, keys)[0].mean(0)


class Codebook(Network):
    """Codes of the nearest entry of a table."""

    TIMED = ("embed", "codes", "output")

    def parts(self, steps):
        return {"embed": nn.Linear(36, 3), "codes": nn.Embedding(16, 3)}

    def forward(self, x):
        y = self.embed(tokens(x))
        return self.codes(torch.cdist(y, self.codes.weight.expand(len(x), -1, -1)).argmin(-1)) + 0 * y


class Experts(Network):
    """Each expert gets the tokens that are sent to it, more or fewer in each batch."""

    TIMED = ("gate", "output")
    LOST = ("one", "two")

    def parts(self, steps):
        return {"gate": nn.Linear(36, 2), "one": nn.Linear(36, 4), "two": nn.Linear(36, 4)}

    def forward(self, x):
        y = tokens(x)
        choice = self.gate(y).argmax(-1)
        result = y.new_zeros(*y.shape[:2], 4)
        for index, expert in enumerate((self.one, self.two)):
            result[choice == index] = expert(y[choice == index])
        return result


class Sometimes(Network):
    """A monitor that runs for strong stimuli only."""

    TIMED = ("read",)
    LOST = ("monitor",)

    def parts(self, steps):
        return {"read": nn.Linear(36, 6), "monitor": nn.Linear(6, 2)}

    def forward(self, x):
        y = self.read(tokens(x))
        if x.abs().max() > 20:
            self.monitor(y)
        return y.mean(1)


class PlaceInBatch(Network):
    """Has a branch that depends on the place in the batch, beside the answer."""

    TIMED = ("read",)
    LOST = ("place", "sum")

    def parts(self, steps):
        return {"read": nn.Linear(36, 6), "place": nn.Embedding(64, 6), "sum": nn.Identity()}

    def forward(self, x):
        y = self.read(tokens(x))
        self.sum(y + self.place(torch.arange(len(x)))[:, None])
        return y.mean(1)


class Contrast(Network):
    """Compares the stimuli of a batch: [B, B]."""

    LOST = ("compare",)
    TIMED = ("read",)

    def parts(self, steps):
        return {"read": nn.Linear(36, 6), "compare": nn.Identity()}

    def forward(self, x):
        y = self.read(tokens(x)).mean(1)
        self.compare(y @ y.T)
        return y


class Autoencoder(Network):
    def parts(self, steps):
        return {"mean": nn.Linear(36 * steps, 4), "spread": nn.Linear(36 * steps, 4), "decode": nn.Linear(4, 36)}

    def forward(self, x):
        mean, spread = self.mean(x.flatten(1)), self.spread(x.flatten(1))
        return self.decode(mean), mean, spread


@dataclass
class Answer:
    logits: torch.Tensor
    states: tuple[torch.Tensor, ...]


class DataclassOutput(Network):
    TIMED = ("read",)

    def parts(self, steps):
        return {"read": nn.Linear(36, 6)}

    def forward(self, x):
        y = self.read(tokens(x))
        return Answer(y.mean(1), (y,))


class Packed(Network):
    """A packed sequence: rows of all steps, time first."""

    TIMED = ("rnn",)

    def parts(self, steps):
        return {"rnn": nn.RNN(36, 5, batch_first=True)}

    def forward(self, x):
        packed = nn.utils.rnn.pack_padded_sequence(tokens(x), [x.shape[1]] * len(x), batch_first=True)
        return self.rnn(packed)[1][0]


class Hyper(Network):
    """A part that makes the weights of another."""

    TIMED = ("read",)
    LOST = ("weights",)

    def parts(self, steps):
        return {"weights": nn.Linear(4, 36 * 6), "read": nn.Linear(36, 36)}

    def forward(self, x):
        weights = self.weights(torch.linspace(0, 1, 4)).unflatten(0, (36, 6))
        return (self.read(tokens(x)) @ weights).mean(1)


class Instance(Network):
    TIMED = ("conv", "norm")

    def parts(self, steps):
        return {"conv": nn.Conv1d(36, 6, 3, padding=1), "norm": nn.InstanceNorm1d(6)}

    def forward(self, x):
        return self.norm(self.conv(tokens(x).transpose(1, 2)) ** 2).amax(-1)


class Fourier(Network):
    TIMED = ("read",)

    def parts(self, steps):
        return {"read": nn.Linear(36, 6), "spectrum": nn.Identity()}

    def forward(self, x):
        return self.spectrum(torch.fft.rfft(self.read(tokens(x)), dim=1)).abs().flatten(1)


class Strided(Network):
    """Steps in pairs, which are half as many."""

    def parts(self, steps):
        return {"pair": nn.Conv1d(36, 6, 2, 2), "gru": nn.GRU(6, 5)}

    def forward(self, x):
        return self.gru(self.pair(tokens(x).transpose(1, 2)).permute(2, 0, 1))[0][-1]


class Graph(Network):
    """Messages between taxels, all of a batch in one list: [B·T·N, F]."""

    TIMED = ("message", "update")

    def parts(self, steps):
        return {"message": nn.Linear(6, 6), "update": nn.Linear(12, 4)}

    def forward(self, x):
        y = x.flatten(3).transpose(2, 3)
        sent = self.message(y.flatten(0, 2)).unflatten(0, y.shape[:3])
        near = (sent.roll(1, 2) + sent.roll(-1, 2)).flatten(0, 2)
        return self.update(torch.cat([y.flatten(0, 2), near], 1)).unflatten(0, y.shape[:3]).mean((1, 2))


class TimeFirstRows(Network):
    """Rows of all stimuli of all steps, and the output likewise."""

    TIMED = ("a", "b", "output")

    def parts(self, steps):
        return {"a": nn.Linear(36, 6), "b": nn.Linear(6, 6)}

    def forward(self, x):
        return self.b(self.a(tokens(x).transpose(0, 1).flatten(0, 1)).relu())


class OwnWeights(Network):
    """A part with parts and weights of its own."""

    TIMED = ("cell", "cell.norm", "output")

    def parts(self, steps):
        return {"cell": Scaled()}

    def forward(self, x):
        return self.cell(tokens(x))


class Scaled(nn.Module):
    def __init__(self):
        super().__init__()
        self.scale, self.norm = nn.Parameter(torch.rand(36)), nn.LayerNorm(36)

    def forward(self, x):
        return self.norm(x) * self.scale


class InPlace(Network):
    TIMED = ("act", "read")

    def parts(self, steps):
        return {"act": nn.ReLU(inplace=True), "read": nn.Linear(36, 4)}

    def forward(self, x):
        x -= x.mean((1, 2, 3, 4), keepdim=True)
        return self.read(tokens(self.act(x))).mean(1)


class HalfPrecision(Network):
    TIMED = ("read",)

    def parts(self, steps):
        return {"read": nn.Linear(36, 6).bfloat16()}

    def forward(self, x):
        return self.read(tokens(x).bfloat16()).float().mean(1)


class Tied(Network):
    """Two names of one module."""

    TIMED = ("a[0]", "a[1]", "output")

    def parts(self, steps):
        layer = nn.Linear(36, 36)
        return {"a": layer, "b": layer}

    def forward(self, x):
        return self.b(self.a(tokens(x)).tanh())


class Masked(Network):
    """Gives its mask first, which is the same for all stimuli."""

    LOST = ("mask",)
    TIMED = ("read", "output")

    def parts(self, steps):
        return {"mask": nn.Identity(), "read": nn.Linear(36, 6)}

    def forward(self, x):
        mask = self.mask(torch.ones(len(x), x.shape[1], 1))
        return self.read(tokens(x)) * mask


def alone(name, stimuli, steps):
    """Return for each stimulus {module: [what each call gave]} in a model that ran nothing else."""
    results = []
    for row in stimuli:
        model, calls = make_network(name, steps), {}

        def record(label, output, calls=calls):
            calls.setdefault(label, []).append(first_tensor(output).detach().float().clone().numpy().ravel())

        for label, module in model.named_modules():
            if label and "parametrizations" not in label:
                module.register_forward_hook(lambda _m, _i, output, label=label, record=record: record(label, output))
        with torch.no_grad():
            record("output", model(torch.tensor(row[None])))
        results.append(calls)
    return results


def values_of(calls, layer, rows):
    """Return the numbers of a layer in the calls of one stimulus, sorted; its steps may be calls."""
    base, _, index = layer.partition("[")
    parts = calls[base]
    if index:
        # Calls of a loop lie around its steps; these networks call in each step.
        count = len(parts) // len(rows) if len(rows) > 1 and len(parts[0]) * len(rows) == rows.size else len(parts)
        parts = parts[int(index[:-1]) :: count]
    return np.sort(np.concatenate(parts))


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(("count", "steps", "chunk"), [(12, 6, 6), (9, 8, 4)], ids=["all equal", "unequal"])
def test_a_layer_is_what_a_stimulus_gives_alone_or_is_named(name, count, steps, chunk):
    stimuli = np.random.default_rng(1).normal(size=(count, steps, 6, 2, 3)).astype(np.float32)
    stimuli[0, 0, 0] = 30.0
    network, truth, before = make_network(name, steps), alone(name, stimuli, steps), stimuli.copy()
    layers = extract(network, stimuli, chunk=chunk)
    np.testing.assert_array_equal(stimuli, before)
    assert set(layers.report.not_read) == set(network.LOST)
    called = {label for calls in truth for label in calls}
    parts = {label for label in called if label == "output" or is_layer(network.get_submodule(label))}
    read = {layer.partition("[")[0] for layer in layers}
    assert parts == read | {layer.partition("[")[0] for layer in layers.report.not_read}
    assert layers.report.called == len(parts)
    for layer, values in layers.items():
        for rows, calls in zip(values, truth, strict=True):
            np.testing.assert_allclose(np.sort(rows.ravel()), values_of(calls, layer, rows), atol=2e-4, rtol=2e-4)
    assert {layer for layer, values in layers.items() if values.shape[1] == steps} == set(network.TIMED)


def is_layer(module):
    return (
        not list(module.children())
        or bool(list(module.parameters(recurse=False)))
        or hasattr(module, "parametrizations")
    )


def test_there_are_enough_of_them():
    assert len(NETWORKS) >= 50
    assert all(isinstance(make_network(name, 4), nn.Module) for name in NETWORKS)
