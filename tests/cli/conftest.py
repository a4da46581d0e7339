"""Run the command line in this process, as the console script does."""

import sys
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from brainbench.cli import main


@dataclass(frozen=True)
class Outcome:
    status: int
    out: str
    err: str


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Return a function from arguments to exit status, stdout and stderr."""

    def call(*arguments: str) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["brainbench", *arguments])
        status = 0
        try:
            main()
        except SystemExit as stop:
            status = int(stop.code or 0)
        captured = capsys.readouterr()
        return Outcome(status, captured.out, captured.err)

    return call
