"""Small files in the layouts of the published study: recordings, sweeps, runs of its simulator and weights."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from brainbench.published.checkpoint_import import published_names, stored_readout

STEPS = 22


def lightning_state(model, **others):
    """A network of ours as the authors' file would hold it, with S4's stored form and the axes of length one."""
    state = {}
    values = model.state_dict()
    for ours, theirs in published_names(model).items():
        value = values[ours].clone()
        if theirs.endswith(".kernel.A_imag"):
            value = -value
        elif theirs.endswith(".kernel.C"):
            memory = model.get_submodule(ours.rpartition(".")[0])
            value = stored_readout(memory.transition(), value, STEPS, undo=False).float()[None]
        elif theirs.endswith((".kernel.B", ".kernel.P", ".layer.D")):
            value = value[None]
        elif theirs.endswith(".inv_dt") or theirs.endswith("output_linear.0.weight"):
            value = value[..., None]
        state[theirs] = value
        if theirs.endswith(".kernel.C"):
            state[theirs.replace(".C", ".l_kernel")] = torch.tensor(STEPS)
    return state | others


def make_zero_filled(
    lengths: Sequence[int], units: int = 6, *, seed: int = 0, order: Sequence[Sequence[int]] = ()
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return one animal's array [max trials, 6, units of all sessions], and each session's slots [R].

    Every session shows six stimuli of fixed mean rates in random order; slots follow their first appearance, or the
    sequence of stimuli that ``order`` gives for each session.
    """
    rng = np.random.default_rng(seed)
    array = np.full((max(lengths), 6, units * len(lengths)), np.nan)
    slots = []
    for index, length in enumerate(lengths):
        shown = np.array(order[index]) if order else rng.permutation(np.resize(np.arange(6), length))
        seen = list(dict.fromkeys(shown.tolist()))
        own = np.array([seen.index(stimulus) for stimulus in shown])
        tuning = rng.uniform(2, 30, size=(6, units))
        block = np.zeros((length, 6, units))
        block[np.arange(length), own] = rng.poisson(tuning[shown]) + 0.5
        array[:length, :, index * units : (index + 1) * units] = block
        slots.append(own)
    return array, slots


def write_published(path: Path, *, stray: bool = True, **animals: np.ndarray) -> Path:
    """Write arrays as the authors do; ``stray`` as numpy before 2.2 does."""
    np.savez(path, **{name.replace("_", "-"): array for name, array in animals.items()})
    if stray:
        # numpy from 2.2 on takes the name for its keyword, so the entry is added by hand.
        with zipfile.ZipFile(path, "a") as archive, archive.open("allow_pickle.npy", "w") as entry:
            np.lib.format.write_array(entry, np.array(True))
    return path


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
