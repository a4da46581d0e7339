"""Environments that hold only what some extras of the package install, made of links into the running one."""

from __future__ import annotations

import importlib.metadata as metadata
import tomllib
from functools import cache
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


class NotInstalled(LookupError):
    """A distribution that the extras ask for is missing in the running environment."""


def link_installation(folder: Path, extras: tuple[str, ...]) -> Path:
    """Fill ``folder`` with links to every distribution that ``pip install '.[extras]'`` installs, and return it.

    Run ``python -S`` with it and the checkout on ``PYTHONPATH``: other distributions are then not there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in sorted(_closure(extras)):
        distribution = metadata.distribution(name)
        for top in {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}:
            link = folder / top
            if not link.exists():
                link.symlink_to(Path(str(distribution.locate_file(top))))
    return folder


def _closure(extras: tuple[str, ...]) -> set[str]:
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in EXTRAS[extra])]
    waiting = [(text, "") for text in texts]
    seen: set[tuple[str, str]] = set()
    while waiting:
        text, wanted_by = waiting.pop()
        requirement = Requirement(text)
        if requirement.marker and not requirement.marker.evaluate({"extra": wanted_by}):
            continue
        for extra in requirement.extras or {""}:
            if (requirement.name, extra) in seen:
                continue
            seen.add((requirement.name, extra))
            if requirement.name == "brainbench":
                waiting += [(inner, "") for inner in EXTRAS[extra]]
            else:
                waiting += [(inner, extra) for inner in _requires(requirement.name)]
    # The package itself comes from the checkout; its metadata say what it requires.
    return {name for name, _ in seen} | {"brainbench"}


@cache
def _requires(name: str) -> tuple[str, ...]:
    try:
        return tuple(metadata.distribution(name).requires or ())
    except metadata.PackageNotFoundError as error:
        raise NotInstalled(f"{name} is not installed here") from error
