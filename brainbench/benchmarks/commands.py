"""``brainbench benchmark``: make, check, pack, list and add benchmarks, one file that others score on."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.benchmarks.opening import OPTIONS, list_benchmarks
from brainbench.benchmarks.opening import add as add_benchmark
from brainbench.benchmarks.opening import check as check_benchmark
from brainbench.benchmarks.opening import make as make_benchmark
from brainbench.benchmarks.opening import pack as pack_benchmark
from brainbench.cli.options import SCORE, SCORE_FLAGS, needs, out_file_option, with_options
from brainbench.cli.output import Output, facts, progress_bar, table_of
from brainbench.core.errors import UsageError
from brainbench.core.files import write_text

OPENING = "brainbench.benchmarks.opening"
app = typer.Typer(no_args_is_help=True, help="Make, check and pack benchmarks: one file that others score on.")
NamedBenchmark = Annotated[str, typer.Argument(help="A benchmark: FILE.toml, FILE.zip, or a name of the list.")]


@app.command("make")
@needs(cache=True)
@with_options(SCORE, ("recordings", "match", *OPTIONS), flags=SCORE_FLAGS)
@with_options(f"{OPENING}:Benchmark", ("citation", "contact"), parameter="about", build=False)
@with_options(f"{OPENING}:Recordings", ("source", "doi", "version", "licence"), parameter="origin", build=False)
def make(
    out: Annotated[Path, out_file_option("File to write, FILE.toml, in a folder that holds the recordings.")],
    options: Any = None,
    name: Annotated[str | None, typer.Option(help="Name of the benchmark; by default that of the file.")] = None,
    about: Any = None,
    origin: Any = None,
    held_out: Annotated[
        Path | None, typer.Option("--held-out", help="Commitment of leaderboard hold-out to what is kept back.")
    ] = None,
) -> Output:
    """Write a benchmark from the options that brainbench score would take: everything but the model."""
    if out.suffix != ".toml":
        raise UsageError(f"--out is a file that ends in .toml; received {out.name!r}. To make a .zip of it: pack.")
    with progress_bar() as progress:
        about |= {"name": name or out.stem, "held_out": held_out, "progress": progress}
        benchmark = make_benchmark(options, out, **about, **origin)
    write_text(out, benchmark.to_toml())
    text = f"{_text(benchmark)}\n\nfile       {out}\nnext       brainbench benchmark pack {out} --out {out.stem}.zip"
    return Output({"benchmark": benchmark.plain, "hash": benchmark.identity, "path": out}, text)


@app.command("check")
@needs(cache=True)
def check(benchmark: NamedBenchmark) -> Output:
    """Compare every byte of a benchmark with its hash, read its recordings, and compute its ceiling again.

    Exit status 1 if anything is not as it states; what others will miss in it is named too.
    """
    with progress_bar() as progress:
        stated, findings = check_benchmark(benchmark, progress)
    wrong = any(finding.severity == "error" for finding in findings)
    lines = [_text(stated), "", *(f"{item.severity:5}  {item.message}  {item.advice}".rstrip() for item in findings)]
    lines += [] if wrong else ["All files, recordings and numbers are as it states."]
    stated_findings = [{"severity": finding.severity, "what": finding.message} for finding in findings]
    data = {"benchmark": stated.plain, "hash": stated.identity, "findings": stated_findings}
    return Output(data, "\n".join(lines), failure=typer.Exit(1) if wrong else None)


@app.command("pack")
def pack(
    benchmark: NamedBenchmark,
    out: Annotated[Path, out_file_option("File to write, FILE.zip.")],
) -> Output:
    """Write a benchmark and all of its files into one .zip, which is all that a stranger needs."""
    if out.suffix != ".zip":
        raise UsageError(f"--out is a file that ends in .zip; received {out.name!r}.")
    stated = pack_benchmark(benchmark, out)
    size = f"{len(stated.files)} files, {out.stat().st_size:,} bytes"
    text = f"{out}  ({size})\n\nscore on it: brainbench score MODEL --benchmark {out}"
    return Output({"path": out, "files": stated.files, "hash": stated.identity}, text)


@app.command("list")
def list_() -> Output:
    """List the benchmarks that have a name: those of installed packages, and those that you added."""
    files = list_benchmarks()
    if not files:
        return Output({}, "No benchmark has a name here; give one its own: brainbench benchmark add FILE")
    return Output(files, table_of("", files.items(), {"benchmark": "{0[0]}", "file": "{0[1]}"}))


@app.command("add")
def add(benchmark: NamedBenchmark) -> Output:
    """Keep a benchmark with its files in your settings, so that brainbench score knows it by its name."""
    stated, path = add_benchmark(benchmark)
    text = f"{stated.name}  kept in {path}\n\nscore it: brainbench score MODEL --benchmark {stated.name}"
    return Output({"name": stated.name, "hash": stated.identity, "path": path}, text)


def _text(benchmark: Any) -> str:
    """Lay out what a benchmark states."""
    rows = {"benchmark": benchmark.name, "hash": benchmark.identity, "recordings": benchmark.recordings.path}
    rows |= {name: text for name, text in benchmark.stated.items() if name not in ("name", "hash")}
    rows |= {name: value for name, value in benchmark.options.items()}
    if (ceiling := benchmark.ceiling) is not None:
        span = "" if ceiling.lower is None else f", noise ceiling {ceiling.lower:.3f} to {ceiling.upper:.3f}"
        trust = "unknown" if ceiling.reliability is None else f"{ceiling.reliability:.3f}"
        rows["ceiling"] = f"{ceiling.animals} animals, {ceiling.stimuli} stimuli, reliability {trust}{span}"
    if (held := benchmark.held_out) is not None:
        rows["held out"] = f"{held.held} {held.kind}, hash {held.digest[:12]}…"
    return facts(rows)
