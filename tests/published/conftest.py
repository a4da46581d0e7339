import json
import re
from functools import cached_property

import numpy as np
import pytest
import torch

from tests.factories.published_files import STEPS


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


@pytest.fixture(scope="session")
def published(reference):
    return PublishedReference(reference / "published")
