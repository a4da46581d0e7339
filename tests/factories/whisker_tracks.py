"""Files as whisker trackers write them."""

from __future__ import annotations

import csv
import pickle
import struct

import h5py
import numpy as np
import pandas as pd


def bent_shapes(frames=12, points=10, *, bend=0.2, axes=2):
    """Return shapes [frame, point, axis] (m) of a whisker that swings about its base at the origin."""
    length = 0.015
    s = np.linspace(0, length, points)
    angle = 0.3 * np.sin(np.arange(frames) / 4)[:, None]
    y = bend * s**2 / length
    x = s
    shapes = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], axis=-1)
    return (
        shapes if axes == 2 else np.concatenate([shapes, 0.1 * s[None, :, None] * np.ones_like(angle)[..., None]], -1)
    )


def write_points(path, shapes, *, frames=None):
    """Write a table of points in pixels of 50 µm, whose y runs down."""
    with path.open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["frame", "x", "y", "z"][: 1 + shapes.shape[-1]])
        for frame, shape in zip(frames or range(len(shapes)), shapes, strict=True):
            for point in shape:
                cells = [*(point / 5e-5)]
                cells[1] = -cells[1]
                table.writerow([frame, *("" if np.isnan(one) else f"{one:.6f}" for one in cells)])
    return path


def write_deeplabcut_csv(path, values, likelihood, *, individuals=None):
    """Write DeepLabCut's table of points [frame, part, 2] (pixels) with their likelihoods [frame, part]."""
    parts = [f"p{index}" for index in range(values.shape[1])]
    levels = {"scorer": ["net"], "individuals": [individuals], "bodyparts": parts, "coords": ["x", "y", "likelihood"]}
    if individuals is None:
        del levels["individuals"]
    block = np.concatenate([values, likelihood[..., None]], axis=-1).reshape(len(values), -1)
    pd.DataFrame(block, columns=pd.MultiIndex.from_product(levels.values(), names=levels)).to_csv(path)
    return path


def write_deeplabcut_table(path, values, likelihood):
    """Write DeepLabCut's HDF5 table as pandas does: the names stand in a pickle of protocol 0."""
    parts = [f"p{index}" for index in range(values.shape[1])]
    kind = pickle.dumps([("net", part, coord) for part in parts for coord in ("x", "y", "likelihood")], protocol=0)
    block = np.concatenate([values, likelihood[..., None]], axis=-1).reshape(len(values), -1)
    table = np.zeros(len(values), dtype=[("index", "<i8"), ("values_block_0", "<f8", (block.shape[1],))])
    table["index"], table["values_block_0"] = np.arange(len(values)), block
    with h5py.File(path, "w") as file:
        file.create_dataset("df_with_missing/table", data=table).attrs["values_block_0_kind"] = np.bytes_(kind)
    return path


def write_whiskers(path, traces):
    """Write whisk's binary file of traces: (frame, number) → points [k, 2] (pixels)."""
    with path.open("wb") as stream:
        stream.write(b"bwhiskbin1\0\0")
        for (frame, number), points in traces.items():
            stream.write(struct.pack("<iii", number, frame, len(points)))
            for column in (points[:, 0], points[:, 1], np.ones(len(points)), np.ones(len(points))):
                stream.write(column.astype("<f4").tobytes())
        stream.write(struct.pack("<i", len(traces)))
    return path


def write_measurements(path, labels, follicles):
    """Write the table of whisk's measurements: labels and follicles (pixels) by (frame, number)."""
    with path.open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["fid", "wid", "label", "follicle_x", "follicle_y"])
        for key, label in labels.items():
            table.writerow([*key, label, *follicles[key]])
    return path


def write_whiskiwrap(path, traces, follicles):
    """Write the HDF5 file of WhiskiWrap."""
    kind = [("time", "<u4"), ("id", "<u2"), ("fol_x", "<f4"), ("fol_y", "<f4")]
    summary = np.array([(frame, number, *follicles[frame, number]) for frame, number in traces], dtype=kind)
    with h5py.File(path, "w") as file:
        file["summary"] = summary
        for axis, name in enumerate(("pixels_x", "pixels_y")):
            rows = file.create_dataset(name, (len(traces),), dtype=h5py.vlen_dtype(np.float32))
            for index, points in enumerate(traces.values()):
                rows[index] = points[:, axis]
    return path


def write_whiskerman(path, control, follicle, tracked):
    """Write WhiskerMan's MATLAB file of one whisker and another that was never tracked."""
    from scipy.io import savemat

    whisker = np.zeros((1, 2), dtype=[("r3all", object), ("fp3_all", object), ("tracked", object)])
    whisker[0, 0] = (control, follicle, tracked[:, None])
    whisker[0, 1] = (control, follicle, 0 * tracked[:, None])
    savemat(path, {"whisker": whisker}, appendmat=False)
    return path
