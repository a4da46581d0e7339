"""``brainbench policy export | deploy``: a student as a file, run on a hand or on a simulated one behind a socket."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit

if TYPE_CHECKING:
    from robotics_bridge.deploy.session import DeployedPolicy


def export(
    run: Annotated[Path, typer.Argument(help="A shipped student, or a folder of brainbench policy distill.")],
    out: Annotated[
        Path | None, typer.Option(help="File to write; by default policy.onnx in the folder of the run, or here.")
    ] = None,
    format: Annotated[str, typer.Option(help="onnx or jit.")] = "onnx",
    as_json: JsonOption = False,
) -> None:
    """Write a student with normalisers, taxel grid, encoder and head in one file, and compare it step by step."""
    from robotics_bridge.policies.export import STEPS, SUFFIXES, export_policy
    from robotics_bridge.policies.training.distill import load_student

    student, described = load_student(run)
    suffix = SUFFIXES.get(format, "")
    target = out or (run / f"policy{suffix}" if run.exists() else Path(f"{run.name}{suffix}"))
    found = export_policy(student, target, format=format, deployment=described["deployment"], name=run.name)
    text = (
        f"{found.path}: {found.state_size:,} numbers of memory; {STEPS} steps with resets differ by at most "
        f"{found.difference:.1e} of the largest action\n{found.contract}"
    )
    emit(found, text, as_json=as_json)


def deploy(
    policy: Annotated[Path, typer.Argument(help="A file of brainbench policy export; its contract lies beside it.")],
    driver: Annotated[
        str,
        typer.Option(help="sim: a simulated hand of its own process; or HOST:PORT of a hand that speaks its protocol."),
    ] = "sim",
    seconds: Annotated[float, typer.Option(help="How long.")] = 10.0,
    fault: Annotated[
        list[str] | None, typer.Option(help="Of the simulated hand: drop=0.2, jitter=0.03, silent-after=2, …")
    ] = None,
    goal: Annotated[list[float] | None, typer.Option(help="Numbers of the group 'goal', once for each.")] = None,
    timeout: Annotated[float, typer.Option(help="Oldest report to act upon (s).")] = 0.1,
    pressure: Annotated[float, typer.Option(help="Largest force of a finger tip, in the maker's unit.")] = 30.0,
    shadow: Annotated[
        bool, typer.Option("--shadow", help="Simulate touch beside the hand, for what it does not measure.")
    ] = False,
    threads: Annotated[int, typer.Option(help="Of the network's computations.")] = 1,
    ahead: Annotated[
        bool, typer.Option("--realtime", help="Run the loop ahead of all other work of the computer (SCHED_FIFO).")
    ] = False,
    record: Annotated[Path | None, typer.Option(help="Folder to write the session to, as a LeRobot data set.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Run a policy at its rate with watchdog, limits and safe stop; print latencies and why it stopped, if it did.

    Exit status 1: it was stopped for safety.
    """
    from robotics_bridge.deploy import session
    from robotics_bridge.deploy.episodes import SessionRecorder
    from robotics_bridge.deploy.simulated_hand import Faults, simulated_hand
    from robotics_bridge.deploy.timing import realtime
    from robotics_bridge.deploy.udp import UdpDriver

    deployed = session.read_deployed(policy)
    faults = Faults.parse(fault or [])
    sources = {}
    if "goal" in deployed.groups:
        size = deployed.groups["goal"][0]
        sources["goal"] = session.constant(goal if goal is not None else [0.0] * size, size)
    with contextlib.ExitStack() as stack:
        if driver == "sim":
            address, joints, fingers = stack.enter_context(
                simulated_hand(deployed.hand, faults=faults, seconds=seconds + 60)
            )
        else:
            address, joints, fingers = _remote(driver, deployed)
        link = stack.enter_context(UdpDriver(address, joints, fingers))
        task = str(deployed.deployment.get("task", "deployed policy"))
        recorder = SessionRecorder(deployed.hand, deployed.rate, task) if record is not None else None
        fallback = _shadow(deployed, joints) if shadow else None
        controller = deployed.controller(
            link, limits={"timeout": timeout, "pressure": pressure}, sources=sources, fallback=fallback,
            threads=threads, record=recorder,
        )  # fmt: skip
        with realtime() if ahead else contextlib.nullcontext():
            report = controller.run(seconds)
    facts: dict[str, Any] = {**vars(report)}
    if record is not None and recorder is not None and recorder.episode.state:
        facts["episode"] = str(recorder.write(record, joints))
    reason = f" ({report.reason})" if report.reason else ""
    latency = report.latency
    text = (
        f"{report.status}{reason}: {report.ticks} ticks in {report.seconds:.1f} s\n"
        f"control tick: p50 {latency['p50']:.2f} ms, p99 {latency['p99']:.2f} ms, max {latency['max']:.2f} ms; "
        f"{report.overruns} longer than a control step\n"
        f"reports: {report.link['received']} received, {report.link['lost']} lost, {report.link['late']} late, "
        f"{report.link['damaged']} damaged; targets limited in {report.limited} ticks\n"
        f"{controller.latency.text()}"
    )
    emit(facts, text, as_json=as_json)
    if report.status == "stopped":
        raise typer.Exit(1)


def _remote(text: str, deployed: DeployedPolicy) -> tuple[tuple[str, int], tuple[str, ...], tuple[str, ...]]:
    from brainbench.core.errors import UsageError
    from robotics_bridge import hands

    host, _, port = text.rpartition(":")
    if not host or not port.isdigit():
        raise UsageError(f"A driver is 'sim' or HOST:PORT; received {text!r}.")
    hand = hands.load(deployed.hand)
    return (host, int(port)), hand.joints, tuple(hand.fingers)


def _shadow(deployed: DeployedPolicy, joints: tuple[str, ...]) -> Any:
    from robotics_bridge.deploy.simulated_hand import ShadowTouch

    facts = deployed.deployment
    names = (str(facts[key]) for key in ("observe", "placement", "resolution"))
    return ShadowTouch(deployed.hand, *names, joints=joints, rate=deployed.rate, sub_steps=int(facts["sub_steps"]))
