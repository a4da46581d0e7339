"""Steps of learning that are recorded on CUDA."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from robotics_bridge.policies.training.rollouts import ChunkStep


def _learn(device: str, *, record: bool, steps: int = 8) -> list[torch.Tensor]:
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(3, 8), nn.ELU(), nn.Linear(8, 2)).to(device)
    cuda = device == "cuda"
    optimizer = torch.optim.Adam(net.parameters(), 1e-2, fused=cuda, capturable=cuda)

    def loss(given: Any) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        y = net(given["x"]) + given["memory"]
        return {"fit": (y - 1).pow(2).mean(), "size": 0.1 * y.abs().mean()}, 0.5 * y

    step = ChunkStep(loss, list(net.parameters()), optimizer, clip=0.5, record=record)
    memory, found = torch.zeros(4, 2, device=device), []
    for _ in range(steps):
        parts, memory = step({"x": torch.randn(4, 3).to(device), "memory": memory})
        found.append(torch.stack([value.clone() for value in parts.values()]).cpu())
    # A last piece of another size is learned from too.
    parts, _ = step({"x": torch.randn(2, 3).to(device), "memory": memory[:2]})
    return [*found, torch.stack(list(parts.values())).cpu()]


def test_each_step_descends_and_hands_on_the_memory() -> None:
    found = _learn("cpu", record=False, steps=200)
    assert float(found[-1][0]) < 0.5 * float(found[0][0])
    assert not any(value.requires_grad for value in found)


@pytest.mark.gpu
def test_recorded_steps_learn_what_unrecorded_ones_do() -> None:
    plain, recorded = _learn("cuda", record=False), _learn("cuda", record=True)
    for one, two in zip(plain, recorded, strict=True):
        torch.testing.assert_close(two, one)
