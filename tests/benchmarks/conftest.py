"""A laboratory's folder: recordings, stimuli, and the benchmark that was made of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from brainbench.benchmarks.opening import Benchmark, open_benchmark
from tests.factories.scored_files import write_laboratory


@pytest.fixture(scope="session")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Benchmark]:
    """A folder with ``lab.toml`` and what it names, made once; copy it to change it."""
    folder = tmp_path_factory.mktemp("laboratory")
    return folder, open_benchmark(write_laboratory(folder))[0]


@pytest.fixture
def lab(laboratory: tuple[Path, Benchmark], tmp_path: Path) -> Path:
    """A copy of the folder."""
    from shutil import copytree

    return copytree(laboratory[0], tmp_path / "lab")
