"""``brainbench tactile check``: short tests of this installation against truths nobody here invented."""

from __future__ import annotations

from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table


def check(
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    as_json: JsonOption = False,
) -> None:
    """Compare sensors with closed forms on this machine; exit status 1 if one is off."""
    from brainbench.cli.tactile.checks import CHECKS

    rows, results = [], []
    with progress_bar() as progress:
        for index, (name, run) in enumerate(CHECKS.items()):
            progress(index, len(CHECKS), "checking")
            found, truth, tolerance = run(device)
            error = abs(found - truth) / max(abs(truth), 1e-30)
            passed = error <= tolerance
            results.append({"check": name, "found": found, "truth": truth, "error": error, "passed": passed})
            rows.append([name, f"{found:.6g}", f"{truth:.6g}", f"{error:.1e}", "ok" if passed else "OFF"])
        progress(len(CHECKS), len(CHECKS), "checking")
    text = table(f"Checks on {device}", ["check", "found", "truth", "relative error", ""], rows, right=(1, 2, 3))
    emit({"device": device, "checks": results}, text, as_json=as_json)
    if not all(result["passed"] for result in results):
        raise typer.Exit(1)
