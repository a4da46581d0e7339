"""``brainbench doctor``: what is installed, what is missing, and what each missing part would enable."""

from __future__ import annotations

from typing import Any

from brainbench.cli.output import JsonOption, emit, table
from brainbench.core.errors import install_command

OPTIONAL = {
    "pynwb": ("nwb", "checking NWB files against the schema"),
    "nwbinspector": ("nwb", "best-practice checks of NWB files"),
    "dandi": ("dandi", "brainbench recordings fetch: public data from the DANDI archive"),
    "pybullet": ("bullet", "the whisker engine of WHISKiT as a second backend (Python < 3.12)"),
    "coacd": ("mesh", "convex decomposition of concave objects"),
    "fast-simplification": ("mesh", "decomposition of meshes above 50,000 triangles"),
    "mujoco-warp": ("gpu", "simulation of robot hands on CUDA"),
    "rsl-rl-lib": ("policies", "training of teachers and students (brainbench policy train | distill)"),
    "gymnasium": ("policies", "the dexterous tasks as gymnasium environments"),
    "scikit-fem": ("tactile", "modes of struck bodies: contact sound from their shape and material"),
    "distributed": ("cluster", "data sets made by a Dask cluster (brainbench stimuli sweep --scheduler)"),
    "scikit-learn": ("learn", "support vector machines (brainbench stimuli separability)"),
    "tensorboard": ("train", "training curves in TensorBoard, beside the run's log"),
    "onnxscript": ("export", "brainbench export --format onnx"),
    "onnxruntime": ("export", "the check of exported ONNX files"),
    "huggingface_hub": ("hub", "models by hf-hub:OWNER/NAME"),
    "matplotlib": ("report", "pictures and plots of stimuli (brainbench stimuli render | plot)"),
    "pyarrow": ("board", "LeRobot data sets of robot episodes"),
    "weasyprint": ("board", "reports as PDF (brainbench leaderboard report --format pdf)"),
    "imageio-ffmpeg": ("report", "films of stimuli as MP4 (GIF needs matplotlib alone)"),
}


def doctor(as_json: JsonOption = False) -> None:
    """Show versions, devices, folders and optional parts."""
    data = diagnose()
    rows = [[name, version or "missing: reinstall brainbench", "", ""] for name, version in data["required"].items()]
    for name, part in data["optional"].items():
        note = ["", ""] if part["version"] else [OPTIONAL[name][0], part["enables"]]
        rows.append([name, part["version"] or "not installed", *note])
    head = [
        f"brainbench {data['version']}, Python {data['python']}, {data['machine']}",
        f"processors {data['processors']}, CUDA {', '.join(data['cuda']) or 'none (not needed)'}",
        f"cache {data['cache']} ({data['cache_bytes'] / 1e6:.1f} MB)",
    ]
    told = f"\n\nAn extra is installed, in the checkout of brainbench, with: {install_command('EXTRA')}"
    text = "\n".join(head) + "\n\n" + table("", ["part", "version", "extra", "enables"], rows) + told
    emit(data, text, as_json=as_json)


def diagnose() -> dict[str, Any]:
    """Collect what :func:`doctor` shows."""
    import torch

    from brainbench.core.devices import usable_processors
    from brainbench.core.files import cache_dir, provenance

    cache, made = cache_dir(), provenance()
    return {
        **{name: made[name] for name in ("version", "python", "machine")},
        "processors": usable_processors(),
        "cuda": [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())],
        "cache": str(cache),
        "cache_bytes": sum(item.stat().st_size for item in cache.rglob("*") if item.is_file()),
        "required": {name: _version(name) for name in _required()},
        "optional": {
            name: {"version": _version(name), "enables": purpose, "install": install_command(extra)}
            for name, (extra, purpose) in OPTIONAL.items()
        },
    }


def _required() -> list[str]:
    """Return the packages that this one cannot do without, as its own metadata states them."""
    from importlib import metadata  # 30 ms that no other command needs

    try:
        stated = metadata.requires("brainbench") or []
    except metadata.PackageNotFoundError:  # a checkout that runs without being installed
        return []
    return [line.split(">")[0].split("<")[0] for line in stated if "extra ==" not in line]


def _version(package: str) -> str | None:
    from importlib import metadata

    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
