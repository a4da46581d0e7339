"""The one seam between data generation and physics: indices of sweeps in, their wrenches out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.engines.protocol import SweepBatch, WhiskerEngine, describe_unstable, join_batches
from brainbench.stimuli.explain import Explanation
from brainbench.stimuli.simulation import simulate_uncached
from brainbench.stimuli.sweeps.grid import SweepGrid
from brainbench.stimuli.sweeps.sweep_scenes import SweepScenes

_TOGETHER = 16
"""Sweeps whose scenes exist at the same time: bounds the memory of a batch."""


def simulate_sweeps(
    scenes: SweepScenes,
    indices: Sequence[int],
    *,
    fidelity: Fidelity,
    backend: str = DEFAULT_ENGINE,
    device: str = "cpu",
    workers: int | None = None,
    retry: int = 1,
    packed: Mapping[str, Any] | None = None,
) -> SweepBatch:
    """Simulate the sweeps of some indices, many at once where the engine can (:attr:`WhiskerEngine.batches`).

    Ordered by object they are fastest. Options are those of :meth:`WhiskerEngine.run_sweeps` and
    :func:`brainbench.stimuli.engines.get_engine`.
    """
    engine = get_engine(backend, device=device, retry=retry)
    if takes_sweeps(engine, scenes.grid):
        return engine.run_sweeps(scenes, indices, fidelity, workers=workers, packed=packed)
    parts = [indices[first : first + _TOGETHER] for first in range(0, len(indices), _TOGETHER)]
    return join_batches([_one_by_one(scenes, part, fidelity, engine, workers) for part in parts])


def takes_sweeps(engine: WhiskerEngine, grid: SweepGrid) -> bool:
    """Return whether an engine simulates many sweeps of a grid at once."""
    return engine.batches and grid.mover == "object"


def _one_by_one(
    scenes: SweepScenes, indices: Sequence[int], fidelity: Fidelity, engine: WhiskerEngine, workers: int | None
) -> SweepBatch:
    """Simulate sweeps as any other scenes."""
    dataset = simulate_uncached([scenes[index] for index in indices], fidelity, engine, workers=workers)
    unstable = dataset["status"].values != "ok"
    explanation = Explanation.of(dataset)
    names = [str(name) for name in dataset["whisker"].values]
    return SweepBatch(
        wrench=dataset["wrench"].values,
        contact=dataset["contact"].values.mean(axis=1).astype(np.float32),
        unstable=unstable,
        reasons=describe_unstable(names, unstable, dataset["reason"].values),
        steps=explanation.steps,
        steps_in_full=explanation.steps_in_full,
        unsolved=explanation.unsolved,
    )
