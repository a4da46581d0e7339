"""Small files in the layouts of the published study: sweeps (.npz) and simulator runs (.csv)."""

from __future__ import annotations

import numpy as np

EMPTY = (5, 6, 12, 13, 34)
SHAPES = {"03211117/screen": 0, "04530566/boat": 2, "04530566/ship": 2, "03593526/jar": 4}
CHANNELS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")


def sweep_data(seed, cells=35):
    """Forces [110, cells, 6] in mN and µN·m, all different, zero in cells without a whisker."""
    data = np.random.default_rng(seed).normal(size=(110, cells, 6))
    if cells == 35:
        data[:, EMPTY] = 0.0
    data[0] = 0.0
    return data


def write_sweep(path, seed=0, *, rate=1000, leave_out=(), **changed):
    """Write a sweep file; a field may be changed or left out."""
    shapes = list(SHAPES.items())
    shape, label = shapes[seed % len(shapes)]
    fields = {"data": sweep_data(seed), "shape": shape, "label": label}
    fields |= {"h": "-5", "d": "8", "t": "30"} if rate == 1000 else {"h": -3.0, "to": 12, "t": 90, "v": 45, "s": 20}
    fields |= changed
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **{name: value for name, value in fields.items() if name not in leave_out})
    return path


def write_tree(folder, sizes=(8, 4, 4), **changed):
    """Write sweeps into train, validate and test."""
    seed = 0
    for name, size in zip(("train", "validate", "test"), sizes, strict=True):
        for place in range(size):
            write_sweep(folder / name / f"{place:08d}.npz", seed, **changed)
            seed += 1
    return folder


def write_run(folder, dynamics, names=("RC1", "RC2")):
    """Write dynamics [row, whisker, 6] (mN, µN·m) as a run of the simulator."""
    (folder / "dynamics").mkdir(parents=True)
    (folder / "whisker_ID.csv").write_text("".join(f"{name}\n" for name in names))
    for index, channel in enumerate(CHANNELS):
        np.savetxt(folder / "dynamics" / f"{channel}.csv", dynamics[:, :, index], delimiter=",", fmt="%g")
    return folder
