"""Readers of the published study's files: recordings and sweeps (.npz), checkpoints (.ckpt) and settings."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch

from brainbench.core.reading.tensors import read_tensors
from brainbench.datasets import open_recordings
from brainbench.models.registry import load_model
from brainbench.models.training.checkpoints import WEIGHTS
from brainbench.published.checkpoint_import import (
    build_published,
    import_checkpoint,
    read_settings,
    read_weights,
    recognise,
)
from brainbench.published.conversion import SweepFile, open_sweep_tree, read_sweep
from brainbench.published.estimator import explain_file
from tests.factories.published_files import lightning_state, make_zero_filled, write_published, write_sweep
from tests.factories.reading_trials import Surface, bad_counts, not_finite, numbers, written

SETTINGS = """
model:
  encoder:
    model_config_file: configs/rnn_fdb_converted_modern_ugrnn_ln.json
train:
  ssl: SimCLRLoss
  epochs: 100
  learning_rate: 0.01
"""


def _recordings(folder: Path) -> Path:
    return write_published(folder / "rodgers6_data.npz", m1=make_zero_filled([14, 12], units=3)[0])


def _tree(folder: Path) -> Path:
    for name in ("train", "test"):
        write_sweep(folder / name / "00000000.npz")
    (folder / "categories.json").write_text('{"03211117/screen": 0, "04530566/boat": 2}')
    return folder / "categories.json"


def _halves(folder: Path) -> Path:
    draw = np.random.default_rng(0)
    np.savez(folder / "splits.npz", r_xy=draw.uniform(0, 1, 20), r_yy=draw.uniform(0, 1, 20))
    return folder / "splits.npz"


@functools.cache
def _state() -> dict[str, torch.Tensor]:
    with torch.random.fork_rng():
        return lightning_state(load_model("zhuang-gru-small", classes=3))


def _checkpoint(folder: Path) -> Path:
    torch.save({"state_dict": dict(_state()), "epoch": 6, "global_step": 50}, folder / "best.ckpt")
    return folder / "best.ckpt"


def _import(path: Path) -> Any:
    weights = read_weights(path)
    return weights, build_published(weights.state, recognise(weights.state, architecture="zhuang-gru-small"))[
        0
    ].state_dict()


def _import_to_folder(path: Path) -> dict[str, torch.Tensor]:
    made = import_checkpoint(path, architecture="zhuang-gru-small", out=path.parent / "imported")
    return read_tensors(made.folder / WEIGHTS)


def _bad_sweep(sweep: SweepFile) -> bool:
    """Forces are finite or missing, and stay within what is trusted; conditions and label are numbers."""
    label = 0 if sweep.label is None else sweep.label
    return not_finite(sweep.conditions) or np.isinf(sweep.wrench()).any() or not 0 <= label < 2**31


PUBLISHED = (
    Surface("published recordings, npz", _recordings, open_recordings, bad_counts),
    Surface("published sweep, npz", lambda folder: write_sweep(folder / "0.npz"), read_sweep, _bad_sweep),
    Surface(
        "published sweeps, categories",
        _tree,
        lambda path: open_sweep_tree(path.parent).classes,
        lambda names: len(names) > 1000,
    ),
    Surface("split halves, npz", _halves, explain_file, lambda steps: np.isinf([*numbers(steps)]).any()),
    Surface("published weights, ckpt", _checkpoint, _import),
    Surface("published weights, imported", _checkpoint, _import_to_folder),
    Surface("published settings, YAML", written("config.yaml", SETTINGS), read_settings),
)
