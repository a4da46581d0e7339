"""States of networks as the files of the published study hold them."""

import torch

from brainbench.published.checkpoint_import import published_names, stored_readout

STEPS = 22


def lightning_state(model, **others):
    """A network of ours as the authors' file would hold it, with S4's stored form and the axes of length one."""
    state = {}
    values = model.state_dict()
    for ours, theirs in published_names(model).items():
        value = values[ours].clone()
        if theirs.endswith(".kernel.A_imag"):
            value = -value
        elif theirs.endswith(".kernel.C"):
            memory = model.get_submodule(ours.rpartition(".")[0])
            value = stored_readout(memory.transition(), value, STEPS, undo=False).float()[None]
        elif theirs.endswith((".kernel.B", ".kernel.P", ".layer.D")):
            value = value[None]
        elif theirs.endswith(".inv_dt") or theirs.endswith("output_linear.0.weight"):
            value = value[..., None]
        state[theirs] = value
        if theirs.endswith(".kernel.C"):
            state[theirs.replace(".C", ".l_kernel")] = torch.tensor(STEPS)
    return state | others
