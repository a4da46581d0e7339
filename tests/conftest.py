"""Shared fixtures. Tests marked ``shared`` skip without the reference data, except in our CI."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import settings

# Processes that a test spawns inherit this path and find the test's module; at the end, so that the installed
# package is the one under test.
sys.path.append(str(Path(__file__).parents[1]))
# Idle OpenMP threads would otherwise spin and slow each other down on a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# So would OpenBLAS's: on two busy cores the small products of a fit took ten times as long with two threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A deadline would fail tests on a busy machine.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

REFERENCE = Path(os.environ.get("BRAINBENCH_REFERENCE", Path(__file__).parents[2] / "shared" / "reference"))


@pytest.fixture(scope="session")
def reference() -> Path:
    """The folder of published reference data; a test that asks for it carries the marker ``shared``."""
    if not REFERENCE.is_dir():
        message = f"reference data not found at {REFERENCE}"
        if os.environ.get("BRAINBENCH_REQUIRE_REFERENCE"):
            pytest.fail(message)
        pytest.skip(message)
    return REFERENCE


@pytest.fixture(autouse=True, scope="session")
def _private_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep the tests away from the user's settings and cache (set BRAINBENCH_TEST_CACHE to reuse one between runs)."""
    chosen = os.environ.get("BRAINBENCH_TEST_CACHE")
    os.environ["BRAINBENCH_CACHE"] = chosen or str(tmp_path_factory.mktemp("cache"))
    os.environ["BRAINBENCH_CONFIG"] = str(tmp_path_factory.mktemp("settings"))


@pytest.fixture(autouse=True)
def _same_random_numbers() -> None:
    """Draw the same random numbers of torch in every run of a test."""
    if (torch := sys.modules.get("torch")) is not None:
        torch.manual_seed(20170607)


@dataclass(frozen=True)
class Outcome:
    """Exit status and streams of a command."""

    status: int
    out: str
    err: str


@pytest.fixture
def run(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Outcome]:
    """Return a function that runs the command line in this process, as the console script does."""
    from brainbench.cli import main, output

    # Lines of progress depend on the machine's load; they stay out of what is asserted of stderr.
    monkeypatch.setattr(output, "FIRST_LINE", 1e6)

    def call(*arguments: str) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["brainbench", *arguments])
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = int(stop.code or 0)
        captured = capsys.readouterr()
        if status:
            # What a command refused explains a test that fails later.
            request.node.add_report_section("call", f"status {status}", captured.err)
        return Outcome(status, captured.out, captured.err)

    return call


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """Files of a recording of two animals, and features, stimuli and a model for its four conditions."""
    from tests.factories.scored_files import write_study

    (tmp_path / "mine.py").write_text(
        "from torch import nn\n\n\nclass Mine(nn.Module):\n"
        "    def __init__(self):\n        super().__init__()\n        self.gru = nn.GRU(8, 6, batch_first=True)\n\n"
        "    def forward(self, x):\n        return self.gru(x.flatten(2))[0][:, -1]\n"
    )
    paths = write_study(tmp_path, "xy", "abcd", repeats=10, until=60.0, arrays="arrays.h5")
    return paths | {"model": f"{tmp_path / 'mine.py'}:Mine"}


@pytest.fixture
def study(tmp_path: Path) -> dict[str, str]:
    """Files of four animals and eight stimuli, and features for them."""
    from tests.factories.scored_files import write_study

    return write_study(tmp_path)
