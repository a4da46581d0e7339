"""Compile, on a machine without a GPU, the CUDA kernels that a Warp program launches, to carry them to one that has.

    python -m benchmarks.whiskers.precompile --pack kernels.tar.xz benchmarks/tactile/throughput.py --part sensors
    --device cuda --envs 64
    tar xJf kernels.tar.xz -C ~/.cache/warp          # there; then run the program as usual

The program runs here with a device that calls itself CUDA but computes nothing: arrays lie in host memory, and a
launch compiles its kernel and returns. A kernel for the processor is refused, as by the Warp of a GPU machine that
lacks the compiler for processors (../shared/device/README.md). What depends on computed numbers therefore does not
happen; programs to be run so need a small number of environments and repeats. Modules that are in the folder already
are not compiled again.
Binaries fit one architecture (``--arch 90``: H100, H200) and one version of Warp, and need a driver of the same major
version as the toolkit that this Warp was built with.
"""

from __future__ import annotations

import argparse
import copy
import os
import runpy
import sys
import tarfile
import tempfile
import time
from pathlib import Path
from typing import Any

FOLDER = Path.home() / ".cache" / "warp-precompiled"


class Recording:
    """Stands for ``warp.ScopedCapture``: what is launched inside is compiled like everything else."""

    graph = None

    def __init__(self, *_positional: Any, **_named: Any) -> None: ...

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_error: object) -> None: ...


def pretend(folder: Path, arch: int, sm_count: int) -> list[tuple[str, float]]:
    """Add a device to Warp that lies in host memory, looks like CUDA from outside and compiles instead of launching.

    Returns:
        A list that fills with (module, seconds) as modules are compiled.
    """
    import warp as wp
    from warp._src import context

    wp.config.log_level = wp.LOG_ERROR
    wp.config.kernel_cache_dir = str(folder)
    wp.init()
    fake = copy.copy(wp.get_device("cpu"))
    fake.alias, fake.sm_count, fake.max_shared_memory_per_block = "cuda:0", sm_count, 227 * 1024
    compiled: list[tuple[str, float]] = []

    def seen_from_outside(truth: bool) -> property:
        def answer(device: Any) -> bool:
            inside = sys._getframe(1).f_globals.get("__name__", "").split(".")[0] == "warp"
            return truth == inside if device is fake else truth

        return property(answer)

    def load(module: Any, device: Any, block_dim: int | None = None, **_named: Any) -> None:
        if device is not fake:
            raise RuntimeError(f"A kernel of {module.name} is launched on the processor, which compiles nothing there.")
        threads = block_dim or module.options["block_dim"]
        module.get_module_hash(threads)
        options = module.resolved_options[threads]
        name = module.get_module_identifier(threads)
        output = f"{name}.sm{arch}.cubin"
        started = time.perf_counter()
        place = folder / wp.config.version / name
        if module._compile(None, place, output, arch, use_ptx=False, options=options):
            compiled.append((name, time.perf_counter() - started))
            print(f"compiled {len(compiled)}: {name}, {compiled[-1][1]:.1f} s", file=sys.stderr, flush=True)

    def loop(condition: Any, while_body: Any, stream: Any = None, **named: Any) -> None:
        del condition, stream
        while_body(**named)

    def branch(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **named: Any) -> None:
        del condition, stream
        for body in (on_true, on_false):
            if body is not None:
                body(**named)

    context.runtime.device_map["cuda:0"] = fake
    inner: dict[tuple[Any, str], Any] = {
        (context.Device, "is_cuda"): seen_from_outside(False),
        (context.Device, "is_cpu"): seen_from_outside(True),
        (context.Module, "load"): load,
        (context, "_resolve_launch_block_dim"): lambda _device, threads: threads if threads and threads > 0 else 256,
        (context.runtime, "get_current_cuda_device"): lambda: fake,
    }
    outer = {
        "ScopedCapture": Recording,
        "capture_launch": lambda *_graph, **_named: None,
        "capture_while": loop,
        "capture_if": branch,
        "is_cuda_available": lambda: True,
        "get_cuda_device_count": lambda: 1,
        "is_cpu_available": lambda: False,
        "is_conditional_graph_supported": lambda: True,
    }
    for (owner, name), replacement in inner.items():
        setattr(owner, name, replacement)
    for name, replacement in outer.items():
        setattr(wp, name, replacement)
    return compiled


def pack(folder: Path, version: str, target: Path) -> int:
    """Write what a GPU machine needs of the folder to an archive; return its size in bytes."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(target, "w:xz") as archive:
        for path in sorted((folder / version).rglob("*")):
            if path.suffix in (".cubin", ".meta"):
                archive.add(path, arcname=str(path.relative_to(folder)))
    return target.stat().st_size


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--folder", type=Path, default=FOLDER, help="where kernels are kept between runs")
    parser.add_argument("--arch", type=int, default=90)
    parser.add_argument("--sm-count", type=int, default=132)
    parser.add_argument("--pack", type=Path, help="archive to write at the end")
    parser.add_argument("program", nargs=argparse.REMAINDER, help="a script or -m module, with its arguments")
    options = parser.parse_args()
    # What the program would keep rests on numbers that were never computed.
    os.environ["BRAINBENCH_CACHE"] = tempfile.mkdtemp(prefix="precompile-")
    compiled = pretend(options.folder, options.arch, options.sm_count)
    program = options.program
    try:
        if program[:1] == ["-m"]:
            sys.argv = program[1:]
            runpy.run_module(program[1], run_name="__main__", alter_sys=True)
        elif program:
            sys.argv = program
            sys.path.insert(0, str(Path(program[0]).resolve().parent))
            runpy.run_path(program[0], run_name="__main__")
    finally:
        print(f"{len(compiled)} modules in {sum(seconds for _name, seconds in compiled):.0f} s", file=sys.stderr)
        if options.pack:
            import warp as wp

            size = pack(options.folder, wp.config.version, options.pack)
            print(f"{options.pack}: {size / 2**20:.1f} MiB", file=sys.stderr)


if __name__ == "__main__":
    main()
