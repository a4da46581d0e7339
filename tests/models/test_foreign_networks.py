"""Contract over networks of others: a layer is what each stimulus gives alone in a fresh model, or is named."""

import numpy as np
import pytest
import torch
from torch import nn

from brainbench.models.activations import extract
from brainbench.models.proof import first_tensor
from tests.factories.foreign_networks import NETWORKS, make_network


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
