"""``brainbench policy export | deploy``: a student as a file, run on a hand or on a simulated one behind a socket."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import option, out_file, with_options
from brainbench.cli.output import Output, progress_bar
from brainbench.core.errors import check_each
from brainbench.core.limits import read_pairs, read_value
from brainbench.core.plugins import require_optional

if TYPE_CHECKING:
    from robotics_bridge.deploy.controller import DeployedPolicy


DRIVER = "robotics_bridge.deploy.driver:DriverRequest"
LINKS = "robotics_bridge.links"
"""Entry points of what a hand's link adds: touch simulated beside it, and recorders of sessions."""


def export(
    run: Annotated[Path, typer.Argument(help="A shipped student, or a folder of brainbench policy distill.")],
    out: Annotated[
        Path | None,
        typer.Option(
            callback=out_file, help="File to write; by default policy.onnx in the folder of the run, or here."
        ),
    ] = None,
) -> Output:
    """Write a student with normalisers, taxel grid, encoder and head in one file, and compare it step by step."""
    from robotics_bridge.policies.export import STEPS, export_policy
    from robotics_bridge.policies.training.distill import load_student

    student, described = load_student(run)
    target = out or (run / "policy.onnx" if run.exists() else Path(f"{run.name}.onnx"))
    with progress_bar("exporting the policy"):
        written = export_policy(student, target, deployment=described["deployment"], name=run.name)
    text = (
        f"{written.path}: {written.state_size:,} numbers of memory; {STEPS} steps with resets differ by at most "
        f"{written.difference:.1e} of the largest action\n{written.contract}"
    )
    return Output(written, text)


@with_options("robotics_bridge.deploy.safety:SafetyLimits", ("timeout", "pressure"), parameter="limits", build=False)
def deploy(
    policy: Annotated[Path, typer.Argument(help="A file of brainbench policy export; its contract lies beside it.")],
    limits: dict[str, Any],
    driver: Annotated[
        str,
        typer.Option(
            help="sim: a simulated hand of its own process; HOST:PORT, or :PORT on this computer, of another."
        ),
    ] = "sim",
    key: Annotated[Path | None, option(DRIVER, "key")] = None,
    seconds: Annotated[float, typer.Option(help="How long.")] = 10.0,
    fault: Annotated[list[str] | None, option(DRIVER, "faults")] = None,
    inputs: Annotated[
        list[str] | None,
        typer.Option("--input", help="Constant for what the hand cannot measure: NAME=NUMBER or NAME=NUMBER,…"),
    ] = None,
    shadow: Annotated[
        bool, typer.Option("--shadow", help="Simulate touch beside the hand, for what it does not measure.")
    ] = False,
    threads: Annotated[int, typer.Option(help="Of the network's computations.")] = 1,
    ahead: Annotated[
        bool, typer.Option("--realtime", help="Run the loop ahead of all other work of the computer (SCHED_FIFO).")
    ] = False,
    record: Annotated[Path | None, typer.Option(help="Folder to write the session to, as a LeRobot data set.")] = None,
) -> Output:
    """Run a policy at its rate with watchdog, limits and safe stop; print latencies and why it stopped, if it did.

    Exit status 1: it was stopped for safety.
    """
    from robotics_bridge.deploy.controller import check_duration, read_deployed, realtime
    from robotics_bridge.deploy.driver import DriverRequest, open_driver
    from robotics_bridge.tasks.settings import contacts_name

    deployed = read_deployed(policy)
    contract = deployed.contract
    check_duration(seconds)
    recorder = None if record is None else require_optional(LINKS, "lerobot", "recorder")(contract, record)
    shadow_touch = require_optional(LINKS, "shadow", "touch") if shadow else None
    given = _inputs(deployed, inputs or [])
    # What is missing is said before a hand is started or greeted.
    opened = open_driver(
        "udp" if ":" in driver else driver,
        DriverRequest(contract=contract, address=driver, key=key, faults=tuple(fault or ()), seconds=seconds + 60),
    )
    beside = f"simulated beside the hand, {contacts_name(contract.contacts)} contacts"
    unmeasured = {
        name: f"{what}: {beside if shadow and name == 'tactile' else 'constant'}"
        for name, what in deployed.require({*given, *(("tactile",) if shadow else ())}).items()
    }
    with opened as link:
        fallback = shadow_touch(contract, link.joints) if shadow_touch is not None else given.pop("tactile", None)
        controller = deployed.controller(
            link, limits=limits, sources=given, fallback=fallback,
            threads=threads, record=None if recorder is None else recorder.begin(link.joints, link.fingers),
        )  # fmt: skip
        with realtime() if ahead else contextlib.nullcontext():
            report = controller.run(seconds)
    facts: dict[str, Any] = {**vars(report), "unmeasured": unmeasured}
    followed = ""
    if shadow_touch is not None:
        facts["shadow"] = {"apart": fallback.apart, "lost": fallback.lost}
        followed = f"{fallback.summary()}\n"
    if recorder is not None and (episode := recorder.write()) is not None:
        facts["episode"] = str(episode)
    reason = f" ({report.reason})" if report.reason else ""
    latency = report.latency
    absent = "".join(f"not measured by the hand: {name} ({what})\n" for name, what in unmeasured.items())
    text = (
        f"{absent}{followed}{report.status}{reason}: {report.ticks} ticks in {report.seconds:.1f} s\n"
        f"control tick: p50 {latency['p50']:.2f} ms, p99 {latency['p99']:.2f} ms, max {latency['max']:.2f} ms; "
        f"{report.overruns} longer than a control step\n"
        f"reports: {report.link['received']} received, {report.link['lost']} lost, {report.link['late']} late, "
        f"{report.link['stale']} stale, {report.link['replayed']} replayed, {report.link['damaged']} damaged "
        f"or forged; targets limited in {report.limited} ticks\n"
        f"{controller.latency.text()}"
    )
    return Output(facts, text, failure=typer.Exit(1) if report.status == "stopped" else None)


def _inputs(deployed: DeployedPolicy, words: list[str]) -> dict[str, Any]:
    """Return group → its constant, as --input gives them."""
    from robotics_bridge.deploy.controller import constant

    wanted = [name for name in deployed.contract.inputs if name != "proprio"]
    pairs = read_pairs(words, "--input", "command=1,0,0")
    values = {name: list(read_value(name, text, tuple[float, ...])) for name, text in pairs.items()}
    check_each("input that the policy reads and a constant can replace", values, wanted)
    return {name: constant(name, numbers, deployed.contract.inputs[name]) for name, numbers in values.items()}
