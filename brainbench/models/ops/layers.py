"""Convolution and linear layers that draw their own initial weights and pad as PyTorch's "same" does.

Initial weights are uniform with variance gain²/fan_in, so that the scale of a signal survives depth:
gain √2 before a rectifier (He et al. 2015), 1 before saturating gates. PyTorch's default (gain 1/√3)
would shrink a sweep about tenfold by the sixth layer. Uniform numbers are also several times faster to
draw than normal ones, which is felt at 38 M parameters.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, Protocol

import torch
from torch import nn
from torch.nn import functional

from brainbench.core.errors import DataError, UsageError, check_name, check_number, listing, nearest
from brainbench.core.files import content_hash


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Run a block with PyTorch's CPU generator at ``seed`` and in single precision; both are put back afterwards."""
    # PyTorch keeps seeds as signed 64-bit numbers.
    check_number("seed", seed, least=0, below=2**63, whole=True)
    precision = torch.get_default_dtype()
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        # A program that computes in double precision would draw other numbers.
        torch.set_default_dtype(torch.float32)
        try:
            yield
        finally:
            if torch.get_default_dtype() == torch.float32:  # else the code in the block chose another
                torch.set_default_dtype(precision)


def load_named(targets: Mapping[str, torch.Tensor], state: Mapping[str, Any], *, what: str) -> None:
    """Copy arrays or tensors of ``state`` into ``targets``, which has the same names; all or nothing."""
    check_named({name: tuple(value.shape) for name, value in targets.items()}, state, what=what)
    floating = (name for name, value in targets.items() if value.is_floating_point())
    # Copied as they are, quantised weights (integers, or floating point in one byte) would be other numbers.
    exact = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
    if quantised := [name for name in floating if torch.as_tensor(state[name]).dtype not in exact]:
        names = listing(quantised, limit=3)
        raise DataError(f"{names} of {what} must be real numbers in floating point; save them as float32.")
    copy_named(targets, state)


def check_named(shapes: Mapping[str, tuple[int, ...]], state: Mapping[str, Any], *, what: str) -> None:
    """Compare the names and shapes of ``state`` with the expected ones."""
    problems = []
    missing = [name for name in shapes if name not in state]
    unexpected = [name for name in state if name not in shapes]
    if missing:
        problems.append(f"missing {listing(missing)}")
    if unexpected:
        guesses = {name: nearest(name, shapes) for name in unexpected[:3]}
        hints = ", ".join(f"{name!r} → {guess!r}?" for name, guess in guesses.items() if guess)
        problems.append(f"unexpected {listing(unexpected)}" + (f" (did you mean {hints})" if hints else ""))
    wrong = [
        f"{name!r} has shape {list(state[name].shape)}, expected {list(shape)}"
        for name, shape in shapes.items()
        if name in state and tuple(state[name].shape) != shape
    ]
    if wrong:
        described = "; ".join(wrong[:4]) + (f"; and {len(wrong) - 4} more" if len(wrong) > 4 else "")
        problems.append(f"shapes that do not fit: {described}")
    if problems:
        raise DataError(f"The parameters do not fit {what}: {'; '.join(problems)}.")


def check_weights(module: nn.Module, name: str) -> None:
    """Raise UsageError for a module whose weights do not exist yet."""
    values = [*module.named_parameters(), *module.named_buffers()]
    if lazy := [label for label, value in values if nn.parameter.is_lazy(value)]:
        raise UsageError(
            f"{name} has lazy layers without weights yet ({', '.join(lazy[:3])}): run it once, on zeros of shape "
            "[1, 22, 30, 5, 7] for instance, before you return it."
        )
    if empty := [label for label, value in values if value.is_meta]:
        raise UsageError(
            f"{name} has weights that were never loaded ({', '.join(empty[:3])} on the device 'meta'): load them, or "
            "build it on a device that holds numbers."
        )


def weights_hash(module: nn.Module) -> str:
    """Return the hash of a module's parameters and buffers."""
    state = {name: value.detach().cpu() for name, value in module.state_dict().items()}
    # NumPy has no bfloat16; single precision holds its numbers.
    plain = {name: value.float() if value.dtype == torch.bfloat16 else value for name, value in state.items()}
    return content_hash(*(part for name in sorted(plain) for part in (name, plain[name].numpy())))


@torch.no_grad()
def copy_named(targets: Mapping[str, torch.Tensor], state: Mapping[str, Any]) -> None:
    """Copy checked arrays or tensors into the targets of the same names."""
    for name, target in targets.items():
        target.copy_(torch.as_tensor(state[name]))


RECTIFIER_GAIN = math.sqrt(2.0)

_MANY_WEIGHTS = 1 << 18

PRECISIONS = ("float32", "bf16")  # precisions of a packed network

ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "elu": nn.ELU,
    "gelu": nn.GELU,
    "identity": nn.Identity,
    "leakyrelu": nn.LeakyReLU,
    "relu": nn.ReLU,
    "sigmoid": nn.Sigmoid,
    "tanh": nn.Tanh,
}
"""Activation functions by lower-case name."""

INITIALISERS = ("kaiming_normal_", "kaiming_uniform_", "orthogonal_", "xavier_normal_", "xavier_uniform_")
"""Initialisers of :mod:`torch.nn.init` that a configuration may name."""


def activation(name: str | None) -> nn.Module:
    """Build an activation by name (:data:`ACTIVATIONS`, any case); None is the identity."""
    if name is None:
        return nn.Identity()
    check_name("activation", name.lower(), ACTIVATIONS)
    return ACTIVATIONS[name.lower()]()


@torch.no_grad()
def initialise(
    layer: nn.Conv2d | nn.Linear, *, gain: float, bias: float | None, method: Mapping[str, Any] | None
) -> None:
    """Draw a layer's weight and set its bias (None: uniform within 1/√fan_in, as PyTorch does)."""
    if layer.weight.is_meta:  # nothing to fill, and PyTorch imports its compiler (1 s) to find that out
        return
    fan_in = layer.weight[0].numel()
    if method is None:
        # A uniform number within ±b has variance b²/3, so this bound gives gain²/fan_in (He et al. 2015).
        bound = gain * math.sqrt(3.0 / fan_in)
        layer.weight.uniform_(-bound, bound)
    else:
        options = dict(method)
        getattr(nn.init, options.pop("method"))(layer.weight, **options)
    if layer.bias is not None and bias is not None:
        layer.bias.fill_(bias)
    elif layer.bias is not None:
        bound = 1.0 / math.sqrt(fan_in)
        layer.bias.uniform_(-bound, bound)


@torch.no_grad()
def draw_silent_biases(part: nn.Module) -> None:
    """Draw the biases that are zero, uniform within 1/√fan_in, in an encoder or attender with layer norm.

    Before an object arrives a sweep is exactly zero, and so is every activation of a network whose biases are zero.
    There layer norm has its steepest slope, 1/√ε = 316, at every place, step and layer: back through 22 steps of an
    unrolled network the gradient overflows single precision, and four S4 blocks alone make it 1e9. With drawn biases
    silence has a spread over channels, and the slope is of the order of one. Numbers come from PyTorch's global random
    state. A part without layer norm is left alone: in six saturating cells without norms biases would outweigh what is
    left of the stimulus.
    """
    if not any(isinstance(module, nn.LayerNorm) for module in part.modules()):
        return
    for layer in (module for module in part.modules() if isinstance(module, (nn.Conv2d, nn.Linear))):
        bias = layer.bias
        if bias is not None and not bias.is_meta and not bias.any():
            bound = 1.0 / math.sqrt(layer.weight[0].numel())
            bias.uniform_(-bound, bound)


def _onednn_orders(dtype: torch.dtype) -> bool:
    """Return whether oneDNN orders matrices of this type here: private operations, half precision not everywhere."""
    available = hasattr(torch.ops.mkldnn, "_reorder_linear_weight")
    return available and (dtype != torch.bfloat16 or torch.ops.mkldnn._is_mkldnn_bf16_supported())


class PackedMatrix:
    """A matrix [out, in] laid out for products with few rows on the CPU, in single or half precision."""

    def __init__(self, weight: torch.Tensor, bias: torch.Tensor | None, dtype: torch.dtype) -> None:
        self.dtype = dtype
        self.bias = None if bias is None else bias.detach()
        self.ordered, self.weight = _onednn_orders(dtype), weight.to(dtype).contiguous()
        if self.ordered:
            self.weight = torch.ops.mkldnn._reorder_linear_weight(self.weight, None)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Return x [..., in] times the matrix, plus the bias, in the precision of ``x``."""
        # A product with few rows is bound by reading the weights: half precision halves that, single keeps the digits.
        rounded = x.to(self.dtype)
        if self.ordered:
            y = torch.ops.mkldnn._linear_pointwise(rounded, self.weight, None, "none", [], "")
        else:
            y = functional.linear(rounded, self.weight)
        y = y.to(x.dtype)
        return y if self.bias is None else y + self.bias


class DeferredConvolution(Protocol):
    """A convolution whose weight gradient waits for the last step of a pass."""

    def convolve(self, inputs: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return the convolution [B, O, H', W'] of inputs side by side on channels."""
        ...


class Conv2d(nn.Conv2d):
    """2-D convolution [B, C, H, W] → [B, out, H', W'] with zero padding "same", "valid" or a number.

    For an even kernel "same" adds the odd row and column below and to the right, as PyTorch does,
    but without its warning.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        kernel_size: tuple[int, int],
        stride: tuple[int, int] = (1, 1),
        padding: str | tuple[int, int] = "same",
        use_bias: bool = True,
        bias: float | None = 0.0,
        gain: float = RECTIFIER_GAIN,
        method: Mapping[str, Any] | None = None,
    ) -> None:
        self._initial: dict[str, Any] = {"gain": gain, "bias": bias, "method": method}
        self._extra: tuple[int, int, int, int] | None = None
        self._packed: PackedMatrix | None = None
        self.deferred: DeferredConvolution | None = None
        """Place for what the gradient of the weights needs of each step; None outside of a deferring pass."""
        symmetric = (0, 0) if isinstance(padding, str) else padding
        if padding == "same":
            rows, columns = kernel_size
            left, right, top, bottom = (columns - 1) // 2, columns // 2, (rows - 1) // 2, rows // 2
            symmetric = (top, left)
            # PyTorch pads both sides of a convolution alike, so uneven zeros (even kernels) are added before it.
            if (left, top) != (right, bottom):
                symmetric, self._extra = (0, 0), (left, right, top, bottom)
        super().__init__(in_channels, out_channels, kernel_size, stride, symmetric, bias=use_bias)

    def reset_parameters(self) -> None:
        """Draw new weights from the global random state."""
        initialise(self, **self._initial)

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Convolve [B, C, H, W]."""
        if self._packed is not None and len(input) == 1:
            return self._convolve_packed(input, self._packed)
        return self._convolve(input, self.weight, self.bias)

    def conv_slice(self, input: torch.Tensor, start: int, *, use_bias: bool) -> torch.Tensor:
        """Convolve input channels from ``start`` on: [B, C, H, W], whose sum over all slices is the whole."""
        weight = self.weight[:, start : start + input.shape[1]]
        return self._convolve(input, weight, self.bias if use_bias else None)

    @property
    def around(self) -> tuple[int, int, int, int]:
        """(left, right, top, bottom) zeros around the input."""
        top, left = _two(self.padding)
        return self._extra or (left, left, top, top)

    def output_grid(self, rows: int, columns: int) -> tuple[int, int]:
        """Return (H', W') for an input of (H, W)."""
        left, right, top, bottom = self.around
        (down, aside), (height, width) = _two(self.stride), self.kernel_size
        return (rows + top + bottom - height) // down + 1, (columns + left + right - width) // aside + 1

    def pack(self, dtype: torch.dtype) -> None:
        """Keep a copy of the weights in the order in which one stimulus is multiplied with them fastest, on the CPU."""
        # Channels innermost, as the windows of the input are read.
        rows = self.weight.detach().permute(0, 2, 3, 1).flatten(1)
        self._packed = PackedMatrix(rows, self.bias, dtype)

    def _convolve_packed(self, input: torch.Tensor, packed: PackedMatrix) -> torch.Tensor:
        padded = functional.pad(input, self.around)[0].permute(1, 2, 0).contiguous()
        size = self.output_grid(*input.shape[2:])
        (rows, columns), (down, aside), (_, width, channels) = self.kernel_size, _two(self.stride), padded.shape
        # Channels innermost, the columns of a window lie side by side.
        strides = (down * width * channels, aside * channels, width * channels, 1)
        windows = padded.as_strided((*size, rows, columns * channels), strides)
        y = packed(windows.reshape(size[0] * size[1], -1))
        return y.T.reshape(1, -1, *size)

    def _convolve(self, input: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        padded = input if self._extra is None else functional.pad(input, self._extra)
        # Asked first: an exported program must not depend on the size of its example's batch.
        traced = torch.compiler.is_exporting() or torch.compiler.is_compiling()
        few = weight.numel() < _MANY_WEIGHTS
        if few or traced or len(input) > 1 or input.is_cuda or torch.is_grad_enabled():
            return self._conv_forward(padded, weight, bias)
        # The convolutions of CPUs rearrange their weights at every call, which for one stimulus takes longest.
        columns = functional.unfold(padded, self.kernel_size, padding=_two(self.padding), stride=_two(self.stride))
        # im2col and one matrix product read the weights where they lie.
        y = weight.flatten(1) @ columns[0]
        y = y if bias is None else y + bias[:, None]
        return y.view(1, -1, *self.output_grid(*input.shape[2:]))


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of [B, C, ...], separately at every place."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Normalise [B, C, ...] over C."""
        # Layer norm (Ba et al. 2016) of each place by itself, so that a touch at one whisker does not scale the others.
        return super().forward(input.movedim(1, -1)).movedim(-1, 1)


def _two(value: Any) -> tuple[int, int]:
    return (int(value[0]), int(value[1]))


def perceptron(*widths: int, norms: int = 0, use_bias: bool = True) -> nn.Sequential:
    """Return linear layers of these widths with ReLU between, the first ``norms`` of them followed by batch norms."""
    layers = nn.Sequential()
    for index, (width, after) in enumerate(pairwise(widths)):
        if index:
            layers.append(nn.ReLU())
        gain = RECTIFIER_GAIN if index < len(widths) - 2 else 1.0
        layers.append(Linear(width, after, use_bias=use_bias, gain=gain))
        if index < norms:
            layers.append(nn.BatchNorm1d(after))
    return layers


class Linear(nn.Linear):
    """Linear layer [..., in] → [..., out] with this module's initial weights."""

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        use_bias: bool = True,
        bias: float | None = 0.0,
        gain: float = 1.0,
        method: Mapping[str, Any] | None = None,
    ) -> None:
        self._initial: dict[str, Any] = {"gain": gain, "bias": bias, "method": method}
        self._packed: PackedMatrix | None = None
        super().__init__(in_features, out_features, bias=use_bias)

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Multiply [..., in] with the weights."""
        if self._packed is not None and len(input) == 1:
            return self._packed(input)
        return super().forward(input)

    def pack(self, dtype: torch.dtype) -> None:
        """Keep a copy of the weights in the order in which few inputs are multiplied with them fastest, on the CPU."""
        self._packed = PackedMatrix(self.weight.detach(), self.bias, dtype)

    def reset_parameters(self) -> None:
        """Draw new weights from the global random state."""
        initialise(self, **self._initial)


def packed(model: nn.Module, *, precision: str = "float32") -> nn.Module:
    """Return a copy of a network, in evaluation mode, whose steps for one stimulus are faster.

    ``float32`` equals the network to rounding; with ``bf16`` weights and what they are multiplied with are rounded to 8
    bits of mantissa, memories and everything else stay in single precision.

    Batches of two and more are computed as before, in single precision. The copy does not notice later changes of its
    weights: pack again after training.
    """
    check_name("precision of packed weights", precision, PRECISIONS)
    if any(parameter.device.type != "cpu" for parameter in model.parameters()):
        raise UsageError("Only networks on the CPU are packed; call .cpu() first.")
    faster = copy.deepcopy(model).eval().requires_grad_(False)
    for module in faster.modules():
        if isinstance(module, (Conv2d, Linear)):
            module.pack(torch.bfloat16 if precision == "bf16" else torch.float32)
    return faster
