"""Download of public recordings through the ``dandi`` client; nothing else here uses a network."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

from brainbench.core.errors import DataError, MissingDependencyError, UsageError, install_command, unknown_name
from brainbench.datasets.layouts.registry import get_layout, list_layouts


def fetch(name: str, folder: str | os.PathLike[str] = ".", *, assets: str | None = None) -> Path:
    """Download a data set of the DANDI archive (https://dandiarchive.org).

    What is there already is kept if unchanged, so an interrupted download goes on.

    Args:
        name: a layout's name, or the six digits of a dandiset.
        folder: where to put it.
        assets: glob of the files wanted, such as ``"sub-231CR/*"``; by default those that the layout can use, else all.

    Returns:
        The folder of the data set, ``folder/NUMBER``.
    """
    number, pattern = _dandiset(name)
    client = shutil.which("dandi")
    if client is None:
        raise MissingDependencyError(
            "Downloading from the DANDI archive needs its client, which is not installed: "
            f"{install_command('dandi')}; or get DANDI:{number} elsewhere: every other command works on files, "
            "without a network."
        )
    pattern = assets or pattern
    source = f"dandi://dandi/{number}/{pattern}" if pattern else f"DANDI:{number}"
    target = Path(folder)
    # Keeping the tree keeps two animals' files of the same name apart.
    command = [client, "download", "--output-dir", str(target), "--existing", "refresh", "--preserve-tree"]
    command += ["--path-type", "glob"] if pattern else []
    target.mkdir(parents=True, exist_ok=True)
    status = subprocess.run([*command, source], check=False).returncode
    if status:
        raise DataError(f"The dandi client ended with status {status} while fetching {source}; its messages say why.")
    return target / number


def _dandiset(name: str) -> tuple[str, str]:
    if match := re.fullmatch(r"(?:DANDI:)?(\d{6})", name, re.IGNORECASE):
        layouts = [get_layout(item) for item in list_layouts()]
        return match[1], next((item.assets for item in layouts if item.dandiset == match[1]), "")
    public = [item for item in list_layouts() if get_layout(item).dandiset]
    if name not in list_layouts():
        raise unknown_name("data set", name, public, hint="Or give the six digits of a dandiset, such as 000231.")
    layout = get_layout(name)
    if not layout.dandiset:
        raise UsageError(f"The layout {name!r} names no data set of the DANDI archive; public are {', '.join(public)}.")
    return layout.dandiset, layout.assets
