"""The architectures that come with brainbench. Importing this module imports no framework."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.models.registry import register_model

if TYPE_CHECKING:
    from brainbench.models.ead import EAD

CELLS = {
    "": ("time-decay", "time-decay memory"),
    "-ugrnn": ("ugrnn", "UGRNN"),
    "-intersection": ("intersection", "IntersectionRNN"),
    "-gru": ("gru", "GRU"),
    "-lstm": ("lstm", "LSTM"),
}
"""Name part → cell of :mod:`brainbench.models.cells` and words."""

CITATION = (
    "Zhuang, Kubilius, Hartmann & Yamins 2017, Toward goal-driven neural network models for the rodent "
    "whisker-trigeminal system, NeurIPS 30"
)
LICENCE = "MIT"


def zhuang(cell: str, *, layer_norm: bool = False, small: bool = False, gpt: bool = False) -> EAD:
    """Build a Zhuang network with new random weights and a linear decoder to 117 classes.

    Args:
        cell: Cell of the encoder.
        layer_norm: Normalise the cell's gates (the output of time decay).
        small: All widths × 3/16; the GPT attender is then 96 wide, at equal depth.
        gpt: Add the GPT attender, as wide as the encoder's output.
    """
    from brainbench.models.attenders.gpt import GPTAttender
    from brainbench.models.ead import EAD
    from brainbench.models.encoders.zhuang import ZhuangEncoder
    from brainbench.models.graph import TemporalGraph

    choice = ZhuangEncoder(cell, layer_norm, small)
    return EAD(
        TemporalGraph(choice.spec()),
        GPTAttender(choice.features, choice.features) if gpt else None,
    )


def register() -> None:
    """Enter every architecture into the registry, full sizes first."""
    for small in (False, True):
        for gpt in (False, True):
            for part, (cell, words) in CELLS.items():
                for layer_norm in (False, True):
                    _register(part, cell, words, layer_norm=layer_norm, small=small, gpt=gpt)


def _register(part: str, cell: str, words: str, *, layer_norm: bool, small: bool, gpt: bool) -> None:
    name = f"zhuang{part}{'-ln' if layer_norm else ''}{'-small' if small else ''}{'+gpt' if gpt else ''}"
    described = f"Recurrent convolutional encoder, {words}{', LayerNorm' if layer_norm else ''}"
    described += f"{', GPT attender' if gpt else ''}{', 3/16 width' if small else ''}"
    family = "zhuang+gpt" if gpt else "zhuang"

    @register_model(name, family=family, description=described, citation=CITATION, licence=LICENCE)
    def build() -> EAD:
        return zhuang(cell, layer_norm=layer_norm, small=small, gpt=gpt)
