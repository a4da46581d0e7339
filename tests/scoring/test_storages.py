"""A score depends on what files say, not on how HDF5 stores it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from brainbench.core.reading.hdf5 import LINKED_VARIABLE
from brainbench.datasets import write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.models.features import write_features
from brainbench.scoring.scores import score_record
from brainbench.stimuli.sources import load_stimuli

Store = Callable[[h5py.Group, str, np.ndarray], Any]


def _kept(**options: Any) -> Store:
    return lambda group, name, values: group.create_dataset(name, data=values, **options)


def _big(group: h5py.Group, name: str, values: np.ndarray) -> None:
    group.create_dataset(name, data=values, dtype=values.dtype.newbyteorder(">"))


def _compact(group: h5py.Group, name: str, values: np.ndarray) -> None:
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_layout(h5py.h5d.COMPACT if values.nbytes < 60_000 else h5py.h5d.CONTIGUOUS)
    space, kind = h5py.h5s.create_simple(values.shape), h5py.h5t.py_create(values.dtype)
    h5py.Dataset(h5py.h5d.create(group.id, name.encode(), kind, space, plan))[...] = values


def _soft(group: h5py.Group, name: str, values: np.ndarray) -> None:
    place = f"/stored{group.name}/{name}".replace("//", "/")
    group.file[place] = values
    group[name] = h5py.SoftLink(place)


def _beside(group: h5py.Group, name: str, values: np.ndarray) -> str:
    """Put values into a file beside the one that is written; return its name."""
    words = f"{Path(group.file.filename).stem} {group.name} {name}".replace("/", "_")
    with h5py.File(Path(group.file.filename).parent / f"{words}.part", "w") as file:
        file["x"] = values
    return f"{words}.part"


def _linked(group: h5py.Group, name: str, values: np.ndarray) -> None:
    group[name] = h5py.ExternalLink(_beside(group, name, values), "/x")


def _chained(group: h5py.Group, name: str, values: np.ndarray) -> None:
    part = _beside(group, name, values)
    with h5py.File(Path(group.file.filename).parent / f"{part}.on", "w") as file:
        file["y"] = h5py.ExternalLink(part, "/x")
    group[name] = h5py.ExternalLink(f"{part}.on", "/y")


def _virtual(group: h5py.Group, name: str, values: np.ndarray) -> None:
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource(_beside(group, name, values), "x", values.shape)
    group.create_virtual_dataset(name, layout)


def _woven(group: h5py.Group, name: str, values: np.ndarray) -> None:
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    for start in range(min(2, len(values))):
        part = values[start::2]
        layout[start::2] = h5py.VirtualSource(_beside(group, f"{name}{start}", part), "x", part.shape)
    group.create_virtual_dataset(name, layout)


def _nested(group: h5py.Group, name: str, values: np.ndarray) -> None:
    with h5py.File(Path(group.file.filename).parent / f"{_beside(group, name, values)}.on", "w") as file:
        _virtual(file, "y", values)
        on = Path(file.filename).name
    layout = h5py.VirtualLayout(values.shape, values.dtype)
    layout[...] = h5py.VirtualSource(on, "y", values.shape)
    group.create_virtual_dataset(name, layout)


def _raw(group: h5py.Group, name: str, values: np.ndarray) -> None:
    place = Path(group.file.filename).parent / f"{_beside(group, name, values)}.raw"
    place.write_bytes(values.tobytes())
    group.create_dataset(name, values.shape, values.dtype, external=[(os.fspath(place), 0, values.nbytes)])


STORAGES: dict[str, tuple[Store, dict[str, Any]]] = {
    "contiguous": (_kept(), {}),
    "in chunks": (_kept(chunks=True), {}),
    "compressed": (_kept(compression="gzip", shuffle=True), {}),
    "compressed fast": (_kept(compression="lzf"), {}),
    "with sums": (_kept(fletcher32=True), {}),
    "big end first": (_big, {}),
    "compact": (_compact, {}),
    "a user block": (_kept(), {"userblock_size": 512}),
    "newest format": (_kept(chunks=True), {"libver": "latest"}),
    "in order": (_kept(), {"track_order": True}),
    "soft links": (_soft, {}),
    "external links": (_linked, {}),
    "chained links": (_chained, {}),
    "virtual": (_virtual, {}),
    "woven": (_woven, {}),
    "nested": (_nested, {}),
    "raw bytes": (_raw, {}),
}
"""Way → what stores an array, options of the file. Only the last needs leave: ``--allow-linked``."""


def store_again(source: Path, path: Path, storage: str) -> Path:
    """Write a file once more, its numbers stored in another way."""
    store, options = STORAGES[storage]
    with h5py.File(source) as given, h5py.File(path, "w", **options) as file:
        file.attrs.update(given.attrs)

        def copy(name: str, node: Any) -> None:
            if isinstance(node, h5py.Group):
                file.require_group(name).attrs.update(node.attrs)
            elif node.dtype.kind in "iuf" and node.ndim:
                parent, _, last = name.rpartition("/")
                store(file.require_group(parent) if parent else file, last, node[()])
            else:
                given.copy(node, file, name)

        given.visititems(copy)
    return path


LABELS = [*"abcdef"]


def _write(folder):
    """Write recordings of two animals, activations and arrays for six conditions."""
    rng = np.random.default_rng(0)
    start, label = 1.0 + np.arange(48), np.arange(48) % 6
    sessions = []
    for animal in "xy":
        spikes = [
            np.concatenate(
                [
                    t + np.linspace(0, 0.4, rng.poisson(2 + 2 * ((k + unit) % 3)))
                    for t, k in zip(start, label, strict=True)
                ]
            )
            for unit in range(6)
        ]
        table = {"start_time": start, "stop_time": start + 0.5, "stimulus": np.array(LABELS)[label]}
        sessions.append(make_session(animal, "1", spikes, {"trials": table}))
    recordings = write_recordings(folder / "recordings.h5", sessions)
    features = write_features(
        folder / "features.h5", LABELS, {"b": rng.normal(size=(6, 9)), "a": rng.normal(size=(6, 4))}
    )
    with h5py.File(folder / "arrays.h5", "w") as file:
        file["stimuli"] = rng.normal(size=(6, 10, 4)).astype(np.float32)
        file["labels"] = np.array(LABELS, dtype=h5py.string_dtype())
    return recordings, features, folder / "arrays.h5"


def _read(recordings, features, arrays):
    options = {"recordings": str(recordings), "conditions": "trials:stimulus", "window": "start..stop"}
    record = score_record(str(features), baselines=False, **options)
    stimuli = load_stimuli(arrays)
    return (
        record.score.value,
        record.score.layer,
        record.score.provenance["recordings"]["content_hash"],
        stimuli.content_hash,
    )


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    files = _write(tmp_path_factory.mktemp("originals"))
    return files, _read(*files)


def test_there_are_seventeen_storages():
    assert len(STORAGES) == 17


@pytest.mark.parametrize("storage", STORAGES)
def test_one_content_gives_one_score_and_one_hash(originals, tmp_path, monkeypatch, storage):
    monkeypatch.setenv(LINKED_VARIABLE, str(tmp_path))
    files, expected = originals
    assert _read(*(store_again(path, tmp_path / path.name, storage) for path in files)) == expected
