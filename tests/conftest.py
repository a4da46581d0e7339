"""Shared fixtures. Tests marked ``shared`` skip without the reference data, except in our CI."""

from __future__ import annotations

import os
import sys
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
