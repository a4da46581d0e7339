r"""Convolutional recurrent cells.

Every cell maps an input x [B, C, H, W] and a state s to an output y [B, out, H, W] and the next state. The input's
share of the gates can be computed for all time steps at once (:meth:`Cell.project`).
Gates come from one fused "same" convolution of cat(x, s). ``layer_norm`` normalises each gate's
pre-activation over channels at every place (Ba et al. 2016). A gate that keeps the old state carries a
fixed +1 inside its sigmoid, so that a fresh cell remembers: it passes on 1 − σ(1) = 27 % of what is new,
and untrained gated networks answer ever more softly with depth. Biases start at zero.

Equations: UGRNN and IntersectionRNN, Collins et al. 2017; GRU, Cho et al. 2014; LSTM, Hochreiter and Schmidhuber 1997,
Gers et al. 2000. Order and names of the gates follow PyTorchTNN, whose weights :meth:`load_tnn_state` reads.
"""

from collections.abc import Callable, Mapping

from brainbench.models.cells.cell import Cell, TimeDecay
from brainbench.models.cells.gated import GRU, LSTM, UGRNN, IntersectionRNN

__all__ = ["GRU", "LSTM", "UGRNN", "IntersectionRNN", "TimeDecay"]

CELLS: Mapping[str, Callable[..., Cell]] = {
    "time-decay": TimeDecay,
    "ugrnn": UGRNN,
    "intersection": IntersectionRNN,
    "gru": GRU,
    "lstm": LSTM,
}
"""Cells by the name that graphs and the registry use."""
