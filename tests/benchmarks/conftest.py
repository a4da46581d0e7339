"""A laboratory's folder: recordings, stimuli, and the benchmark that was made of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from brainbench.benchmarks.opening import Benchmark, make
from brainbench.core.files import write_text
from brainbench.scoring.options import ScoreOptions
from tests.factories.scored_files import write_study


@pytest.fixture(scope="session")
def laboratory(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Benchmark]:
    """A folder with ``lab.toml`` and what it names, made once; copy it to change it."""
    folder = tmp_path_factory.mktemp("laboratory")
    write_study(folder)
    options = ScoreOptions(
        recordings=str(folder / "data"), conditions="trials:texture", stimuli=str(folder / "eight.h5"), seed=1
    )
    benchmark = make(
        options, folder / "lab.toml", name="lab", citation="Doe J., A Journal 1:2 (2026), doi:10.1000/xyz", doi="10.1/2"
    )
    write_text(folder / "lab.toml", benchmark.to_toml())
    return folder, benchmark


@pytest.fixture
def lab(laboratory: tuple[Path, Benchmark], tmp_path: Path) -> Path:
    """A copy of the folder."""
    from shutil import copytree

    return copytree(laboratory[0], tmp_path / "lab")
