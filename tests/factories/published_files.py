"""Files of the published study: the reference lists filled by their rule, and small ones in the same layout."""

import json
import re
from functools import cached_property

import numpy as np
import torch

from brainbench.published.checkpoint_import import published_names, stored_readout

STEPS = 22


class PublishedReference:
    """The folder ``published`` of the reference data."""

    def __init__(self, folder):
        self.folder = folder
        rule = re.search(r"```python\n(.*?)```", (folder / "fill_rule.md").read_text(encoding="utf-8"), re.DOTALL)
        names = {}
        exec(rule[1], names)  # the rule is published as code
        self.fill, self._stimulus = names["fill"], names["stimulus"]

    @cached_property
    def networks(self):
        return json.loads((self.folder / "state_dicts.json").read_text(encoding="utf-8"))["networks"]

    @cached_property
    def outputs(self):
        """{network: {what: array}}."""
        found = {}
        with np.load(self.folder / "outputs.npz", allow_pickle=False) as arrays:
            for key in arrays.files:
                network, what = key.split("|")
                found.setdefault(network, {})[what] = arrays[key]
        return found

    def stimulus(self, batch):
        """Sweeps in SI of which the authors' networks see the rule's numbers in mN and µN·m."""
        scale = torch.tensor(([1e-3] * 3 + [1e-6] * 3) * 5, dtype=torch.float64)[:, None, None]
        return (torch.from_numpy(self._stimulus(batch)).double() * scale).float()

    def state(self, network):
        """Every entry of a network's file."""
        return {name: self._value(name, shape, dtype) for name, shape, dtype in self.networks[network]["state_dict"]}

    def _value(self, name, shape, dtype):
        value = self.fill(name, tuple(shape))
        if value is None and name.endswith(".attn.bias"):
            value = np.tril(np.ones(shape))
        elif value is None:
            value = np.full(shape, STEPS if name.endswith("l_kernel") else 0)
        return torch.from_numpy(np.array(value)).to(getattr(torch, dtype))


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
