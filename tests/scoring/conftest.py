"""Recordings of animals whose geometry is known."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.sessions import make_session

LABELS = tuple("abcdef")


def _rates(units: int, *, geometry: int = 0, tuning: int) -> np.ndarray:
    """Rates [K, units] (Hz) of units with random tuning to five dimensions that the stimuli differ in."""
    dimensions = np.random.default_rng(geometry).normal(size=(len(LABELS), 5))
    return 12 * np.exp(0.4 * dimensions @ np.random.default_rng([8, tuning]).normal(size=(5, units)))


def _make_recordings(folder: Path, *, animals: int = 4, units: int = 80, trials: int = 30, missing: str = "") -> Path:
    """Animals whose rates are random mixtures of one geometry, with Poisson spikes."""
    for animal in range(animals):
        rng = np.random.default_rng([7, animal])
        rates = _rates(units, tuning=animal)
        order = rng.permutation(np.repeat(np.arange(len(LABELS)), trials))
        if animal == 0 and missing:
            order = order[order != LABELS.index(missing)]
        starts = 1.0 + 1.5 * np.arange(len(order))
        spikes = [
            np.sort(
                np.concatenate(
                    [
                        start + rng.uniform(0, 1, rng.poisson(rates[k, unit]))
                        for start, k in zip(starts, order, strict=True)
                    ]
                )
            )
            for unit in range(units)
        ]
        table = {"start_time": starts, "stop_time": starts + 1.0, "stimulus": [LABELS[k] for k in order]}
        span = np.array([[0.0, starts[-1] + 2]])
        session = make_session(f"m{animal}", "s", spikes, {"trials": table}, observed=[span] * units)
        write_recordings(folder / f"m{animal}.h5", session)
    return folder


@pytest.fixture(scope="session")
def geometry() -> Callable[..., np.ndarray]:
    """Features [K, 2000]: what very many noiseless units of that geometry would show."""
    return lambda seed=0: _rates(2000, geometry=seed, tuning=99)


@pytest.fixture(scope="session")
def make_recordings() -> Callable[..., Path]:
    return _make_recordings


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _make_recordings(tmp_path_factory.mktemp("recordings"))


@pytest.fixture(scope="session")
def recordings(folder: Path) -> xr.Dataset:
    return open_recordings(folder, conditions="trials:stimulus")
