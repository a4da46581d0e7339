"""``brainbench doctor``: what is installed, what is missing, and what each missing part would enable."""

from __future__ import annotations

from typing import Any

from brainbench.cli.output import Output, table
from brainbench.core.devices import usable_processors
from brainbench.core.errors import BrainbenchError, install_command
from brainbench.core.files import CACHE_VARIABLE, cache_dir, check_folder, provenance, user_folder

ENABLES = {
    "nwb": "checks of NWB files against the schema and best practice",
    "dandi": "brainbench recordings fetch: public data from the DANDI archive",
    "bullet": "the whisker engine of WHISKiT as a second backend (Python < 3.12)",
    "mesh": "convex decomposition of concave objects",
    "gpu": "simulation of robot hands on CUDA",
    "tactile": "modes of struck bodies: contact sound from their shape and material",
    "train": "training curves in TensorBoard, beside the run's log",
    "policies": "dexterous tasks in gymnasium, and training of teachers and students",
    "cluster": "data sets made by a Dask cluster (brainbench stimuli sweep --scheduler)",
    "learn": "support vector machines (brainbench stimuli separability)",
    "export": "brainbench export --format onnx, with a check of the file",
    "hub": "models by hf-hub:OWNER/NAME",
    "report": "pictures, plots and films",
    "board": "reports as PDF, and LeRobot data sets of robot episodes",
}
"""Extra → what it enables; a package of several extras stands with the first."""


def doctor() -> Output:
    """Show versions, devices, folders and optional parts."""
    data = diagnose()
    rows = [[name, version or "missing: reinstall brainbench", "", ""] for name, version in data["required"].items()]
    for name, part in data["optional"].items():
        note = ["", ""] if part["version"] else [part["extra"], part["enables"]]
        rows.append([name, part["version"] or "not installed", *note])
    head = [
        f"brainbench {data['version']}, Python {data['python']}, {data['machine']}",
        f"processors {data['processors']}, CUDA {', '.join(data['cuda']) or 'none (not needed)'}",
        data["cache_problem"] or f"cache {data['cache']} ({data['cache_bytes'] / 1e6:.1f} MB)",
    ]
    hint = f"\n\nAn extra is installed, in the checkout of brainbench, with: {install_command('EXTRA')}"
    text = "\n".join(head) + "\n\n" + table("", ["part", "version", "extra", "enables"], rows) + hint
    return Output(data, text)


def diagnose() -> dict[str, Any]:
    """Collect what :func:`doctor` shows."""
    import torch

    cache, problem, facts = None, None, provenance()
    try:
        root = user_folder(CACHE_VARIABLE, "user_cache_dir")
        cache = cache_dir()
        check_folder(root, CACHE_VARIABLE)
    except BrainbenchError as error:  # what is wrong here is what one wants to read
        problem = str(error)
    return {
        **{name: facts[name] for name in ("version", "python", "machine")},
        "processors": usable_processors(),
        "cuda": [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())],
        "cache": str(cache) if cache else None,
        "cache_problem": problem,
        "cache_bytes": sum(item.stat().st_size for item in cache.rglob("*") if item.is_file()) if cache else 0,
        "required": {name: _version(name) for name in _packages("")},
        "optional": {
            name: {"version": _version(name), "extra": extra, "enables": purpose, "install": install_command(extra)}
            for extra, purpose in reversed(ENABLES.items())
            for name in _packages(extra)
        },
    }


def _packages(extra: str) -> list[str]:
    """Return the packages of an extra, or those this one cannot do without, as its own metadata states them."""
    from importlib import metadata  # 30 ms that no other command needs

    from packaging.requirements import Requirement

    try:
        stated = map(Requirement, metadata.requires("brainbench") or [])
    except metadata.PackageNotFoundError:  # a checkout that runs without being installed
        return []
    mark = f'extra == "{extra}"' if extra else ""
    return [item.name for item in stated if (mark in str(item.marker) if mark else "extra ==" not in str(item.marker))]


def _version(package: str) -> str | None:
    from importlib import metadata

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
