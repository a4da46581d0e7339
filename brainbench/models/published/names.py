"""Names of the published networks' entries for the entries of ours, and the one value that is stored otherwise.

A Lightning file keeps a network under ``model.encoder``, ``model.attender`` and ``model.decoder``. Values are equal up
to axes of length one; S4 alone stores its readout after a change of variables for the training's number of steps.
"""

from __future__ import annotations

import re

import torch

from brainbench.models.graph.temporal_graph import TemporalGraph
from brainbench.models.heads import AllStepsDecoder
from brainbench.models.network import EncoderAttenderDecoder

_RESNET = (
    (r"^conv1\.0\.", "conv1."),
    (r"^conv1\.1\.", "bn1."),
    (r"\.norm(\d)\.", r".bn\1."),
    (r"\.shortcut\.", ".downsample."),
    (r"^fc\.2\.", "fc."),
    (r"^", "encoder."),
)
_S4 = (
    (r"^blocks\.(\d+)\.norm\.", r"norms.\1."),
    (r"^blocks\.(\d+)\.mix\.", r"s4_layers.\1.output_linear.0."),
    (r"^blocks\.(\d+)\.memory\.skip$", r"s4_layers.\1.layer.D"),
    (r"^blocks\.(\d+)\.memory\.", r"s4_layers.\1.layer.kernel."),
    (r"\.log_step$", ".inv_dt"),
    (r"\.log_decay$", ".A_real"),
    (r"\.frequency$", ".A_imag"),
    (r"\.low_rank$", ".P"),
    (r"\.drive$", ".B"),
    (r"\.readout$", ".C"),
    (r"^fc\.", "decoder."),
)
_GPT = (
    (r"^action$", "_action_token"),
    (r"^embed\.", "_policy.transformer.wte."),
    (r"^positions$", "_policy.transformer.wpe.weight"),
    (r"^blocks\.", "_policy.transformer.h."),
    (r"\.norm_attention\.", ".ln_1."),
    (r"\.query_key_value\.", ".attn.c_attn."),
    (r"\.project\.", ".attn.c_proj."),
    (r"\.norm_mlp\.", ".ln_2."),
    (r"\.mlp\.0\.", ".mlp.c_fc."),
    (r"\.mlp\.2\.", ".mlp.c_proj."),
    (r"^norm\.", "_policy.transformer.ln_f."),
    (r"^lm_head\.", "_policy.lm_head."),
)
_MAMBA = (
    (r"^blocks\.(\d+)\.(?!norm)", r"layers.\1.mixer."),
    (r"^blocks\.(\d+)\.norm", r"layers.\1.norm"),
    (r"\.expand\.", ".in_proj."),
    (r"\.convolution\.", ".conv1d."),
    (r"\.select\.", ".x_proj."),
    (r"\.step_size\.", ".dt_proj."),
    (r"\.log_decay$", ".A_log"),
    (r"\.skip$", ".D"),
    (r"\.project\.", ".out_proj."),
    (r"^norm\.", "norm_f."),
)
_RULES = {"ResNet18Encoder": _RESNET, "S4Encoder": _S4, "GPTAttender": _GPT, "MambaAttender": _MAMBA}


def published_names(model: EncoderAttenderDecoder) -> dict[str, str]:
    """Return the name in a Lightning file of every entry of a network's state, the normaliser's aside."""
    graph = model.encoder.tnn_parameters() if isinstance(model.encoder, TemporalGraph) else {}
    nodes = {id(value): f"TG.{name}" for name, value in graph.items()}
    found = {}
    for part, module in model.named_children():
        entries = module.state_dict(keep_vars=True) if part != "normaliser" else {}
        for name, value in entries.items():
            theirs = nodes[id(value)] if nodes and part == "encoder" else _renamed(module, name)
            found[f"{part}.{name}"] = f"model.{part}.{theirs}"
    return found


def _renamed(module: torch.nn.Module, name: str) -> str:
    for pattern, theirs in _RULES.get(type(module).__name__, ()):
        name = re.sub(pattern, theirs, name)
    if type(module).__name__ in _RULES:
        return name
    # Decoders: linear layers 0, 1, 2 in the authors' files; ours count the rectifiers between them too.
    owner, _, leaf = name.rpartition(".")
    steps = {"": 0, "first": 0} if isinstance(module, AllStepsDecoder) or not owner else {}
    layer = steps[owner] if owner in steps else (int(owner.removeprefix("rest.")) + owner.startswith("rest.")) // 2
    return f"mlp.{layer}.lin.{leaf}"


def stored_readout(transition: torch.Tensor, readout: torch.Tensor, steps: int, *, undo: bool) -> torch.Tensor:
    """Return S4's readout [H, N, 2] as it is stored for sweeps of ``steps``, C (1 − Ā^steps), or ``undo`` that.

    ``transition`` [H, 2 N, 2 N] is Ā of all states. So adapted, a kernel of that length needs no powers of Ā (Gu et
    al. 2022, appendix C.3); the recurrence needs C itself.
    """
    half = torch.view_as_complex(readout.double().contiguous())
    row = torch.cat((half, half.conj()), 1)[:, None]
    change = torch.eye(row.shape[-1], dtype=row.dtype) - torch.linalg.matrix_power(transition, steps)
    row = torch.linalg.solve(change, row, left=False) if undo else row @ change
    return torch.view_as_real(row[:, 0, : half.shape[1]].resolve_conj()).contiguous()
