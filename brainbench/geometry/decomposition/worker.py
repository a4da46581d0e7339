"""The process that decomposes one mesh: ``SOURCE TARGET METHOD THRESHOLD MOST_PIECES SEED MEMORY``.

Run as a file, so that it imports nothing of ours. The limit of memory is the kernel's (Linux), so
whatever the library allocates counts; where there is none, only the limit of time of the caller holds.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np


def main(source: str, target: str, method: str, threshold: str, most: str, seed: str, memory: str) -> None:
    """Read the mesh, decompose it, write the points of the pieces."""
    with np.load(source, allow_pickle=False) as stored:
        vertices, faces = stored["vertices"], stored["faces"]
    if method == "coacd":
        import coacd

        _limit(int(memory))
        coacd.set_log_level("error")
        limits = {"threshold": float(threshold), "max_convex_hull": int(most), "seed": int(seed)}
        pieces = [np.asarray(points, float) for points, _ in coacd.run_coacd(coacd.Mesh(vertices, faces), **limits)]
    else:
        pieces = _vhacd(vertices, faces, int(memory))
    np.savez(target, points=np.concatenate(pieces), sizes=[len(piece) for piece in pieces])


def _limit(memory: int) -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    # A limit of the address space: an allocation beyond it fails in the library instead of filling the machine.
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


def _vhacd(vertices: np.ndarray, faces: np.ndarray, memory: int) -> list[np.ndarray]:
    import pybullet

    _limit(memory)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    Path("mesh.obj").write_text("\n".join(lines) + "\n")
    pybullet.vhacd("mesh.obj", "pieces.obj", "log.txt")
    points, pieces = [], []
    for line in [*Path("pieces.obj").read_text().splitlines(), "o end"]:
        if line.startswith("o ") and points:
            pieces.append(np.array(points))
            points = []
        elif line.startswith("v "):
            points.append([float(word) for word in line.split()[1:4]])
    return pieces


if __name__ == "__main__":
    main(*sys.argv[1:])
