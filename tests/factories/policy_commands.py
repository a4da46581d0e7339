"""``brainbench policy`` called as a user calls it."""

from __future__ import annotations

from typer.testing import CliRunner

from brainbench.cli import app


def run_policy(*arguments: object, code: int = 0) -> str:
    """Return what ``brainbench policy`` prints; what it raises is raised here too."""
    result = CliRunner().invoke(app, ["policy", *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.stdout
